"""Named configurations: YAML files in this folder with the keys that differ from the defaults."""

from enum import StrEnum
from pathlib import Path


class Preset(StrEnum):
    """Named configurations."""

    PAPER = "paper"
    """FC-SLAM to the letter: words alone decide, a new vocabulary for each set of places, rigid maps."""

    @property
    def file(self) -> Path:
        """Its keys, as ``--config`` takes them."""
        return Path(__file__).with_name(f"{self}.yaml")
