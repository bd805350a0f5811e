"""Kinds of building and of lighting, for the command line. Imports no library, so that help is fast."""

from enum import StrEnum


class Building(StrEnum):
    """Kinds of building."""

    FLAT = "flat"
    DEFAULT = "default"
    OFFICE = "office"
    CORRIDOR = "corridor"


class Lighting(StrEnum):
    """Kinds of lighting."""

    DAY = "day"
    EVENING = "evening"
    LAMP_OFF = "lamp-off"
    """Daylight, with one lamp in three failed."""
