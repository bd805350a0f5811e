"""Kinds of building, scanner, odometry and lighting, for the command line. Imports no library, so that help is fast."""

from enum import StrEnum


class Building(StrEnum):
    """Kinds of building."""

    FLAT = "flat"
    DEFAULT = "default"
    OFFICE = "office"
    CORRIDOR = "corridor"


class Scanner(StrEnum):
    """Scanners. Those named after a product measure each beam at its own time, the others all beams at once."""

    INSTANT = "instant"
    """10 Hz, 360 beams, 12 m."""
    RPLIDAR_A1 = "rplidar-a1"
    """Low-cost, 5.5 Hz, 8,000 beams a second, 12 m; clockwise."""
    LD19 = "ld19"
    """Low-cost, 10 Hz, 4,500 beams a second, 12 m; clockwise."""
    UTM_30LX = "utm-30lx"
    """40 Hz, 1081 beams over 270 degrees, 30 m; counter-clockwise."""


class OdometryKind(StrEnum):
    """Kinds of wheel odometry. Those from ``scaled`` on are ``good`` but for one fault."""

    DEFAULT = "default"
    """A cheap indoor robot with small slips."""
    GOOD = "good"
    """Right to a few percent of the distance and about a degree in 10 m, without slips."""
    SLIPPING = "slipping"
    """Slips by up to 0.7 m between two scans."""
    SCALED = "scaled"
    """Distances and turns are wrong by a constant factor, by 8 % in the mean of many robots."""
    CARPET = "carpet"
    """A quarter of the floor is carpet, on which the wheels turn by 20 % more than the robot moves."""
    STEPS = "steps"
    """The pose changes five times a second only."""
    LATE = "late"
    """Messages have a stamp that is 0.2 s late."""
    RESET = "reset"
    """Starts at zero again in the middle of the drive."""
    NONE = "none"
    """The robot has no odometry."""


class Lighting(StrEnum):
    """Kinds of lighting."""

    DAY = "day"
    EVENING = "evening"
    LAMP_OFF = "lamp-off"
    """Daylight, with one lamp in three failed."""
