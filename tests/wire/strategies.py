"""Valid packets of every kind, for hypothesis."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fcslam.geometry import se3
from fcslam.geometry.voxels import to_steps, voxelised
from fcslam.records import (
    PLACE_CHANNELS,
    Constraint,
    ConstraintKind,
    Correction,
    DetectorFile,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    Place,
    Sweep,
    Tag,
    TagFamily,
    TagSighting,
    VoxelMap,
)
from fcslam.wire.limits import KEYPOINT_AXES
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.quantisation import dequantise, quantise_keypoints
from fcslam.wire.streams import ascending

NAMES = st.text("AZaz09._+-", min_size=0, max_size=63).map(lambda rest: "a" + rest)
SEQUENCES = st.integers(0, 2**63 - 1)
EPOCHS = st.integers(0, 2**31 - 1)
NUMBERS = st.integers(0, 2**31 - 1)
STAMPS = st.floats(allow_nan=False, allow_infinity=False)
COORDINATES = st.floats(-1e6, 1e6)
ANGLES = st.floats(-np.pi, np.pi)
POSES = st.tuples(COORDINATES, COORDINATES, ANGLES)


def poses():
    return POSES.map(np.array)


def lasers():
    return st.builds(
        LaserModel,
        beam_count=st.integers(1, 4096),
        angle_min_rad=ANGLES,
        angle_increment_rad=st.floats(1e-6, 2 * np.pi / 4096) | st.floats(-2 * np.pi / 4096, -1e-6),
        max_range_m=st.floats(0.1, 1000.0),
        T_base_laser=POSES,
    )


def space_poses():
    tangent = st.tuples(*3 * (COORDINATES,), *3 * (st.floats(-1.8, 1.8),))
    return tangent.map(lambda v: np.append(v[:3], se3.exp((0.0, 0.0, 0.0, *v[3:]))[3:]))


@st.composite
def informations(draw, freedom=3):
    """Correlations bounded away from singular, standard deviations from 0.1 mm to 100 m."""
    factor = draw(hnp.arrays(np.float64, (freedom, freedom), elements=st.floats(-1.0, 1.0)))
    deviation = 10.0 ** np.array(draw(st.tuples(*[st.floats(-4.0, 2.0)] * freedom)))
    matrix = (factor @ factor.T + 0.01 * np.eye(freedom)) / deviation / deviation[:, np.newaxis]
    return (matrix + matrix.T) / 2.0


def codes():
    return hnp.arrays(np.uint16, st.integers(1, 200), elements=st.integers(0, 65535), fill=st.integers(0, 65535))


def descriptors(count):
    return st.binary(min_size=32 * count, max_size=32 * count).map(
        lambda data: np.frombuffer(data, np.uint8).reshape(-1, 32)
    )


@st.composite
def places(draw, robot):
    """With keypoints in the order in which they travel."""
    count = draw(st.integers(0, 20))
    first = draw(NUMBERS)
    last = draw(st.integers(first, 2**31 - 1))
    channel = draw(st.sampled_from(PLACE_CHANNELS))
    shape = (count, KEYPOINT_AXES[channel])
    keypoints = draw(hnp.arrays(np.float32, shape, elements=st.floats(-327.0, 327.0, width=32)))
    return Place(
        KeyscanId(robot, draw(st.integers(first, last))),
        channel,
        draw(NAMES),
        first,
        last,
        keypoints[ascending(quantise_keypoints(keypoints))],
        draw(descriptors(count)),
    )


@st.composite
def constraints(draw, robot):
    j = draw(st.integers(1, 2**31 - 1))
    i = draw(st.integers(0, j - 1))
    pose, freedom = draw(st.sampled_from([(poses(), 3), (space_poses(), 6)]))
    return Constraint(robot, i, j, draw(st.sampled_from(ConstraintKind)), draw(pose), draw(informations(freedom)))


@st.composite
def voxel_maps(draw, robot):
    first = draw(NUMBERS)
    last = draw(st.integers(first, 2**31 - 1))
    number = draw(st.integers(first, last))
    positions = hnp.arrays(np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-6.4, 12.7))
    returns, origins_m = draw(positions), draw(positions)
    scans = np.arange(len(returns)) % len(origins_m)
    points, seen_from = voxelised(returns, scans, origins_m)
    return VoxelMap(KeyscanId(robot, number), first, last, draw(space_poses()), points, to_steps(origins_m), seen_from)


def tags():
    return st.builds(Tag, st.sampled_from(TagFamily), st.integers(0, 4095))


def detector_files():
    digests = st.binary(min_size=32, max_size=32)
    return st.builds(DetectorFile, st.sampled_from(PLACE_CHANNELS), NAMES, NUMBERS, st.integers(1, 2**26), digests)


@st.composite
def keyscans(draw, identities, stamps):
    ranges = draw(codes().map(dequantise) | st.just(np.zeros(0, np.float32)))
    laser = draw(lasers())
    beams = draw(st.none() | st.just(laser.beams._replace(beam_count=len(ranges)))) if len(ranges) else None
    sweep = draw(st.none() | sweeps()) if len(ranges) else None
    return Keyscan(draw(identities), draw(stamps), ranges, draw(st.integers(0, 7)), beams, sweep)


def sweeps():
    number = st.integers(-2000, 2000)
    return st.builds(
        lambda first, last, motion: Sweep.of_steps((first, last, *motion)),
        st.integers(-2_000_000, -1),
        st.integers(0, 2_000_000),
        st.tuples(*6 * (number,)),
    )


@st.composite
def hellos(draw, robot, epoch):
    versions = draw(st.dictionaries(st.sampled_from(PLACE_CHANNELS), NAMES))
    return Hello(
        robot,
        epoch,
        draw(st.lists(lasers(), min_size=1, max_size=8).map(tuple)),
        versions,
        draw(st.from_regex(r"([A-Za-z0-9._+-]{1,16})?", fullmatch=True)),
    )


def keyscan_fixes(identity):
    arms = st.floats(-50.0, 50.0)
    return st.builds(
        KeyscanFix, identity, st.floats(-90.0, 90.0), st.floats(-360.0, 360.0), st.floats(-1e5, 1e5),
        st.floats(1e-3, 1e4), st.tuples(arms, arms),
    )  # fmt: skip


def bodies(robot, epoch, time):
    stamps = st.floats(max_value=time, allow_nan=False, allow_infinity=False)
    identity = st.builds(KeyscanId, st.just(robot), NUMBERS)
    return st.one_of(
        hellos(robot, epoch),
        keyscans(identity, stamps),
        constraints(robot),
        places(robot),
        voxel_maps(robot),
        st.builds(TagSighting, identity, tags(), poses(), informations()),
        keyscan_fixes(identity),
        st.builds(Correction, st.just(robot), NUMBERS, NUMBERS, poses() | space_poses(), st.floats(0.0, 1.0, width=32)),
        st.builds(Acknowledgement, st.just(robot), EPOCHS, SEQUENCES),
        st.builds(DetectorUpdate, st.just(robot), detector_files()),
    )


@st.composite
def packets(draw):
    robot, epoch, sequence, time = draw(NAMES), draw(EPOCHS), draw(SEQUENCES), draw(STAMPS)
    return Packet(robot, epoch, sequence, time, draw(bodies(robot, epoch, time)))
