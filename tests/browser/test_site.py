"""The documentation site in a real browser, on a desktop and on a phone: it fits, searches and asks no other host."""

import os
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

pytest.importorskip("material", reason="no MkDocs: make docs")
pytest.importorskip("mkdocstrings_handlers.python", reason="no mkdocstrings: make docs")

ROOT = Path(__file__).parents[2]
PAGES = ("index", "start/first-map", "howto/three-d", "troubleshooting", "reference/commands", "results/mapping")

CUT_WORDS = """() => [...document.querySelectorAll("article code .word")]
    .filter((word) => word.getClientRects().length > 1).map((word) => word.textContent)"""
"""Options of which a part stands on the next line."""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The address of the site: that of `make docs`, if it is as new as its sources."""
    folder = ROOT / "site"
    sources = (ROOT / "mkdocs.yml", *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.py"))
    built = folder / "sitemap.xml"
    if not built.exists() or built.stat().st_mtime < max(path.stat().st_mtime for path in sources):
        folder = tmp_path_factory.mktemp("site")
        subprocess.run(
            [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)],
            cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, check=True, timeout=600,
        )  # fmt: skip
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_pages_fit_and_ask_no_other_host(site, browser, width, height):
    page = browser.new_page(viewport={"width": width, "height": height})
    asked, errors = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: errors.append(error))  # noqa: PLW0108 - Playwright sets an attribute on it
    for name in PAGES:
        page.goto(f"{site}/{name}.html")
        assert page.locator("h1").is_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name
        assert page.evaluate(CUT_WORDS) == [], name
    assert [url for url in asked if not url.startswith(site)] == []
    assert errors == []
    page.close()


def test_search_finds_a_setting(site, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(f"{site}/index.html")
    page.locator(".md-search-result__meta", has_text="Type to start searching").wait_for(
        state="attached", timeout=30_000
    )
    page.locator("input.md-search__input").press_sequentially("minimum_evidence")
    # The list also shows what each shorter word finds, as it is typed.
    page.locator(".md-search-result__item", has_text="Settings").first.wait_for(timeout=30_000)
    page.close()


def test_tables_of_commands_show_a_choice_as_it_is_typed(site, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(f"{site}/reference/commands.html")
    names = page.locator("td:first-child > code").all_inner_texts()
    assert "-c, --config FILE|KEY=VALUE" in names
    page.close()
