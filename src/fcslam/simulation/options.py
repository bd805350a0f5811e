"""Kinds of building, odometry and lighting, for the command line. Imports no library, so that help is fast."""

from enum import StrEnum


class Building(StrEnum):
    """Kinds of building."""

    FLAT = "flat"
    DEFAULT = "default"
    OFFICE = "office"
    CORRIDOR = "corridor"
    YARD = "yard"
    """Outdoors, between buildings."""


class OdometryKind(StrEnum):
    """Kinds of wheel odometry."""

    DEFAULT = "default"
    """A cheap indoor robot with small slips."""
    GOOD = "good"
    """Right to a few percent of the distance and about a degree in 10 m, without slips."""
    SLIPPING = "slipping"
    """Slips by up to 0.7 m between two scans."""


class Lighting(StrEnum):
    """Kinds of lighting."""

    DAY = "day"
    EVENING = "evening"
    LAMP_OFF = "lamp-off"
    """Daylight, with one lamp in three failed."""
