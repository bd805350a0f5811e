"""The beams of a laser: whether a scan can be of it, and how many of them a map needs."""

from math import copysign, degrees, pi, radians, remainder, tau

from fcslam.records import Beams, LaserModel

LARGEST_RATIO = 1.5
"""Largest ratio of the increments of two scans of one laser. Scanners whose motor varies stay well below; the next
resolution of a scanner is twice as fine."""
SAME_VIEW_RAD = 0.05
"""Tolerance of the first and the last direction of a field of view."""
SAME_VIEW_BEAMS = 1.5
"""The same in increments, if that is more: interleaved scans, one beam more or less, rounded headers."""

FINEST_RAD, COARSEST_RAD = radians(0.25), radians(0.5)
"""If beams are closer together than the first, every k-th one is mapped, at most the second apart. The
normals of returns are fitted to few neighbours, which must be farther apart than the noise of a range."""
ROUNDING = 0.01
"""Share by which headers round an increment."""

FULL_TURN_RAD = 2.0 * pi
LARGEST_SPAN_RAD = 1.01 * FULL_TURN_RAD
"""From the first to the last beam, which may coincide; drivers round the increment."""


def is_field_of_view(beams: Beams) -> bool:
    """Whether some laser can have these beams: two or more, from a direction within a full turn, over one at most."""
    return (
        beams.beam_count >= 2
        and abs(beams.angle_min_rad) <= FULL_TURN_RAD
        and 0.0 < abs(beams.span_rad) <= LARGEST_SPAN_RAD
    )


def misfit(beams: Beams, declared: Beams) -> str | None:
    """Why a scan with ``beams`` cannot be of the laser that was declared with the beams ``declared``.

    Interleaved scans, an increment that follows the motor's speed, a missing beam and the overlapping beam of a full
    turn are variations of one laser. NaN belongs to no laser. None: the scan can be of this laser.
    """
    if beams == declared:
        return None
    increment, other = beams.angle_increment_rad, declared.angle_increment_rad
    if not increment * other > 0.0:  # every condition fails for NaN
        return "its beams turn the other way"
    wide, narrow = max(abs(increment), abs(other)), min(abs(increment), abs(other))
    if wide > LARGEST_RATIO * narrow:
        return f"its beams are {degrees(abs(increment)):.3g} degrees apart, the laser's {degrees(abs(other)):.3g}"
    tolerance_rad = max(SAME_VIEW_RAD, SAME_VIEW_BEAMS * wide)
    if all(abs(view.span_rad + view.angle_increment_rad) > FULL_TURN_RAD - tolerance_rad for view in (beams, declared)):
        return None  # a full turn has no first direction
    first_rad = remainder(beams.angle_min_rad - declared.angle_min_rad, tau)
    last_rad = first_rad + beams.span_rad - declared.span_rad
    if not (abs(first_rad) <= tolerance_rad and abs(last_rad) <= tolerance_rad):
        return f"it looks over {_view(beams)}, the laser over {_view(declared)}"
    return None


def spread(count: int, declared: Beams) -> Beams:
    """``count`` beams, 2 or more, evenly over the field of view that the laser was declared with."""
    if is_full_turn(declared):
        increment_rad = copysign(FULL_TURN_RAD, declared.angle_increment_rad) / count
        return Beams(count, declared.angle_min_rad, increment_rad)
    return Beams(count, declared.angle_min_rad, declared.span_rad / (count - 1))


def is_full_turn(beams: Beams) -> bool:
    """Whether the beams look all around, so that the last one is beside the first."""
    tolerance_rad = max(SAME_VIEW_RAD, SAME_VIEW_BEAMS * abs(beams.angle_increment_rad))
    return abs(beams.span_rad + beams.angle_increment_rad) > FULL_TURN_RAD - tolerance_rad


def beam_step(beams: Beams) -> int:
    """The k of the every k-th beam that is mapped, 1 or more; the first beam and another one remain."""
    increment_rad = abs(beams.angle_increment_rad)
    if not 0.0 < increment_rad < (1.0 - ROUNDING) * FINEST_RAD:  # true for NaN
        return 1
    return max(1, min(int((1.0 + ROUNDING) * COARSEST_RAD / increment_rad), beams.beam_count - 1))


def is_same_laser(a: LaserModel, b: LaserModel) -> bool:
    """Whether scans with these models can be of one laser."""
    if a is b:
        return True
    fixed = a.T_base_laser == b.T_base_laser and a.max_range_m == b.max_range_m
    return fixed and misfit(a.beams, b.beams) is None


def _view(beams: Beams) -> str:
    first, last = degrees(beams.angle_min_rad), degrees(beams.angle_min_rad + beams.span_rad)
    return f"{first:.1f} to {last:.1f} degrees"
