"""What can be chosen by name: kinds of building and of lighting. Loads nothing, for the command line's help."""

from enum import StrEnum


class Building(StrEnum):
    """The kinds of building."""

    FLAT = "flat"
    DEFAULT = "default"
    OFFICE = "office"
    CORRIDOR = "corridor"


class Lighting(StrEnum):
    """What a robot sees by."""

    DAY = "day"
    EVENING = "evening"
    LAMP_OFF = "lamp-off"
    """By day, and one lamp in three has failed."""
