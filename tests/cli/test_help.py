"""Help: every command has examples that can be copied, and shells complete commands, options and files."""

import os
import shlex
import subprocess
import sys

import click
import pytest
import typer

from fcslam.cli import EXAMPLES, app, main
from tests.test_docs import complaint


def tree(command, path=()):
    """Every command and group with the words that call it."""
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from tree(inner, (*path, name))


COMMANDS = dict(tree(typer.main.get_command(app)))
HEAVY = ["numpy", "pydantic", "fastapi", "httpx"]
"""Each command that works imports one of them."""
every_command = pytest.mark.parametrize("words", COMMANDS, ids=" ".join)


@every_command
def test_every_command_explains_its_options_and_has_examples_each_whole_on_its_line(words, capsys, monkeypatch):
    assert [parameter.name for parameter in COMMANDS[words].params if not parameter.help] == []
    heading, *examples = COMMANDS[words].epilog.split("\n\n")
    assert heading == "Examples:"
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*words, "--help"]) == 0
    shown = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert shown[shown.index("Examples:") + 1 :][: len(examples)] == examples
    assert [complaint(example, complete=True) for example in examples] == [""] * len(examples)
    called = [tuple(shlex.split(example)[1 : len(words) + 1]) for example in examples]
    assert words in called


def test_every_line_of_the_examples_is_of_a_command():
    shown = {example for command in COMMANDS.values() for example in command.epilog.split("\n\n")}
    assert set(EXAMPLES.splitlines()) - shown == set()


def test_commands_that_run_long_can_be_quiet():
    quiet = {words for words, one in COMMANDS.items() if any("--quiet" in option.opts for option in one.params)}
    assert quiet == {(name,) for name in ("map", "robot", "play", "localize", "record", "serve", "demo")}


def test_the_house_stays_small():
    commands = {words: command for words, command in COMMANDS.items() if not isinstance(command, click.Group)}
    options = [sum(isinstance(one, click.Option) for one in command.params) for command in commands.values()]
    assert len(COMMANDS[()].commands) <= 12
    assert max(options) <= 16


# Completion


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_script_calls_fcslam(shell):
    command = [sys.executable, "-m", "fcslam.cli", "--show-completion", shell]
    environment = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    shown = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert f"_FCSLAM_COMPLETE=complete_{shell}" in shown


def completed(line):
    """The completions of bash, and the heavy modules that they loaded."""
    words = line.split(" ")
    program = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr))\n"
        "from fcslam.cli import main\n"
        "main()"
    )
    asked = {"_FCSLAM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, **asked}, capture_output=True, text=True, check=True
    )
    return done.stdout.split(), done.stderr.strip()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("fcslam ma", ["map"]),
        ("fcslam map --on", ["--onto"]),
        ("fcslam tools simulate --building of", ["office"]),
        ("fcslam tools extract pho", []),
        ("fcslam map --output ru", []),
    ],
)
def test_shells_complete_commands_options_and_choices_and_themselves_files(line, offered):
    assert completed(line) == (offered, "[]")
