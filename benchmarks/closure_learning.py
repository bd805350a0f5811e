"""What a detector learns from the fleet's own closures: federated training on places that robots saw again.

    python benchmarks/closure_learning.py --fleets FOLDER [--keep ROWS.jsonl] [--train 301 ...] [--test 401 ...]

Simulated fleets of three robots, 45 m each, by day, in the evening and with a third of the lamps off; half of the
furniture moves before the second and the third robot. In the training buildings three more robots drive later, in the
same three kinds of light, among other furniture. Each training fleet is mapped by camera places alone. From its
estimated poses and accepted closures come the examples (`learning/revisits.py`, `cloud/teaching.py`): pairs of a
robot's own keyframes, codes that at least two places of other robots agree on, and labels of keypoints by whether they
were found again. True poses serve the evaluation only.

All networks start from the bundled one. By default only the head of the codes is trained, so all find the same
keypoints. Federated arms have every robot of every building as a client, and a third of them trains in a round. Central
training has as many steps as all robots together, and a robot alone as many as one that trains in every round.

- homographies: two views of one image under a random homography, labels from the bundled detector, federated
- own revisits: that, pairs of each robot's own keyframes, and labels by what was found again, federated
- closures: that, and the codes of other robots, federated
- central: homographies, own pairs, and pairs across robots, whose images are in one place
- alone: own revisits, one robot in each of three buildings; the mean over the three networks

Measured on unseen buildings and on later drives, between robots in different light, at places that an image shows every
metre or half radian. Keypoint recall: mutual nearest neighbours of 300 keypoints that are right to 3 px by the true
poses, divided by the keypoints that have a partner. Candidates: all pairs of images of two robots, by the inliers of
the best motion; right if the views overlap by a half, wrong if by less than a tenth. Intervals are 95 %, by bootstrap
over buildings, of the difference to the bundled detector.

All seeds were fixed before the first run. --keep resumes by arm and seed. It needs a GL library, and with the default
size about two hours of one core; `--train 301 302 --test 401 402 403 404 --seeds 1` takes some ten minutes.
"""

import pickle
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import common
import numpy as np
import torch

from fcslam.cloud.teaching import PlacePoints, teach
from fcslam.evaluation.federated.mapped_drives import MappedDrive, Tie, map_drives, ties
from fcslam.evaluation.places.sets import OTHER_OVERLAP, SAME_OVERLAP
from fcslam.evaluation.places.simulated_views import EVERY_M, EVERY_RAD, lidar_overlap
from fcslam.features.codes import Matches, mutual_matches
from fcslam.features.detector import BUNDLED_NETWORK, FeatureDetector, OnnxConfig, OnnxDetector, decode_grey
from fcslam.features.lidar_depth import LidarView
from fcslam.federated.client import RobotClient, seeded_noise
from fcslam.federated.client_app import build_client_app
from fcslam.federated.codec import weights_to_network, weights_version
from fcslam.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.federated.flower import InProcessGrid
from fcslam.federated.initial_weights import prepare_initial_weights
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights
from fcslam.geometry import se2
from fcslam.learning.export import export_onnx
from fcslam.learning.local_training import LocalTrainingPlan, local_training
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.revisit_batches import RevisitExamples, RevisitPair, TaughtImage
from fcslam.learning.revisits import Keyframe, correspond, predict, revisit_labels
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.stages import TrainingImages
from fcslam.learning.trainer import ExecutionOptions
from fcslam.lidar.scan import point_scan
from fcslam.metrics.bootstrap import mean_interval
from fcslam.metrics.retrieval import PairTruth, multi_match_curve
from fcslam.metrics.trajectory import interpolate
from fcslam.mission import MissionConfig
from fcslam.places.hypotheses import rigid_hypotheses
from fcslam.places.motions import MotionConfig
from fcslam.records import CameraImage, CameraModel, Channel, FloatArray, LaserScan
from fcslam.robot.frontend import RobotConfig
from fcslam.simulation.options import Lighting
from fcslam.simulation.recording import prepare_fleet_folder, record_robot
from fcslam.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
from fcslam.sources import Recording

TRAIN, TEST, SEEDS = tuple(range(301, 311)), tuple(range(401, 411)), (1, 2, 3)
ROBOTS = ("robot_1", "robot_2", "robot_3")
LATER = ("robot_4", "robot_5", "robot_6")
LIGHT = (Lighting.DAY, Lighting.EVENING, Lighting.LAMP_OFF)
FEWEST_POINTS = 12
"""Correspondences of a pair, or taught points of an image, that make it an example."""
FARTHEST_M = 4.0
"""Places farther apart teach each other nothing."""
CORRECT_PX = 3.0
PAIR_OVERLAP = 0.2
"""Least overlap of two views between which keypoint recall is measured."""
PAIRS_A_BUILDING = 120
"""Most pairs of views per building on which keypoint recall is measured."""
ALONE = 3
"""Robots that train alone."""
ARMS = ("bundled", "homographies", "own revisits", "closures", "central", "alone")
UNSEEN, LATER_DRIVES = "unseen buildings", "later drives"
MEASURES = ("keypoint recall", "precision", "matches a pair", "average precision", "recall at 95 %", "recall at 100 %")
COLUMNS = {"": "s", "seeds": "d"} | dict.fromkeys(MEASURES, "s")
ROWS = {"arm": "s", "seed": "d", "on": "s", "building": "d"} | dict.fromkeys(MEASURES, ".4f")


@dataclass(frozen=True, slots=True, eq=False)
class TrueView:
    """An image with the true pose, for the evaluation."""

    robot: str
    picture: np.ndarray
    camera: CameraModel
    surroundings: tuple[LidarView, ...]
    T_building_base: FloatArray
    scan: LaserScan


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """What one robot has to train on."""

    robot: str
    plain: tuple[TrainingExample, ...]
    """Keyframes with labels from the bundled detector."""
    labelled: tuple[TrainingExample, ...]
    """Keyframes with labels by what was found again."""
    pairs: tuple[RevisitPair, ...]
    taught: tuple[TaughtImage, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """What one building gives for training."""

    robots: tuple[Examples, ...]
    across: tuple[RevisitPair, ...]
    """Pairs of images of two robots, which only central training may use."""
    taught_bytes: int
    within_ties: int
    between_ties: int


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, required=True, help="folder of recordings; those missing are made there")
    parser.add_argument("--train", nargs="+", type=int, default=TRAIN, help="seeds of the training buildings")
    parser.add_argument("--test", nargs="+", type=int, default=TEST, help="seeds of the unseen buildings")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of training")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS, help="which networks")
    parser.add_argument("--rounds", type=int, default=40, help="of federated training")
    parser.add_argument("--local-steps", type=int, default=10, help="of a robot in a round")
    parser.add_argument("--trained", choices=("codes", "all"), default="codes", help="layers")
    parser.add_argument("--keep", type=Path, help="file that keeps finished arms; the same one resumes")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__ or "", chosen)
    fleets = [recorded(seed, 6, chosen.fleets) for seed in chosen.train]
    unseen = [recorded(seed, 3, chosen.fleets) for seed in chosen.test]
    examples = [fleet_examples(folder, chosen.fleets) for folder in fleets]
    settings = FederatedSettings(
        rounds=chosen.rounds, local_steps=chosen.local_steps, participation=1.0 / len(ROBOTS), normalisation="frozen",
        compatible=1.0, trained=chosen.trained,
        training=TrainingSettings(pairs=2, side_px=160, points=160, learning_rate=1e-3),
    )  # fmt: skip
    rows = []
    for arm in (arm for arm in ARMS if arm in chosen.arms):
        for seed in chosen.seeds[: 1 if arm == "bundled" else None]:
            with tempfile.TemporaryDirectory() as place:
                train = partial(trained, arm, seed, examples, settings, Path(place))
                key = (arm, seed, chosen.trained, chosen.rounds, chosen.local_steps, *chosen.train, *chosen.test)
                measure = partial(arm_rows, arm, seed, train, fleets, unseen)
                rows += kept.rows(key, measure)
            print(arm, seed, rows[-1], file=sys.stderr, flush=True)
    report.table("Examples", EXAMPLES, map(examples_row, chosen.train, examples))
    for on in (UNSEEN, LATER_DRIVES):
        report.table(f"Above the bundled detector, {on}", COLUMNS, gains(rows, on))
        report.table(f"Means, {on}", COLUMNS, means(rows, on))
    report.table("Buildings", ROWS, rows)
    report.write()


EXAMPLES = {"building": "d", "keyframes": "d", "own pairs": "d", "pairs across robots": "d", "taught images": "d",
            "taught points": "d", "kB received": ".0f"}  # fmt: skip


def examples_row(seed: int, fleet: Fleet) -> tuple:
    robots = fleet.robots
    taught = [image for robot in robots for image in robot.taught]
    return (
        seed, sum(len(robot.plain) for robot in robots), sum(len(robot.pairs) for robot in robots), len(fleet.across),
        len(taught), sum(len(image.points) for image in taught), fleet.taught_bytes / 1e3,
    )  # fmt: skip


def recorded(seed: int, robots: int, folder: Path) -> Path:
    """The recordings of one building; what is there already is not made again."""
    settings = SimulationSettings(
        robots=robots, path_length_m=45.0, lighting=LIGHT, moved_furniture=0.5, camera=CameraSettings(rate_hz=2.0)
    )
    place = folder / str(seed)
    prepare_fleet_folder(place, settings, seed, resume=True)
    for robot in simulate_fleet(settings, seed).robots:
        record_robot(robot, place / robot.name, resume=True)
    return place


def fleet_examples(folder: Path, kept: Path) -> Fleet:
    """Map a fleet by camera places alone and collect what its robots learn from; kept in a file for each commit."""
    file = kept / f"examples-{folder.name}-{common.commit()}.pickle"
    if not file.exists():
        config = MissionConfig(robot=RobotConfig(channels=(Channel.CAMERA,)))
        sources = [Recording(folder / name, name) for name in ROBOTS]
        drives, run = map_drives(sources, config, OnnxDetector(OnnxConfig()))
        within, between = list(ties(drives, run, within=True)), list(ties(drives, run, within=False))
        file.write_bytes(pickle.dumps(examples_of(drives, within, between)))
    fleet: Fleet = pickle.loads(file.read_bytes())
    print(folder.name, examples_row(int(folder.name), fleet), file=sys.stderr, flush=True)
    return fleet


def examples_of(drives: dict[str, MappedDrive], within: Sequence[Tie], between: Sequence[Tie]) -> Fleet:
    """Pairs, taught images and labels from keyframes that accepted closures connect."""
    shown, found = defaultdict(list), defaultdict(list)
    pairs: dict[str, list[RevisitPair]] = {name: [] for name in drives}
    for tie in within:
        first, second = drives[tie.robot_i].keyframes[tie.i], drives[tie.robot_j].keyframes[tie.j]
        for each, other, T, key in (
            (first, second, tie.T_i_j, (tie.robot_i, tie.i)),
            (second, first, se2.inverse(tie.T_i_j), (tie.robot_j, tie.j)),
        ):
            same = correspond(each, other, T)
            if len(same.rows) >= FEWEST_POINTS:
                again = np.zeros(len(same.shown), np.bool_)
                again[same.rows[:, 0]] = True
                shown[key].append(same.shown)
                found[key].append(again)
                if each is first:
                    pairs[tie.robot_i].append(pair_of(each, other, same.rows))
    across, others_of = [], defaultdict(list)
    for tie in between:
        first, second = drives[tie.robot_i].keyframes[tie.i], drives[tie.robot_j].keyframes[tie.j]
        if np.hypot(*tie.T_i_j[:2]) <= FARTHEST_M:
            others_of[tie.robot_i, tie.i].append(points_of(second, tie.T_i_j))
            others_of[tie.robot_j, tie.j].append(points_of(first, se2.inverse(tie.T_i_j)))
        same = correspond(first, second, tie.T_i_j)
        if len(same.rows) >= FEWEST_POINTS:
            across.append(pair_of(first, second, same.rows))
    taught: dict[str, list[TaughtImage]] = {name: [] for name in drives}
    taught_bytes = 0
    for (name, k), others in others_of.items():
        frame = drives[name].keyframes[k]
        codes = teach(points_of(frame, np.zeros(3)), others)
        taught_bytes += codes.size_bytes
        if len(codes.rows) >= FEWEST_POINTS:
            pixels = frame.features.keypoints_px[frame.placed][codes.rows]
            taught[name].append(TaughtImage(frame.image, pixels, codes.codes))
    robots = tuple(
        Examples(
            name,
            tuple(TrainingExample(f.image, revisit_labels(f.features, [], [])) for f in drive.keyframes),
            tuple(
                TrainingExample(f.image, revisit_labels(f.features, shown[name, k], found[name, k]))
                for k, f in enumerate(drive.keyframes)
            ),
            tuple(pairs[name]),
            tuple(taught[name]),
        )
        for name, drive in drives.items()
    )
    return Fleet(robots, tuple(across), taught_bytes, len(within), len(between))


def points_of(frame: Keyframe, T: FloatArray) -> PlacePoints:
    """What the cloud knows of a keyframe, moved by a pose (3,)."""
    positions = frame.positions[frame.placed].copy()
    positions[:, :2] = se2.transform(T, positions[:, :2])
    return PlacePoints(positions, frame.features.descriptors[frame.placed])


def pair_of(first: Keyframe, second: Keyframe, rows: np.ndarray) -> RevisitPair:
    points = (first.features.keypoints_px[rows[:, 0]], second.features.keypoints_px[rows[:, 1]])
    return RevisitPair((first.image, second.image), points)


def trained(
    arm: str, seed: int, fleets: Sequence[Fleet], settings: FederatedSettings, folder: Path
) -> list[FeatureDetector]:
    """The detectors of an arm, one or several, of which the mean counts."""
    if arm == "bundled":
        return [OnnxDetector(OnnxConfig())]
    settings = settings.model_copy(update={"training": settings.training.model_copy(update={"seed": seed})})
    start = prepare_initial_weights(BUNDLED_NETWORK, folder, settings, ExecutionOptions(), lambda *_: None)
    robots = [(k, robot) for k, fleet in enumerate(fleets) for robot in fleet.robots]
    if arm == "central":
        everything = [example for _, robot in robots for example in robot.labelled]
        pairs = [pair for _, robot in robots for pair in robot.pairs] + [p for fleet in fleets for p in fleet.across]
        steps = settings.rounds * settings.local_steps * len(fleets)
        networks = [trained_here(start, everything, RevisitExamples(pairs), settings, seed, steps)]
    elif arm == "alone":
        own = [robots[round(k)][1] for k in np.linspace(0, len(robots) - 1, ALONE)]
        steps = settings.rounds * settings.local_steps
        networks = [
            trained_here(start, robot.labelled, RevisitExamples(robot.pairs), settings, seed, steps) for robot in own
        ]
    else:
        networks = [federated(arm, robots, start, settings, folder)]
    detectors = []
    for k, network in enumerate(networks):
        export_onnx(network, folder / f"{k}.onnx")
        detectors.append(OnnxDetector(OnnxConfig(weights=folder / f"{k}.onnx")))
    return detectors


def trained_here(
    start: Weights,
    images: Sequence[TrainingExample],
    revisits: RevisitExamples,
    settings: FederatedSettings,
    seed: int,
    steps: int,
) -> KeypointNetwork:
    """Training in one place, with the losses and the rate of a robot in the fleet."""
    state = weights_to_network(start, settings.training.encoder).state_dict()
    training = settings.training.model_copy(update={"steps": steps, "seed": seed})
    plan = LocalTrainingPlan(
        0, steps, compatible=settings.compatible, frozen_statistics=True, only_codes=settings.trained == "codes"
    )
    return local_training(
        state, images, training, plan, torch.device("cpu"), legacy=state, revisits=revisits
    ).network  # fmt: skip


def federated(
    arm: str, robots: Sequence[tuple[int, Examples]], start: Weights, settings: FederatedSettings, folder: Path
) -> KeypointNetwork:
    """Federated training of all robots; a third of them in each round."""
    clients = []
    (folder / "rounds").mkdir()
    for building, robot in robots:
        name = f"{building}-{robot.robot}"
        (folder / name).mkdir()
        images = TrainingImages(list(robot.plain if arm == "homographies" else robot.labelled), [], 0)
        pairs = () if arm == "homographies" else robot.pairs
        revisits = RevisitExamples(pairs, robot.taught if arm == "closures" else ())
        noise = seeded_noise(name, settings.training.seed)
        clients.append(RobotClient(name, folder / name, folder / name, noise, images=images, revisits=revisits))
    hooks = CoordinatorHooks(
        partial(weights_version, encoder=settings.training.encoder),
        evaluate_fn=lambda _weights: {},  # without metrics the last version counts, as in the other arms
        on_round=lambda row, _best: print(arm, row.round_number, row.losses, row.left_out, file=sys.stderr, flush=True),
    )
    grid = InProcessGrid(
        build_client_app(lambda context: clients[int(context.node_config["partition-id"])]), len(clients)
    )
    state = Coordinator(grid, settings, start, folder / "rounds", hooks).run()
    return weights_to_network(state.average, settings.training.encoder)


def arm_rows(
    arm: str, seed: int, train: Callable[[], list[FeatureDetector]], fleets: Sequence[Path], unseen: Sequence[Path]
) -> Iterator[tuple]:
    """Measures by building: the mean over the detectors of an arm."""
    detectors = train()
    for on, folders, names in ((UNSEEN, unseen, ROBOTS), (LATER_DRIVES, fleets, LATER)):
        for folder in folders:
            views = [view for name in names for view in true_views(folder / name)]
            overlap = overlaps(views)
            values = [building_measures(views, overlap, detector) for detector in detectors]
            yield arm, seed, on, int(folder.name), *np.mean(values, axis=0).tolist()


def true_views(folder: Path) -> Iterator[TrueView]:
    """The images of a robot a metre or half a radian apart, with the scan before each and the true poses."""
    recording = Recording(folder, folder.name)
    truth = list(recording.ground_truth())
    stamps, poses = np.array([t.stamp for t in truth]), np.array([t.T_building_base for t in truth])
    scan, last = None, None
    for record in recording.records():
        if isinstance(record, LaserScan):
            scan = record
        elif isinstance(record, CameraImage) and scan is not None:
            at_scan, pose = interpolate(stamps, poses, np.array([scan.stamp, record.stamp]), 1.0)
            x, y, turn = (EVERY_M, 0.0, 0.0) if last is None else se2.between(last, pose)
            picture = decode_grey(record.encoded)
            if picture is None or (np.hypot(x, y) < EVERY_M and abs(turn) < EVERY_RAD):
                continue
            last = pose
            returns = point_scan(scan.ranges_m, scan.laser)
            ends = se2.transform(se2.between(pose, at_scan), np.vstack((returns.origin, returns.points)))
            lidar = LidarView(ends[1:], ends[0], abs(scan.laser.angle_increment_rad))
            yield TrueView(folder.name, picture, record.camera, (lidar,), pose, scan)


def overlaps(views: Sequence[TrueView]) -> FloatArray:
    """Overlap of all pairs of views, shape (N, N)."""
    camera, laser = views[0].camera, views[0].scan.laser
    poses = se2.compose(np.array([view.T_building_base for view in views]), laser.T_base_laser)
    ranges = np.array([view.scan.ranges_m for view in views], np.float64)
    return lidar_overlap(poses, ranges, laser, float(np.arctan2(0.5 * camera.width, camera.fx)))


def building_measures(views: Sequence[TrueView], overlap: FloatArray, detector: FeatureDetector) -> tuple[float, ...]:
    """As in ``MEASURES``."""
    frames = [
        Keyframe.of(view.picture, detector.detect(view.picture), view.camera, view.surroundings) for view in views
    ]
    robots = np.array([view.robot for view in views])
    pairs = np.argwhere((robots[:, None] < robots) & (overlap > PAIR_OVERLAP))
    pairs = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), PAIRS_A_BUILDING)).round().astype(int)]
    counts = np.array([
        keypoint_counts(frames[a], frames[b], se2.between(views[a].T_building_base, views[b].T_building_base))
        for a, b in pairs
    ])  # fmt: skip
    right, partners, matches = counts.sum(axis=0)
    admitted = robots[:, None] < robots
    truth = PairTruth(admitted & (overlap > SAME_OVERLAP), admitted & (overlap < OTHER_OVERLAP))
    similarity = np.zeros(overlap.shape)
    for a, b in np.argwhere(truth.matches | truth.different):
        similarity[a, b] = inliers(frames[a], frames[b])
    curve = multi_match_curve(similarity, truth)
    at_95 = float(np.max(curve.recall[curve.precision >= 0.95], initial=0.0))
    return (
        right / partners, right / matches, right / len(pairs), curve.average_precision, at_95,
        curve.recall_at_full_precision,
    )  # fmt: skip


def keypoint_counts(first: Keyframe, second: Keyframe, T_first_second: FloatArray) -> tuple[int, int, int]:
    """Right matches, keypoints that have a partner, and matches of points that the second view shows."""
    pixels, shown = predict(first, second, T_first_second)
    others = second.features.keypoints_px
    gaps = np.linalg.norm(pixels[:, None] - others[None], axis=2)
    partner = shown & (np.nanmin(np.where(np.isnan(gaps), np.inf, gaps), axis=1, initial=np.inf) <= CORRECT_PX)
    found = mutual_matches(first.features.descriptors, second.features.descriptors).pairs
    found = found[shown[found[:, 0]]]
    return int(np.sum(gaps[found[:, 0], found[:, 1]] <= CORRECT_PX)), int(partner.sum()), len(found)


def inliers(first: Keyframe, second: Keyframe) -> int:
    """Keypoints that the best motion explains, as the cloud proposes it; 0 without a motion."""
    config = MotionConfig()
    a, b = points_of(first, np.zeros(3)), points_of(second, np.zeros(3))
    matches = mutual_matches(a.codes, b.codes, config.hamming_limit)
    rows = matches.pairs
    level = np.abs(a.positions[rows[:, 0], 2] - b.positions[rows[:, 1], 2]) <= config.level_m
    kept = Matches(rows[level], matches.distances[level])
    best = rigid_hypotheses(a.positions[:, :2], b.positions[:, :2], kept, config.hypotheses)
    return max((hypothesis.inlier_count for hypothesis in best), default=0)


def by_building(rows: Sequence[tuple], arm: str, on: str) -> FloatArray:
    """Measures (B, M) of an arm by building, means over its training seeds."""
    found = [row for row in rows if row[0] == arm and row[2] == on]
    buildings = sorted({row[3] for row in found})
    return np.array([np.mean([row[4:] for row in found if row[3] == each], axis=0) for each in buildings])


def table(rows: Sequence[tuple], show: Callable[[str], FloatArray], sign: str) -> Iterator[tuple]:
    for arm in dict.fromkeys(row[0] for row in rows):
        seeds = len({row[1] for row in rows if row[0] == arm})
        shown = (mean_interval(values, np.random.default_rng(1)) for values in show(arm).T)
        yield arm, seeds, *(f"{each.mean:{sign}.3f} [{each.low:{sign}.3f}, {each.high:{sign}.3f}]" for each in shown)


def gains(rows: Sequence[tuple], on: str) -> Iterator[tuple]:
    """Every arm less the bundled detector on the same buildings."""
    bundled = by_building(rows, "bundled", on)
    yield from (r for r in table(rows, lambda arm: by_building(rows, arm, on) - bundled, "+") if r[0] != "bundled")


def means(rows: Sequence[tuple], on: str) -> Iterator[tuple]:
    yield from table(rows, lambda arm: by_building(rows, arm, on), "")


if __name__ == "__main__":
    main()
