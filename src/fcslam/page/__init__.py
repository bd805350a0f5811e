"""The web page of the live map."""

from pathlib import Path

ASSETS = Path(__file__).parent / "assets"
"""The files of the page."""
MODULES = (
    "words.js",
    "geometry.js",
    "service.js",
    "fleet.js",
    "heights.js",
    "map.js",
    "tools.js",
    "panels.js",
    "files.js",
    "page.js",
)
"""The page's script: a module imports only modules before it."""
