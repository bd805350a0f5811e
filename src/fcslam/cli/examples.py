"""Examples in the help of commands."""

LONGEST = 78
"""Characters of a line that a terminal of 80 columns shows whole; typer breaks longer ones."""


def examples(*commands: str) -> str:
    """The epilog of a command's help: one example on each line, to be copied as it stands."""
    return "\n\n".join(("Examples:", *commands))  # typer removes single line breaks
