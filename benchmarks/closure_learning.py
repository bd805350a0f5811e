"""What a detector learns from the fleet's own maps: federated training on points that robots saw again.

    python benchmarks/closure_learning.py --fleets FOLDER [--keep ROWS.jsonl] [--train 301 ...] [--test 411 ...]

Simulated fleets of three robots, 45 m each, by day, in the evening and with a third of the lamps off; half of the
furniture moves before the second and the third robot. In the training buildings three more robots drive later, in the
same three kinds of light, among other furniture. Each training fleet is mapped by camera places alone, and all examples
come from estimated poses (`learning/revisits.py`). True poses serve the evaluation only.

All networks start from the bundled one. Robots train the layers of the codes (`learning/code_training.py`), on pairs of
their own keyframes that show the same points of their map. Federated arms have
every robot of every building as a client, and a sixth of them trains in a round. Central training has as many steps as
all robots together, and a robot alone as many as one that trains in every round.

- homographies: as many pairs, each of two views of one image under a random homography, federated
- own map: pairs of each robot's own keyframes, federated
- poisoned: as own map, but one robot of five reverses its updates, ten times as long
- central: pairs of one robot and across robots, whose images are in one place
- alone: own map, one robot in each of three buildings; each of the networks is measured in every third building

Measured on unseen buildings and on later drives, between robots in different light, at places that an image shows every
metre or half radian. Keypoint recall: mutual nearest neighbours of 300 keypoints that are right to 3 px by the true
poses, divided by the keypoints that have a partner. Candidates: all pairs of images of two robots, by the inliers of
the best motion; right if the views overlap by a half, wrong if by less than a tenth. Intervals are 95 %, by bootstrap
over buildings, of the difference to the bundled detector. The table of forgetting has 25 pairs of photographs of other
places, corrected, NMS 8 px; it needs FCSLAM_DATA.

All seeds were fixed before the first run. The recipe was chosen on networks that were trained in buildings 301 to 310
and measured in 501 to 503 and 511 to 514. --keep resumes by arm, seed and building; networks and mapped drives stay in
FOLDER, and drives are mapped again only if their file is removed. It needs a GL library, and with the default size some
three hours of one core.
"""

import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import common
import numpy as np
import torch
from evaluation.detectors import EvaluatedDetectorKind, SceneKind, choose_detectors, find_scenes
from evaluation.federated.mapped_drives import MappedDrive, map_drives
from evaluation.federated.poison import PoisonedClient
from evaluation.fleet_views import GROUND_TRUTH, lidar_overlap
from evaluation.homography import HomographyGroundTruth, evaluate_homography, mean
from evaluation.retrieval import PairTruth, multi_match_curve
from evaluation.view_overlap import OTHER_OVERLAP, SAME_OVERLAP
from matplotlib.figure import Figure

from fcslam.features.codes import mutual_matches
from fcslam.features.detector import BUNDLED_NETWORK, FeatureDetector, OnnxConfig, OnnxDetector, decode_grey
from fcslam.features.lidar_depth import LidarView
from fcslam.geometry import se2
from fcslam.lab.simulation.options import Building, Lighting
from fcslam.lab.simulation.recording import prepare_fleet_folder, record_robot
from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
from fcslam.learning.code_batches import STEP_POINTS, RevisitExamples, RevisitPair
from fcslam.learning.code_training import CodeInputs, train_codes
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.client import Client, InProcessFleet, RevisitClient
from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks, RoundRules
from fcslam.learning.federated.held_out import inliers
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network, weights_version
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.labels import WORST_QUALITY, Labels
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.pairs import TrainingExample, draw_pair
from fcslam.learning.revisits import Keyframe, predict, revisits_in_map
from fcslam.learning.settings import TrainingSettings
from fcslam.learning.training_loop import LocalTrainingPlan
from fcslam.lidar.scan import point_scan
from fcslam.metrics.bootstrap import Interval, mean_interval
from fcslam.metrics.trajectory import interpolate
from fcslam.mission.mission import MissionConfig
from fcslam.records import CameraImage, CameraModel, Channel, FloatArray, LaserScan
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.views import EVERY_M, EVERY_RAD
from fcslam.runs import read_tum
from fcslam.sources import open_source

TRAIN, TEST, SEEDS = tuple(range(301, 311)), tuple(range(411, 421)), (1, 2, 3)
ROBOTS = ("robot_1", "robot_2", "robot_3")
LATER = ("robot_4", "robot_5", "robot_6")
LIGHT = (Lighting.DAY, Lighting.EVENING, Lighting.LAMP_OFF)
LOCAL_STEPS, PARTICIPATION = 10, 1.0 / 6.0
LIAR, POISONED = "robot_3", (0, 2, 4, 5, 7, 9)
"""The robot that poisons, and the numbers of the training buildings in which it does: 6 of 30 robots."""
CORRECT_PX = 3.0
PAIR_OVERLAP = 0.2
"""Least overlap of two views between which keypoint recall is measured."""
PAIRS_A_BUILDING = 120
"""Most pairs of views per building on which keypoint recall is measured."""
ALONE = 3
"""Robots that train alone; each building of the test measures the network of one of them."""
ARMS = ("bundled", "homographies", "own map", "poisoned", "central", "alone")
REPEATED = ("own map",)
"""Arms with all training seeds; the others have the first."""
LATER_DRIVEN = ("bundled", "own map")
"""Arms that are also measured on later drives."""
COMPARED = (
    ("own map", "homographies"),
    ("own map", "alone"),
    ("own map", "central"),
    ("poisoned", "own map"),
)
"""Arms that are compared with one another."""
UNSEEN, LATER_DRIVES = "unseen buildings", "later drives"
MEASURES = ("keypoint recall", "precision", "matches a pair", "average precision", "recall at 95 %", "recall at 100 %")
COLUMNS = {"": "s", "seeds": "d"} | dict.fromkeys(MEASURES, "s")
SCENES, NMS_PX = ("oxford_affine", "hpatches_subset"), 8
FORGETTING = {"arm": "s", "seed": "d"} | dict.fromkeys(
    ("repeatability, illumination", "viewpoint", "homography, 1 px", "3 px", "5 px", "MMA@3", "matching score"), ".3f"
)
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
class Learner:
    """What one robot has to train on."""

    robot: str
    keyframes: tuple[TrainingExample, ...]
    """Its images, with its keypoints as labels."""
    pairs: tuple[RevisitPair, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """What one building gives for training."""

    learners: tuple[Learner, ...]
    together: RevisitExamples
    """Images of all robots in one place, with pairs across robots; positions in the fleet's map."""


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, required=True, help="folder of recordings; those missing are made there")
    parser.add_argument("--train", nargs="+", type=int, default=TRAIN, help="seeds of the training buildings")
    parser.add_argument("--test", nargs="+", type=int, default=TEST, help="seeds of the unseen buildings")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of training")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS, help="which networks")
    parser.add_argument("--rounds", type=int, default=60, help="of federated training")
    parser.add_argument("--keep", type=Path, help="file that keeps finished arms; the same one resumes")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__ or "", chosen)
    fleets = [recorded(seed, 6, chosen.fleets) for seed in chosen.train]
    unseen = [recorded(seed, 3, chosen.fleets) for seed in chosen.test]
    examples = [fleet_examples(folder, chosen.fleets) for folder in fleets]
    settings = FederatedSettings(
        rounds=chosen.rounds, local_steps=LOCAL_STEPS, participation=PARTICIPATION,
        training=TrainingSettings(learning_rate=1e-3),
    )  # fmt: skip
    rows: list[tuple] = []
    forgetting: list[tuple] = []
    for arm in (arm for arm in ARMS if arm in chosen.arms):
        for seed in chosen.seeds[: 3 if arm in REPEATED else 1]:
            key = (arm, seed, chosen.rounds, *chosen.train)
            place = chosen.fleets / "-".join(["networks", common.commit(), *map(str, key)]).replace(" ", "_")
            networks = kept_networks(place, partial(trained, arm, seed, examples, settings))
            forgetting += kept.rows((*key, "photographs"), partial(photograph_rows, arm, seed, networks))
            for on, folders, names in ((UNSEEN, unseen, ROBOTS), (LATER_DRIVES, fleets, LATER)):
                if on == LATER_DRIVES and arm not in LATER_DRIVEN:
                    continue
                for folder in folders:
                    measure = partial(building_row, arm, seed, on, folder, names, networks)
                    rows += kept.rows((*key, on, int(folder.name)), measure)
            print(arm, seed, rows[-1], file=sys.stderr, flush=True)
    report.picture("What the arms gain in unseen buildings, with 95 % intervals over buildings", draw(rows))
    report.table("Examples", EXAMPLES, map(examples_row, chosen.train, examples))
    for on in (UNSEEN, LATER_DRIVES):
        report.table(f"Above the bundled detector, {on}", COLUMNS, gains(rows, on))
        report.table(f"Means, {on}", COLUMNS, means(rows, on))
    report.table("Differences, unseen buildings", COLUMNS, differences(rows))
    report.table("Photographs of other places", FORGETTING, forgetting)
    report.table("Buildings", ROWS, rows)
    report.write()


EXAMPLES = {"building": "d", "keyframes": "d", "pairs of one robot": "d", "pairs across robots": "d"}


def examples_row(seed: int, fleet: Fleet) -> tuple:
    learners = fleet.learners
    own = sum(len(learner.pairs) for learner in learners)
    return seed, sum(len(learner.keyframes) for learner in learners), own, len(fleet.together.pairs) - own


def recorded(seed: int, robots: int, folder: Path, building: Building = Building.DEFAULT) -> Path:
    """The recordings of one building; what is there already is not made again."""
    camera = CameraSettings(rate_hz=2.0)
    settings = SimulationSettings(
        building=building, robots=robots, path_length_m=45.0, lighting=LIGHT, moved_furniture=0.5, camera=camera
    )
    name = str(seed) if building is Building.DEFAULT else f"{building}-{seed}"
    place, part = folder / name, folder / f"{name}.part"
    if not place.exists():
        shutil.rmtree(part, ignore_errors=True)
        prepare_fleet_folder(part, settings, seed)
        for robot in simulate_fleet(settings, seed).robots:
            record_robot(robot, part / robot.name)
        part.rename(place)
    return place


def fleet_examples(folder: Path, kept: Path) -> Fleet:
    """Map a fleet by camera places alone and collect what its robots learn from; the mapped drives are kept."""
    file = kept / f"drives-{folder.name}.pickle"
    if not file.exists():
        config = MissionConfig(robot=RobotConfig(channels=(Channel.CAMERA,)))
        sources = [open_source(folder / name, name=name) for name in ROBOTS]
        file.write_bytes(pickle.dumps(map_drives(sources, config, OnnxDetector(OnnxConfig()))))
    examples = kept / f"examples-{folder.name}-{common.commit()}.pickle"
    if not examples.exists():
        examples.write_bytes(pickle.dumps(fleet_of(pickle.loads(file.read_bytes()))))
    fleet: Fleet = pickle.loads(examples.read_bytes())
    print(folder.name, examples_row(int(folder.name), fleet), file=sys.stderr, flush=True)
    return fleet


def fleet_of(drives: dict[str, MappedDrive]) -> Fleet:
    """Pairs that each robot finds in its own map, and those of all robots in the fleet's map."""
    learners = []
    for name, drive in drives.items():
        frames, poses = drive.keyframes, drive.T_own_base
        pairs = [pair_of((i, j), frames[i], frames[j], rows, poses[i]) for i, j, rows in revisits_in_map(frames, poses)]
        keyframes = tuple(
            TrainingExample(f.image, Labels(f.features.keypoints_px, ranked(len(f.features.scores))))
            for f in drive.keyframes
        )
        learners.append(Learner(name, keyframes, tuple(pairs)))
    largest = max(np.bincount([drive.map_index for drive in drives.values()]).argmax(), 0)
    joint = [drive for drive in drives.values() if drive.map_index == largest]
    frames = [frame for drive in joint for frame in drive.keyframes]
    poses = np.concatenate([drive.T_map_base for drive in joint])
    everything = [
        pair_of((i, j), frames[i], frames[j], rows, poses[i]) for i, j, rows in revisits_in_map(frames, poses)
    ]
    return Fleet(tuple(learners), RevisitExamples([frame.image for frame in frames], everything))


def ranked(count: int) -> np.ndarray:
    """Qualities (count,) of keypoints that fall with their rank."""
    return np.linspace(1.0, WORST_QUALITY, count, dtype=np.float32)


def pair_of(
    images: tuple[int, int], first: Keyframe, second: Keyframe, rows: np.ndarray, T_map_first: FloatArray
) -> RevisitPair:
    points = (first.features.keypoints_px[rows[:, 0]], second.features.keypoints_px[rows[:, 1]])
    positions = first.positions[rows[:, 0]].copy()
    positions[:, :2] = se2.transform(T_map_first, positions[:, :2])
    return RevisitPair(images, points, positions)


def homography_pairs(learner: Learner, seed: int) -> RevisitExamples:
    """As many pairs as the robot has in its map, each of two views of one image under a random homography."""
    rng = np.random.default_rng([seed, len(learner.keyframes)])
    images, pairs = [], []
    for k in range(len(learner.pairs)):
        example = learner.keyframes[k % len(learner.keyframes)]
        pair = draw_pair(example, example.image.shape[::-1], STEP_POINTS, 0, rng)
        first, second = pair.views
        images += [np.round(255.0 * view.image).clip(0, 255).astype(np.uint8) for view in (first, second)]
        nowhere = np.full((int(pair.valid.sum()), 3), np.nan)
        pairs.append(RevisitPair((2 * k, 2 * k + 1), (first.points[pair.valid], second.points[pair.valid]), nowhere))
    return RevisitExamples(images, pairs)


def revisits_of(arm: str, learner: Learner, seed: int) -> RevisitExamples:
    """What a robot of the fleet trains on in an arm."""
    if arm == "homographies":
        return homography_pairs(learner, seed)
    images = [example.image for example in learner.keyframes]
    return RevisitExamples(images, learner.pairs)


def joined(fleets: Sequence[Fleet]) -> RevisitExamples:
    """The images of all buildings in one place; buildings are a kilometre apart."""
    images, pairs = [], []
    for number, fleet in enumerate(fleets):
        for pair in fleet.together.pairs:
            numbers = (pair.images[0] + len(images), pair.images[1] + len(images))
            pairs.append(RevisitPair(numbers, pair.points, pair.positions + np.array([1000.0 * number, 0.0, 0.0])))
        images += fleet.together.images
    return RevisitExamples(images, pairs)


def trained(
    arm: str, seed: int, fleets: Sequence[Fleet], settings: FederatedSettings, folder: Path
) -> list[Path | None]:
    """The networks of an arm, one or several, of which the mean counts; None for the bundled one."""
    if arm == "bundled":
        return [None]
    training = settings.training.model_copy(update={"seed": seed})
    settings = settings.model_copy(update={"training": training})
    start = prepare_initial_weights(BUNDLED_NETWORK, folder, settings.training.encoder)
    learners = [(k, learner) for k, fleet in enumerate(fleets) for learner in fleet.learners]
    steps = settings.rounds * settings.local_steps
    if arm == "central":
        a_round = round(settings.participation * len(learners))
        networks = [trained_here(start, joined(fleets), settings, seed, steps * a_round)]
    elif arm == "alone":
        own = [learners[round(k)][1] for k in np.linspace(0, len(learners) - 1, ALONE)]
        networks = [trained_here(start, revisits_of(arm, each, seed), settings, seed, steps) for each in own]
    else:
        networks = [federated(arm, seed, learners, start, settings, folder)]
    paths = [folder / f"{k}.onnx" for k in range(len(networks))]
    for network, path in zip(networks, paths, strict=True):
        export_onnx(network, path)
    return paths


def trained_here(
    start: Weights, revisits: RevisitExamples, settings: FederatedSettings, seed: int, steps: int
) -> KeypointNetwork:
    """Training in one place, with the losses and the rate of a robot in the fleet."""
    state = weights_to_network(start, settings.training.encoder).state_dict()
    training = settings.training.model_copy(update={"steps": steps, "seed": seed})
    before = weights_to_network(start, settings.training.encoder)
    return train_codes(state, revisits, CodeInputs(), LocalTrainingPlan(training, 0, steps), before)[0]


def federated(
    arm: str,
    seed: int,
    learners: Sequence[tuple[int, Learner]],
    start: Weights,
    settings: FederatedSettings,
    folder: Path,
) -> KeypointNetwork:
    """Federated training of all robots; some of them in each round."""
    clients: dict[str, Client] = {}
    (folder / "rounds").mkdir()
    for building, learner in learners:
        name = f"{building}-{learner.robot}"
        (folder / name).mkdir()
        client = RevisitClient(name, folder / name, revisits=revisits_of(arm, learner, seed))
        is_poisoned = arm == "poisoned" and building in POISONED and learner.robot == LIAR
        clients[name] = PoisonedClient(client, "reversed") if is_poisoned else client
    hooks = CoordinatorHooks(
        partial(weights_version, encoder=settings.training.encoder),
        on_round=lambda row: print(arm, row.round_number, row.losses, row.left_out, file=sys.stderr, flush=True),
    )
    rules = RoundRules(fewest_pairs=1)  # no robot holds out pairs, so nothing is released
    state = Coordinator(InProcessFleet(clients), settings, start, folder / "rounds", hooks, rules).run()
    return weights_to_network(state.average, settings.training.encoder)


def kept_networks(place: Path, train: Callable[[Path], list[Path | None]]) -> list[Path | None]:
    """The networks of an arm, trained now unless they are in the folder."""
    if not place.exists():
        with tempfile.TemporaryDirectory() as folder:
            networks = [path for path in train(Path(folder)) if path is not None]
            place.with_suffix(".part").mkdir(exist_ok=True)
            for path in networks:
                shutil.copy(path, place.with_suffix(".part") / path.name)
            place.with_suffix(".part").rename(place)
    return sorted(place.glob("*.onnx")) or [None]


def building_row(
    arm: str, seed: int, on: str, folder: Path, names: Sequence[str], networks: Sequence[Path | None]
) -> list[tuple]:
    """Measures in a building; of several networks, every building has its own one."""
    views, overlap = views_of(folder, tuple(names))
    network = networks[int(folder.name) % len(networks)]
    values = building_measures(views, overlap, OnnxDetector(OnnxConfig(weights=network)))
    return [(arm, seed, on, int(folder.name), *values)]


def photograph_rows(arm: str, seed: int, networks: Sequence[Path | None]) -> list[tuple]:
    """Measures on photographs: the mean over the networks of an arm."""
    vision = common.recordings(*SCENES, kind="vision")
    detectors = choose_detectors([EvaluatedDetectorKind.ONNX], [path or BUNDLED_NETWORK for path in networks])
    report = evaluate_homography(
        find_scenes([vision / name for name in SCENES]), detectors, HomographyGroundTruth.CORRECTED
    )
    values = []
    for detector in report.detectors:
        pairs = report.of(detector)
        kinds = [mean(pairs, "repeatability", kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT)]
        corners = [mean(pairs, f"homography_{px}px_nms{NMS_PX}") for px in (1, 3, 5)]
        values.append([*kinds, *corners, mean(pairs, f"accuracy_3px_nms{NMS_PX}"), mean(pairs, f"score_nms{NMS_PX}")])
    return [(arm, seed, *np.mean(values, axis=0).tolist())]


@cache
def views_of(folder: Path, names: tuple[str, ...]) -> tuple[list[TrueView], FloatArray]:
    """The views of some robots and their overlaps."""
    views = [view for name in names for view in true_views(folder / name)]
    return views, overlaps(views)


def true_views(folder: Path) -> Iterator[TrueView]:
    """The images of a robot a metre or half a radian apart, with the scan before each and the true poses."""
    stamps, poses = read_tum(folder / GROUND_TRUTH)
    scan, last = None, None
    for record in open_source(folder).records():
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


def by_building(rows: Sequence[tuple], arm: str, on: str) -> FloatArray:
    """Measures (B, M) of an arm by building, means over its training seeds."""
    found = [row for row in rows if row[0] == arm and row[2] == on]
    buildings = sorted({row[3] for row in found})
    return np.array([np.mean([row[4:] for row in found if row[3] == each], axis=0) for each in buildings])


def gain(rows: Sequence[tuple], arm: str, other: str, on: str) -> list[Interval]:
    """By measure, an arm less another one on the same buildings."""
    differences = by_building(rows, arm, on) - by_building(rows, other, on)
    return [mean_interval(values, np.random.default_rng(1)) for values in differences.T]


def shown(values: Sequence[Interval], sign: str = "+") -> list[str]:
    return [f"{each.mean:{sign}.3f} [{each.low:{sign}.3f}, {each.high:{sign}.3f}]" for each in values]


def seeds_of(rows: Sequence[tuple], arm: str, on: str) -> int:
    return len({row[1] for row in rows if row[0] == arm and row[2] == on})


def gains(rows: Sequence[tuple], on: str) -> Iterator[tuple]:
    """Every arm less the bundled detector."""
    for arm in dict.fromkeys(row[0] for row in rows if row[2] == on and row[0] != "bundled"):
        yield arm, seeds_of(rows, arm, on), *shown(gain(rows, arm, "bundled", on))


def differences(rows: Sequence[tuple]) -> Iterator[tuple]:
    """One arm less another."""
    measured = {row[0] for row in rows}
    for arm, other in COMPARED:
        if {arm, other} <= measured:
            yield f"{arm} - {other}", seeds_of(rows, arm, UNSEEN), *shown(gain(rows, arm, other, UNSEEN))


def means(rows: Sequence[tuple], on: str) -> Iterator[tuple]:
    for arm in dict.fromkeys(row[0] for row in rows if row[2] == on):
        values = [mean_interval(each, np.random.default_rng(1)) for each in by_building(rows, arm, on).T]
        yield arm, seeds_of(rows, arm, on), *shown(values, "")


def draw(rows: Sequence[tuple]) -> Figure:
    """The gains of two measures in points, an arm a bar."""
    arms = [arm for arm in reversed(ARMS) if arm != "bundled" and any(row[0] == arm for row in rows)]
    figure = Figure(figsize=(8.0, 0.5 * len(arms) + 1.0))
    for axes, measure in zip(figure.subplots(1, 2, sharey=True), ("keypoint recall", "average precision"), strict=True):
        found = [gain(rows, arm, "bundled", UNSEEN)[MEASURES.index(measure)] for arm in arms]
        values = 100.0 * np.array([(each.mean, each.low, each.high) for each in found]).reshape(-1, 3)
        errors = np.abs(values[:, 1:] - values[:, :1]).T
        axes.barh(range(len(arms)), values[:, 0], xerr=errors, color="tab:blue", height=0.6, capsize=3)
        axes.axvline(0.0, color="grey", linewidth=1)
        axes.set_yticks(range(len(arms)), arms)
        axes.set_xlabel(f"{measure}, points above bundled")
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
