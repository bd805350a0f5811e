"""A real browser for the tests of the page and of the documentation site."""

import shutil
from contextlib import closing

import pytest

from tests import small_fleet


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: make browser-test")
    executable = shutil.which("chromium") or pytest.skip("no Chromium: make browser-test")
    options = ["--no-sandbox", "--disable-gpu"]
    with (
        playwright.sync_playwright() as started,
        closing(started.chromium.launch(executable_path=executable, args=options)) as chromium,
    ):
        yield chromium


@pytest.fixture(scope="module")
def packets():
    """Packets of three robots that drive 12 m each, longer than for other tests: their maps hold more to look at."""
    return small_fleet.in_order(p for robot in small_fleet.draw(3, 12.0).robots for p in small_fleet.sent_by(robot))
