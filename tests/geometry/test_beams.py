"""Which scans can be of one laser, by their beams."""

from math import nan, pi, radians, tau

import pytest

from fcslam.geometry.beams import beam_step, is_same_laser, misfit, spread
from fcslam.records import Beams, LaserModel

DEGREE = radians(1.0)
SICK = Beams(181, -pi / 2, DEGREE)
TURN = Beams(1100, -pi, tau / 1100)


@pytest.mark.parametrize(
    ("beams", "declared"),
    [
        *((Beams(180, -pi / 2 + share * DEGREE, DEGREE), SICK) for share in (0.0, 0.25, 0.5, 0.75, 1.0)),
        *((SICK, Beams(180, -pi / 2 + share * DEGREE, DEGREE)) for share in (0.25, 0.75)),
        *((Beams(n, -pi, tau / n), TURN) for n in (1080, 1150, 1600, 750)),
        (Beams(1101, -pi, tau / 1100), TURN),
        (Beams(1099, -pi, tau / 1100), TURN),
        (Beams(1100, 0.0, tau / 1100), TURN),
        (Beams(1100, 1.0, tau / 1100), TURN),
        (Beams(181, 1.5 * pi, DEGREE), SICK),
        (Beams(181, -pi / 2 + 0.03, DEGREE), SICK),
    ],
)
def test_variations_of_one_laser(beams, declared):
    assert misfit(beams, declared) is None
    assert misfit(declared, beams) is None


@pytest.mark.parametrize("count", [1000, 1099, 1101, 1300])
def test_more_or_fewer_beams_spread_over_the_same_turn(count):
    for sign in (1, -1):
        declared = Beams(1100, -sign * pi, sign * tau / 1100)
        assert spread(count, declared) == pytest.approx(Beams(count, -sign * pi, sign * tau / count))
        assert misfit(spread(count, declared), declared) is None


@pytest.mark.parametrize("count", [170, 180, 182, 200])
def test_more_or_fewer_beams_spread_over_the_same_view(count):
    assert spread(count, SICK).span_rad == pytest.approx(SICK.span_rad)
    assert misfit(spread(count, SICK), SICK) is None


@pytest.mark.parametrize(
    ("beams", "declared", "reason"),
    [
        (Beams(100, -pi, tau / 100), Beams(360, -pi, tau / 360), "3.6 degrees apart, the laser's 1"),
        (Beams(100, -pi, DEGREE), Beams(360, -pi, DEGREE), "-180.0 to -81.0 degrees, the laser over -180.0 to 179.0"),
        (Beams(361, -pi / 2, DEGREE / 2), SICK, "0.5 degrees apart"),
        (Beams(181, pi / 2, -DEGREE), SICK, "the other way"),
        (Beams(181, -pi / 2 + 0.1, DEGREE), SICK, "looks over"),
        (Beams(171, -pi / 2, DEGREE), SICK, "looks over"),
        (Beams(271, -0.75 * pi, DEGREE), SICK, "looks over"),
    ],
)
def test_another_laser(beams, declared, reason):
    assert reason in misfit(beams, declared)
    assert misfit(declared, beams) is not None


def test_an_increment_that_is_none_is_no_variation():
    assert misfit(Beams(181, -pi / 2, 0.0), SICK) is not None
    assert misfit(Beams(181, nan, DEGREE), SICK) is not None
    assert misfit(Beams(181, -pi / 2, nan), SICK) is not None


def test_a_laser_is_known_by_its_mounting_too():
    front = LaserModel(*SICK, 50.0, (0.2, 0.0, 0.0))
    assert is_same_laser(front, front.with_beams(Beams(180, -pi / 2 + 0.25 * DEGREE, DEGREE)))
    assert not is_same_laser(front, LaserModel(*SICK, 50.0, (-0.2, 0.0, pi)))
    assert not is_same_laser(front, LaserModel(*SICK, 30.0, (0.2, 0.0, 0.0)))


def test_beams_that_turn_clockwise_or_not_at_all_have_a_step_too():
    assert beam_step(Beams(3600, pi, -tau / 3600)) == 5
    assert beam_step(Beams(3600, pi, 0.0)) == beam_step(Beams(3600, pi, nan)) == 1
