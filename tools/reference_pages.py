"""Write the reference of the commands and of the REST interface from the code.

    make docs

To correct a page, correct the help of the command or the docstring of the route.
"""

import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import click
import typer
from fastapi import Depends
from fastapi.routing import APIRoute

from fcslam.cli import app as command_line
from fcslam.service.authentication import Role
from fcslam.service.http.app import PREFIX, create_app
from fcslam.service.http.state import ServiceState

FOLDER = Path(__file__).parents[1] / "docs" / "reference"

COMMANDS = """\
# Commands

The command `fcslam` has the subcommands and options below. `make docs` writes the page from the code;
the option `--help` of each command prints the same.
"""

ROWS = ["| name | default or range | meaning |", "|---|---|---|"]
LONG = 8
"""Words from which on a row that several commands share is written once."""

REST = """\
# REST interface

A running service answers these HTTP requests for its state, maps and edits. `make docs` writes the page from the code.

- A service on your machine: `fcslam serve --data cloud` listens at `http://127.0.0.1:8340`.
- `/openapi.json` describes all requests, parameters and answers, each number with its unit.
- Roles: each token has the role robot, viewer or admin. An admin may do what a viewer may. A robot acts in its own name
  only. See [deployment](../howto/deploy.md).
- An error is one line of JSON, `{"error": "..."}`.

| status | reason |
|---|---|
| 400 | the request is invalid |
| 401 | the token is unknown |
| 403 | the role or the robot does not match |
| 404 | the requested item does not exist |
| 409 | two processes with one robot name, two packets with one number, an existing mission, or a final edit |
| 413 | the request is too large |
| 429 | too many requests; `Retry-After` says when to try again |
| 503 | the service is stopping, or it is not ready |
| 507 | the disk is full; the service writes a requested result when there is room again |

After 429, 503 and 507, robots try again automatically.
"""


def cell(text: str) -> str:
    """Text of one table cell."""
    return " ".join(text.replace("\\[", "[").split()).replace("|", "\\|")


def commands_page() -> str:
    """The page of all commands."""
    command = cast(click.Group, typer.main.get_command(command_line))
    found = list(sections(command, click.Context(command, info_name="fcslam")))
    shared = shared_rows("\n".join(found))
    table = ["## Options of several commands", "", *ROWS, *shared, ""]
    return "\n".join([COMMANDS, *table, *(refer(part, shared) for part in found)])


def shared_rows(text: str) -> list[str]:
    """Long rows of options that several commands have; of each name the most frequent one."""
    counts = Counter(line for line in text.split("\n") if line.startswith("| `-") and len(line.split()) >= LONG)
    by_name: dict[str, str] = {}
    for line, count in counts.most_common():
        if count > 1:
            by_name.setdefault(line.partition(" | ")[0], line)
    return list(by_name.values())


def refer(text: str, shared: list[str]) -> str:
    """A section in which shared rows are one line that leads to the table of all commands."""
    lines = text.split("\n")
    found = [line for line in lines if line in shared]
    if not found:
        return text
    names = [re.search(r"--[\w-]+", line.partition(" | ")[0]) for line in found]
    listed = ", ".join(f"`{name[0]}`" for name in names if name)
    also = f"[Shared options](#options-of-several-commands): {listed}."
    kept = [line for line in lines if line not in shared]
    end = max(k for k, line in enumerate(kept) if line.startswith("| ")) + 1
    if kept[end - 1] == ROWS[0]:  # no row is left
        end -= 1
        del kept[end : end + 2]
        return "\n".join([*kept[:end], also, *kept[end:]])
    return "\n".join([*kept[:end], "", also, *kept[end:]])


def sections(group: click.Group, context: click.Context) -> Iterator[str]:
    """A section for each command, groups before their commands."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        inner = click.Context(command, parent=context, info_name=name)
        yield section(command, inner)
        if isinstance(command, click.Group):
            yield from sections(command, inner)


def section(command: click.Command, context: click.Context) -> str:
    """One command: what it does, its options and examples."""
    depth = "##" if context.parent is not None and context.parent.parent is None else "###"
    lines = [f"{depth} {context.command_path}", "", *paragraphs(command.help or "")]
    rows = [row(parameter, context) for parameter in command.params if not getattr(parameter, "hidden", False)]
    if rows and not isinstance(command, click.Group):
        lines += [*ROWS, *rows, ""]
    examples = [line for line in (command.epilog or "").split("\n") if line.startswith("fcslam ")]
    if examples and not isinstance(command, click.Group):
        lines += ["```sh", *examples, "```", ""]
    return "\n".join(lines)


def paragraphs(text: str) -> list[str]:
    """The help as Markdown; typer keeps the line breaks of paragraphs."""
    return [part for block in re.split(r"\n\s*\n", text.strip()) for part in (" ".join(block.split()), "")]


def row(parameter: click.Parameter, context: click.Context) -> str:
    """One line of the table of a command."""
    record = parameter.get_help_record(context)
    assert record is not None, parameter.name
    name, text = record
    meaning, _, extra = text.replace("\\[", "[").partition("  [")
    default = cell(extra.removesuffix("]").removeprefix("default: ")).replace("<", "&lt;")
    return f"| `{cell(name)}` | {default} | {cell(meaning).replace('<', '&lt;')} |"


class Described(ServiceState):
    """The state of a service that never runs: routes only ask it who may use them."""

    def __init__(self) -> None:
        """Nothing to keep."""

    def require(self, *roles: Role) -> list[Any]:
        """Remember the roles in place of checking them."""

        def allowed() -> tuple[Role, ...]:
            return roles

        return [Depends(allowed)]


def rest_page() -> str:
    """The page of all requests."""
    app = create_app(Described())
    roles = dict(roles_of(app.routes))
    groups: dict[str, list[str]] = {}
    for path, operations in app.openapi()["paths"].items():
        for method, operation in operations.items():
            request = f"`{method.upper()} {path}`"
            who = roles[operation["summary"], path.removeprefix(PREFIX)]
            does = cell(operation["description"].partition("\n\n")[0])
            groups.setdefault(operation["tags"][0], []).append(f"| {request} | {who} | {does} |")
    parts = [
        "\n".join([f"## {name.capitalize()}", "", "| request | role | does |", "|---|---|---|", *rows, ""])
        for name, rows in groups.items()
    ]
    return "\n".join([REST, *parts])


def roles_of(routes: Iterable[Any]) -> Iterator[tuple[tuple[str, str], str]]:
    """Who may use each route, by its summary in OpenAPI and its path without prefix."""
    for route in routes:
        if isinstance(route, APIRoute):
            roles = [role for needed in route.dependencies if needed.dependency for role in needed.dependency()]
            summary = route.summary or route.name.replace("_", " ").title()
            yield (summary, route.path.removeprefix(PREFIX)), ", ".join(role.value for role in roles) or "anybody"
        elif hasattr(route, "original_router"):
            yield from roles_of(route.original_router.routes)


PAGES = {FOLDER / "commands.md": commands_page, FOLDER / "rest.md": rest_page}


def main() -> int:
    """Write the pages."""
    for path, page in PAGES.items():
        path.write_text(page(), encoding="utf-8")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
