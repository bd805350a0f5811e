"""Kinds of building, LiDAR, odometry and lighting, for the command line. Imports no library, so that help is fast."""

from enum import StrEnum


class Building(StrEnum):
    """Kinds of building."""

    FLAT = "flat"
    DEFAULT = "default"
    OFFICE = "office"
    CORRIDOR = "corridor"
    YARD = "yard"
    """Outdoors, between buildings."""


class LidarKind(StrEnum):
    """Kinds of LiDAR, by what varies from scan to scan."""

    STEADY = "steady"
    """The beams never vary."""
    INTERLEAVED = "interleaved"
    """As a SICK: scans in cycles of four, each a quarter of an increment further, the first with one beam more."""
    JITTERING = "jittering"
    """As an RPLIDAR: number and increment of the beams follow the motor; now and then a beam is missing."""
    FRONT_REAR = "front-rear"
    """Two LiDARs of half a turn at most, one at the front and one at the rear."""


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
