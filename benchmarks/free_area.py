"""How much of the free area of a map is not free, and how much of what a robot saw is free in its map.

    FCSLAM_DATA=/path/to/data python benchmarks/free_area.py --work build/free

Robots drive for three minutes through published floors (worlds/floor_worlds.py), with three scanners: ``rplidar`` 12 m
and ``short`` 8 m all around, ``sick`` 25 m over 270 degrees. Beams get lost on grazed walls, 1 % of all are lost, and
surfaces that a floor does not know, as black ones or windows, give no return. With an even seed, two robots drive.

- *Not free*: free cells of the map that are not free in the floor, as a share of the free cells. The map is laid on the
  floor by the true poses. One cell of 5 cm beside free cells of the floor is tolerated.
- *Seen by returns*: cells of the floor between the scanner, at its true poses, and a surface in range; share of them
  that is free in the map. *Seen by all beams* has also the cells up to the range of the scanner where no surface is.
- *Traces*: occupied cells of the map more than 25 cm inside of the free area of the floor, as people leave.

The halls are empty, and three by two and a half times as large as the range of the scanner. The recordings have no true
floor: the table has their free area.
"""

import itertools
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import common
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from worlds import floor_worlds
from worlds.floor_worlds import CELL_M, FLOORS, Floor

from fcslam.compiled import njit
from fcslam.geometry import se2
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.metrics.trajectory import align
from fcslam.mission.localization import read_map
from fcslam.records import FloatArray
from fcslam.runs.tables import read_tum

SCANNERS = {"rplidar": (12.0, 360.0), "sick": (25.0, 270.0), "short": (8.0, 360.0)}
"""Range in metres and field of view in degrees."""
MINUTES = 3
POSE_STEP = 5
"""Of the true poses, every fifth one looks around."""
BEAMS = 720
TRACE_M = 0.25
LOGS = {name: f"slam-benchmark/{name}.clf.xz" for name in common.SPLITS} | {
    "freiburg-campus": "rbpf-corrected/freiburg-campus-corrected.log.gz"
}
COLUMNS = {
    "floor": "",
    "scanner": "",
    "seed": "d",
    "free [m2]": ".0f",
    "not free [%]": ".1f",
    "seen by returns, free [%]": ".1f",
    "seen by all beams, free [%]": ".1f",
    "traces [cells]": "d",
    "ATE [m]": ".3f",
}

Mask = NDArray[np.bool_]


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--floors", nargs="+", default=list(FLOORS), metavar="NAME")
    parser.add_argument("--scanners", nargs="+", default=list(SCANNERS), choices=SCANNERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2], metavar="N")
    parser.add_argument("--work", type=Path, help="folder of drives, runs and rows, kept for the next time")
    chosen = parser.parse_args()
    logs = common.recordings(*LOGS.values())
    with tempfile.TemporaryDirectory() as temporary:
        work = chosen.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        kept = common.Kept(work / "rows.jsonl" if chosen.work else None)
        floors = []
        for case in itertools.product(chosen.floors, chosen.scanners, chosen.seeds):
            floors += kept.rows(case, partial(driven, work, *case))
        halls = []
        for scanner, (range_m, _) in SCANNERS.items():
            hall(range_m).write(work / f"hall_{scanner}.npz")
            halls += kept.rows(("hall", scanner), partial(driven, work, f"hall_{scanner}", scanner, 1, work))
        areas = [
            row for name, log in LOGS.items() for row in kept.rows((name,), partial(mapped, work, logs / log, name))
        ]
    report = common.Report(__file__, __doc__, chosen)
    shares = np.array([row[4] for row in floors])
    report.say(
        f"{len(floors)} drives in {len(chosen.floors)} floors: {shares.mean():.1f} % of the free area is not free in "
        f"the mean, {shares.max():.1f} % at most, over 5 % in {np.count_nonzero(shares > 5.0)}."
    )
    columns = {heading: COLUMNS[heading] for heading in list(COLUMNS)[4:7]} | {"worst, not free [%]": ".1f"}
    for title, key in (("floor", 0), ("scanner", 1)):
        summary = []
        for name in dict.fromkeys(row[key] for row in floors):
            figures = np.array([row[4:7] for row in floors if row[key] == name])
            summary.append((name, *figures.mean(axis=0), figures[:, 0].max()))
        report.table(f"By {title}", {title: "", **columns}, summary)
    report.table("Every drive", COLUMNS, floors)
    report.table("Halls", COLUMNS, halls)
    report.table("Recordings", {"recording": "", "free [m2]": ".0f", "occupied [cells]": "d"}, areas)
    report.write()


def hall(range_m: float) -> Floor:
    """An empty hall of three by two and a half times a range."""
    free = np.zeros([round(share * range_m / CELL_M) for share in (2.5, 3.0)], np.bool_)
    free = np.pad(~free, 20)
    return Floor(free, ndimage.binary_dilation(free, iterations=3) & ~free)


def driven(work: Path, name: str, scanner: str, seed: int, floors: Path | None = None) -> Iterator[tuple]:
    """The row of one drive of one robot, or two."""
    robots = 1 if seed % 2 else 2
    folder, run = (work / kind / f"{name}-{scanner}-{seed}" for kind in ("drives", "runs"))
    options = "--seed", seed, "--robots", robots, "--minutes", MINUTES, "--scanners", scanner
    info = floor_worlds.drive(name, folder, *options, floors=floors)
    common.run_fcslam("map", *(f"{robot}={folder / robot}" for robot in info["robots"]), "-o", run, "--force")
    if floors is None:
        floor = Floor.read(name)
    else:
        with np.load(floors / f"{name}.npz") as arrays:
            floor = Floor(arrays["free"], arrays["occ"])
    yield measured(name, scanner, seed, folder, run, info, floor)


def measured(name: str, scanner: str, seed: int, folder: Path, run: Path, info: dict, floor: Floor) -> tuple:
    """The row of a run: the first of its maps, and the robots in it."""
    members = [robot for robot, number in floor_worlds.maps_of(run).items() if number == 0]
    pairs = [floor_worlds.true_and_found(folder, run, robot) for robot in members]
    T_floor_map = align(*(np.concatenate(poses) for poses in zip(*pairs, strict=True)))
    occupancy = read_map(run)
    by_returns, by_all = np.zeros((2, *floor.free.shape), np.bool_)
    surfaces = ndimage.binary_dilation(floor.occupied, np.ones((3, 3)))
    for robot in members:
        _, poses = read_tum(folder / f"{robot}.truth.tum")
        laser, (range_m, view_deg) = info["robots"][robot], SCANNERS[scanner]
        mounting = laser["laser_x"], laser["laser_yaw"]
        look(floor.free, surfaces, poses[::POSE_STEP], *mounting, range_m, np.radians(view_deg), by_returns, by_all)
    beside_free = ndimage.binary_dilation(floor.free, np.ones((3, 3)))
    inside_m = CELL_M * ndimage.distance_transform_edt(floor.free)
    free, occupied = (
        states(np.argwhere(occupancy.cells == state), occupancy, T_floor_map)
        for state in (Occupancy.FREE, Occupancy.OCCUPIED)
    )
    return (
        name,
        scanner,
        seed,
        len(free) * occupancy.resolution_m**2,
        100.0 * (1.0 - picked(beside_free, free).mean()),
        100.0 * is_free(by_returns, occupancy, T_floor_map).mean(),
        100.0 * is_free(by_all, occupancy, T_floor_map).mean(),
        int(np.count_nonzero(picked(inside_m, occupied) > TRACE_M)),
        floor_worlds.joint_errors(folder, run, members).rmse_m,
    )


@njit
def look(free, surfaces, poses, laser_x, yaw, range_m, view_rad, by_returns, by_all):  # type: ignore[no-untyped-def]
    """Mark the free cells that a scanner sees at its true poses (N, 3): by beams with a return, and by all."""
    for x, y, heading in poses:
        for beam in range(BEAMS):
            angle = heading + yaw + view_rad * (beam / BEAMS - 0.5)
            step = np.array((np.cos(angle), np.sin(angle))) / 2.0
            start = np.array((x + laser_x * np.cos(heading), y + laser_x * np.sin(heading))) / CELL_M
            count, has_return = 0, False
            while count < 2.0 * range_m / CELL_M:
                column, row = int(start[0] + count * step[0]), int(start[1] + count * step[1])
                if not (0 <= row < free.shape[0] and 0 <= column < free.shape[1]):
                    break
                if not free[row, column]:
                    has_return = surfaces[row, column]
                    break
                count += 1
            for k in range(count):
                column, row = int(start[0] + k * step[0]), int(start[1] + k * step[1])
                by_all[row, column] = True
                by_returns[row, column] |= has_return


def states(cells: NDArray[np.int64], occupancy: OccupancyMap, T_floor_map: FloatArray) -> NDArray[np.int64]:
    """Cells (N, 2) of the floor, column and row, in which the centres of cells of the map lie, row and column."""
    centres = np.array(occupancy.origin_xy) + occupancy.resolution_m * (cells[:, ::-1] + 0.5)
    return np.floor(se2.transform(T_floor_map, centres) / CELL_M).astype(np.int64)


def is_free(seen: Mask, occupancy: OccupancyMap, T_floor_map: FloatArray) -> Mask:
    """Whether each cell of the floor in a mask is free in the map."""
    centres = CELL_M * (np.argwhere(seen)[:, ::-1] + 0.5)
    at = se2.transform(np.asarray(se2.inverse(T_floor_map)), centres) - np.array(occupancy.origin_xy)
    return picked(occupancy.cells == Occupancy.FREE, np.floor(at / occupancy.resolution_m).astype(np.int64))


def picked(values: NDArray, cells: NDArray[np.int64]) -> NDArray:
    """The values at cells (..., 2), column and row; 0 outside."""
    inside = ((cells >= 0) & (cells < values.shape[::-1])).all(axis=-1)
    column, row = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
    return np.where(inside, values[row, column], 0)


def mapped(work: Path, log: Path, name: str) -> Iterator[tuple]:
    """The row of a recording."""
    run = work / "runs" / name
    common.run_fcslam("map", f"robot={log}", "-o", run, "--force")
    occupancy = read_map(run)
    free, occupied = (int(np.count_nonzero(occupancy.cells == state)) for state in (Occupancy.FREE, Occupancy.OCCUPIED))
    yield name, free * occupancy.resolution_m**2, occupied


if __name__ == "__main__":
    main()
