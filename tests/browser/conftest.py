"""A real browser for the tests of the page and of the documentation site."""

import shutil
from contextlib import closing

import pytest


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
