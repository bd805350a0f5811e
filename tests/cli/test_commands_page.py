"""The page of the commands is what their help says."""

from tools import reference_pages

PAGE = reference_pages.FOLDER / "commands.md"


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == reference_pages.commands_page(), "run: make docs"
