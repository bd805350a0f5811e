"""Draw the pictures of docs/concepts from the three sample logs, with fcslam's own functions.

python tools/concept_pictures.py
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

import fcslam
from fcslam.features.birdseye import SIDE_M, describe, likelihood_picture
from fcslam.geometry import se2
from fcslam.maps import palette
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.mission.mission_file import read_mission
from fcslam.places.index import PlaceIndex
from fcslam.places.vocabulary import Strategy, VocabularyConfig
from fcslam.records import ClosureStatus, FloatArray, Place
from fcslam.runs import Run
from fcslam.runs.folder import MISSION
from fcslam.sources import open_source

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "images" / "concepts"
LOGS = [ROOT / "examples" / "logs" / f"{robot}.clf.xz" for robot in ("anna", "ben", "cleo")]
RUN = ROOT / "out" / "concepts"
INK, PAPER, ACCENT, OTHER = (
    f"#{color:06x}" for color in (palette.INK, palette.FLOOR, palette.ROBOTS[0], palette.ROBOTS[1])
)
COLORS = {robot: f"#{color:06x}" for robot, color in zip(("anna", "ben", "cleo"), palette.ROBOTS, strict=False)}


def sheet(width: float, height: float, columns: int) -> tuple[Figure, list[Axes]]:
    """A white sheet with axes beside each other; width and height in inches."""
    figure = Figure(figsize=(width, height), facecolor=PAPER, layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, columns)))


def bare(axes: Axes, title: str) -> None:
    """Axes for a map: equal scales, no ticks."""
    axes.set_title(title, fontsize=10, color=INK)
    axes.set_aspect("equal")
    axes.axis("off")


def draw_map(axes: Axes, grid: OccupancyMap, paths: Mapping[str, FloatArray]) -> None:
    """An occupancy map with the paths of robots, metres."""
    rows, columns = np.nonzero(grid.cells == fcslam.Occupancy.OCCUPIED)
    x, y = np.transpose([columns + 0.5, rows + 0.5]).T * grid.resolution_m + np.array(grid.origin_xy)[:, None]
    axes.scatter(x, y, s=0.4, c=INK, marker="s", linewidths=0)
    for robot, poses in paths.items():
        axes.plot(poses[:, 0], poses[:, 1], color=COLORS[robot], linewidth=1.2, label=robot)


def scan_points(robot: str, run: Run, stamp: float, within_s: float) -> FloatArray:
    """Returns of the scans around a stamp in ``base`` at that stamp, shape (N, 2), metres."""
    trajectory = run.trajectories[robot]
    anchor = trajectory.T_map_base[np.abs(trajectory.stamps - stamp).argmin()]
    points = []
    for scan in open_source(LOGS[list(COLORS).index(robot)]).records():
        if not isinstance(scan, fcslam.records.LaserScan) or abs(scan.stamp - stamp) > within_s:
            continue
        angles = scan.laser.angle_min_rad + scan.laser.angle_increment_rad * np.arange(len(scan.ranges_m))
        seen = np.isfinite(scan.ranges_m) & (scan.ranges_m > 0.0) & (scan.ranges_m < scan.laser.max_range_m)
        returns = (scan.ranges_m * np.array((np.cos(angles), np.sin(angles)))).T[seen]
        pose = trajectory.T_map_base[np.abs(trajectory.stamps - scan.stamp).argmin()]
        points.append(
            se2.transform(se2.between(anchor, pose), se2.transform(np.array(scan.laser.T_base_laser), returns))
        )
    return np.concatenate(points)


def draw_place(run: Run) -> Figure:
    """A submap, its bird's-eye picture, and its keypoints."""
    points = scan_points("anna", run, run.trajectories["anna"].stamps[120], 10.0)
    features = describe(points)
    figure, (walls, picture) = sheet(8.0, 3.9, 2)
    walls.scatter(*points.T, s=1.0, c=INK, linewidths=0)
    bare(walls, "1. the returns of some metres of path")
    half = 0.5 * SIDE_M
    extent = (-half, half, -half, half)
    picture.imshow(255 - likelihood_picture(points), cmap="gray", origin="lower", extent=extent)
    picture.scatter(*features.keypoints_m[:80].T, s=26, facecolors="none", edgecolors=OTHER, linewidths=0.9)
    bare(picture, "2. bird's-eye picture; circles: keypoints with 256 bits each")
    for axes in (walls, picture):
        axes.set_xlim(-9, 9)
        axes.set_ylim(-9, 9)
    return figure


def draw_closure(run: Run) -> Figure:
    """The walls of two robots, laid on each other by a true closure and by a false one."""
    rows = [row for row in run.closures if row.robot_i != row.robot_j and row.status is ClosureStatus.ACCEPTED]
    true = max(rows, key=lambda row: row.similarity)
    figure, panels = sheet(8.0, 3.9, 2)
    first = scan_points(true.robot_i, run, true.stamp_i, 4.0)
    second = scan_points(true.robot_j, run, true.stamp_j, 4.0)
    for axes, offset, title in (
        (panels[0], (0.0, 0.0, 0.0), "accepted: the walls of both robots agree"),
        (panels[1], (1.1, 0.7, 0.35), "refused: walls stand in free space"),
    ):
        laid = se2.transform(se2.compose(true.T_i_j, np.array(offset)), second)
        axes.scatter(*first.T, s=12, c=COLORS[true.robot_i], linewidths=0)
        axes.scatter(*laid.T, s=2, c=COLORS[true.robot_j], linewidths=0)
        bare(axes, title)
        axes.set_xlim(-9, 9)
        axes.set_ylim(-9, 9)
    return figure


def draw_joining(run: Run) -> Figure:
    """The own maps of two robots, and the joint map."""
    figure, panels = sheet(9.5, 3.6, 3)
    for axes, robot in zip(panels, ("anna", "ben"), strict=False):
        local = run.local_maps[robot]
        draw_map(axes, local.occupancy(), {robot: local.T_local_base})
        bare(axes, f"own map of {robot}")
    draw_map(panels[2], run.maps[0], {name: path.T_map_base for name, path in run.trajectories.items()})
    bare(panels[2], "joint map of anna, ben and cleo")
    panels[2].legend(fontsize=8, frameon=False, loc="lower right")
    return figure


def draw_vocabulary(run_folder: Path) -> Figure:
    """The number of words while places arrive."""
    packets = read_mission(run_folder / MISSION).in_order
    places = [sized.packet.body for sized in packets if isinstance(sized.packet.body, Place)]
    figure, (axes,) = sheet(6.5, 3.0, 1)
    for strategy, color in ((Strategy.REBUILD, OTHER), (Strategy.INCREMENTAL, ACCENT)):
        settings = VocabularyConfig(strategy=strategy, train_batch=8, capacity=8, leaf_capacity=64)
        index: PlaceIndex[int] = PlaceIndex(settings, np.random.default_rng(0))
        counts = []
        for number, place in enumerate(places):
            index.add(number, place.descriptors)
            counts.append(index.word_count)
        axes.plot(counts, color=color, label=strategy.value, linewidth=1.6)
    axes.set_xlabel("LiDAR places of three robots", fontsize=9)
    axes.set_ylabel("words", fontsize=9)
    axes.legend(fontsize=9, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def draw_bytes(run: Run) -> Figure:
    """What left the robots, by kind of packet."""
    kinds = ("place", "keyscan", "constraint", "hello")
    kilobytes = [run.metrics[f"{kind}_bytes"].value / 1000.0 for kind in kinds]
    figure, (axes,) = sheet(6.5, 2.2, 1)
    bars = axes.barh([f"{kind}s" for kind in kinds], kilobytes, color=ACCENT)
    axes.bar_label(bars, [f"{amount:.1f} kB" for amount in kilobytes], padding=4, fontsize=9)
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("sent by three robots in 30 m of path each, kB; images: none", fontsize=9)
    return figure


def draw_federated() -> Figure:
    """Weights go up and down; images stay."""
    figure, (axes,) = sheet(7.5, 3.2, 1)
    axes.set_xlim(0, 10)
    axes.set_ylim(0, 4)
    axes.axis("off")

    def box(x: float, y: float, text: str, color: str) -> None:
        axes.add_patch(
            FancyBboxPatch((x - 1.2, y - 0.42), 2.4, 0.84, boxstyle="round,pad=0.05", fc=PAPER, ec=color, lw=1.8)
        )
        axes.text(x, y, text, ha="center", va="center", fontsize=9, color=INK)

    box(5.0, 3.4, "server: screens updates,\naverages weights, evaluates", INK)
    for x, robot in zip((1.6, 5.0, 8.4), COLORS, strict=True):
        box(x, 0.6, f"{robot}: trains on\nits own images", COLORS[robot])
        for shift, start, end in ((-0.25, 1.12, 2.88), (0.25, 2.88, 1.12)):
            ends = ((5.0 + 0.3 * (x - 5.0) + shift, end), (x + shift, start))
            head, tail = ends if start < end else ((x + shift, end), (5.0 + 0.3 * (x - 5.0) + shift, start))
            axes.annotate("", head, tail, arrowprops={"arrowstyle": "->", "color": COLORS[robot], "lw": 1.4})
    axes.text(0.2, 2.2, "up: weights", fontsize=9, color=INK)
    axes.text(8.0, 2.2, "down: weights", fontsize=9, color=INK)
    return figure


def main() -> int:
    """Map the sample logs and draw all pictures."""
    mpl.rcParams["svg.hashsalt"] = "fcslam"
    run = fcslam.map_recordings(LOGS, output=RUN, force=True)
    FOLDER.mkdir(parents=True, exist_ok=True)
    pictures = {
        "places": draw_place(run),
        "closures": draw_closure(run),
        "joining": draw_joining(run),
        "vocabulary": draw_vocabulary(RUN),
        "federated": draw_federated(),
        "what-leaves": draw_bytes(run),
    }
    for name, figure in pictures.items():
        figure.savefig(FOLDER / f"{name}.png", dpi=130, metadata={"Software": None})
        print(FOLDER / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
