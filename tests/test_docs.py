"""All names in the documentation exist: files, symbols, commands with their options, make targets, settings, links."""

import re
import shlex
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer
import yaml

from fcslam.cli import app
from fcslam.config import Settings
from fcslam.mission.mission import MissionConfig
from fcslam.records import ReasonCode
from tests.test_imports import ROOMS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "fcslam"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

PATH = re.compile(r"(?<![\w./<-])(?:\.\./)*(?:[\w.-]+/)*[\w.-]+\.(?:py|md|proto|toml|txt)(?![\w*])")
LINK = re.compile(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"")
SYMBOL = re.compile(r"`(\w+)`(?:(?:,| and) `(\w+)`)? in `([\w/]+\.py)`")
INLINE_COMMAND = re.compile(r"`(fcslam [^`\n]+)`")
BLOCK = re.compile(r"^```.*?^```|^ {4}.*?$", re.MULTILINE | re.DOTALL)
COMMAND_LINE = re.compile(r"^(?: {4})?(fcslam .+)$", re.MULTILINE)
OTHERS_LAUNCH = re.compile(r"^ros2 launch \w+ \S+", re.MULTILINE)
"""A launch file of another package."""
TARGET = re.compile(r"(?:^|`| {4})make ([a-z-]+)", re.MULTILINE)
TEST = re.compile(r"`(test_\w+)`")
SETTING = re.compile(r"`((?:robot|fleet|map)\.[a-z][\w.]*)`")


def faults(find: Callable[[Path, str], Iterable[str]]) -> dict[str, list[str]]:
    """What ``find`` does not find in each page, given its path and its text."""
    found = {str(page.relative_to(ROOT)): sorted(find(page, page.read_text(encoding="utf-8"))) for page in PAGES}
    return {page: missing for page, missing in found.items() if missing}


def is_there(name: str, page: Path) -> bool:
    """Whether a file named in ``page`` exists, seen from the page, the repository or the package."""
    return any((folder / name).is_file() for folder in (page.parent, ROOT, PACKAGE))


def missing_files(page: Path, text: str) -> list[str]:
    if page.name == "commands.md":  # the help of the commands names files of users
        return []
    return [name for name in PATH.findall(OTHERS_LAUNCH.sub("", text)) if not is_there(name, page)]


def missing_symbols(text: str) -> list[str]:
    return [
        f"{symbol} in {path}"
        for *symbols, path in SYMBOL.findall(text)
        for symbol in filter(None, symbols)
        if not re.search(rf"^\s*(?:(?:def|class) {symbol}\b|{symbol}(?:: | = ))", read(path), re.MULTILINE)
    ]


def read(path: str) -> str:
    return next(folder / path for folder in (PACKAGE, ROOT) if (folder / path).is_file()).read_text(encoding="utf-8")


def command_lines(text: str) -> Iterator[str]:
    """Every command on a line of its own in a block of code."""
    for block in BLOCK.findall(text):
        yield from COMMAND_LINE.findall(block)


def commands(text: str) -> Iterator[tuple[str, bool]]:
    """Every command named, and whether it stands on a line of its own: then it must be complete."""
    yield from ((line, True) for line in command_lines(text))
    yield from ((line, False) for line in INLINE_COMMAND.findall(text))


COMMAND = typer.main.get_command(app)


def complaint(line: str, complete: bool) -> str:
    """The error of click for a command line; empty if it would run."""
    command: click.Command = COMMAND
    words = shlex.split(line.partition(">")[0], comments=True)
    context = click.Context(command, info_name=words.pop(0))
    while isinstance(command, click.Group):
        if not words:
            return f"{line}: no such command" if complete else ""
        found = command.get_command(context, words[0])
        if found is None:
            options = {name for option in command.get_params(context) for name in option.opts}
            return "" if words[0] in options else f"{line}: no command {words[0]}"
        command, context = found, click.Context(found, parent=context, info_name=words.pop(0))
    try:
        command.make_context(context.info_name, words)
    except click.exceptions.Exit:
        return ""
    except click.UsageError as error:
        unfinished = isinstance(error, click.MissingParameter) or "requires an argument" in error.format_message()
        return "" if unfinished and not complete else f"{line}: {error.format_message()}"
    return ""


def is_setting(key: str) -> bool:
    kind: type[Settings] | None = MissionConfig
    for part in key.split("."):
        if kind is None or part not in kind.model_fields:
            return False
        annotation = kind.model_fields[part].annotation
        kind = annotation if isinstance(annotation, type) and issubclass(annotation, Settings) else None
    return True


def test_every_file_named_exists():
    assert faults(missing_files) == {}


def test_every_link_leads_somewhere():
    def broken(page, text):
        links = ["".join(groups).partition("#")[0] for groups in LINK.findall(text)]
        return [link for link in links if "://" not in link and not (page.parent / link).exists()]

    assert faults(broken) == {}


def test_every_symbol_is_in_its_file():
    assert faults(lambda _, text: missing_symbols(text)) == {}


@pytest.mark.slow
def test_every_command_parses():
    assert faults(lambda _, text: filter(None, (complaint(*command) for command in commands(text)))) == {}


def test_every_make_target_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert faults(lambda _, text: set(TARGET.findall(text)) - targets) == {}


def test_every_setting_exists():
    files = {"map.png", "map.ply", "map.pgm", "map.yaml"}
    assert faults(lambda _, text: {key for key in SETTING.findall(text) if not is_setting(key)} - files) == {}


def test_every_test_exists():
    files = (ROOT / "tests").rglob("test_*.py")
    defined = {
        name for file in files for name in re.findall(r"^def (test_\w+)\(", file.read_text("utf-8"), re.MULTILINE)
    }
    assert faults(lambda _, text: set(TEST.findall(text)) - defined) == {}


def test_each_line_of_the_threat_model_names_a_test():
    text = (ROOT / "docs" / "develop" / "security.md").read_text(encoding="utf-8")
    rows = [row for row in re.findall(r"^\|.*\|$", text, re.MULTILINE) if not row.endswith(("| test |", "---|"))]
    assert len(rows) > 20
    assert [row for row in rows if not TEST.search(row)] == []


def test_readme_is_short_and_starts_with_the_two_commands():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 120
    assert {"make demo", "make test"} <= {line.partition("#")[0].strip() for line in lines[:30]}


def pages_of(navigation: list[str | dict[str, Any]]) -> Iterator[str]:
    """The pages of a navigation of MkDocs."""
    for entry in navigation:
        for value in entry.values() if isinstance(entry, dict) else [entry]:
            yield from [value] if isinstance(value, str) else pages_of(value)


def test_the_navigation_lists_every_page_once():
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    docs = ROOT / "docs"
    assert sorted(pages_of(settings["nav"])) == sorted(str(page.relative_to(docs)) for page in docs.rglob("*.md"))


def test_the_table_of_rooms_is_in_the_order_of_imports():
    text = (ROOT / "docs" / "develop" / "architecture.md").read_text(encoding="utf-8")
    table = text[text.index("| part | room | contents |") :].partition("\n\n")[0]
    rooms = [room.replace(".", "/") for room in ROOMS if room != "lab"]
    assert re.findall(r"^\| \w* *\| `([\w/]+)` \|", table, re.MULTILINE) == rooms


def test_the_documented_example_writes_a_bag_that_can_be_read(tmp_path, monkeypatch):
    from fcslam.sources import open_source

    text = (ROOT / "docs" / "howto" / "logs.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "logs.md", "exec"), {})
    assert open_source(tmp_path / "robot1.mcap").survey().scan_count == 20


MESSAGE = re.compile(r"^\| `([^`]+)` \|", re.MULTILINE)
"""A message in the first column of a table of docs/troubleshooting.md; dots stand for what differs."""
BROKEN_TEXT = re.compile(r"\"\s*\n\s*f?\"")
"""Where a text in the source goes on in the next line."""


def test_the_page_on_results_explains_every_reason():
    text = (ROOT / "docs" / "howto" / "report.md").read_text(encoding="utf-8")
    assert [reason for reason in ReasonCode if f"`{reason}`" not in text] == []


def test_every_message_in_troubleshooting_is_one_of_the_code():
    text = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    code = "\n".join(BROKEN_TEXT.sub("", file.read_text(encoding="utf-8")) for file in PACKAGE.rglob("*.py"))
    parts = [part.strip("() ") for message in MESSAGE.findall(text) for part in message.split("...")]
    assert len(parts) > 40
    assert [part for part in parts if part not in code] == []
