"""The web page of the live map."""

from pathlib import Path

ASSETS = Path(__file__).parent / "assets"
"""The files of the page."""
