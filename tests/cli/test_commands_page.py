"""The page of the commands is what their help says."""

from tools import reference_pages

PAGE = reference_pages.FOLDER / "commands.md"


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == reference_pages.commands_page(), "run: make docs"


def test_every_command_has_a_section_with_its_options():
    page = reference_pages.commands_page()
    assert "## fcslam map\n" in page
    assert "### fcslam evaluate relations\n" in page
    assert "| `--split INTEGER RANGE` | 1; x>=1 | Split the one LOG" in page
    assert "| `RECORDING` | required |" in page
