"""Robots in published floors of real buildings: are true pairs joined, and different floors kept apart?

    FCSLAM_DATA=/path/to/data python benchmarks/real_floors.py
    FCSLAM_DATA=/path/to/data python benchmarks/real_floors.py --kinds "other floor" year --work build/floors

A simulator that is not part of the project drives robots through occupancy grids of real buildings
(`benchmarks/worlds/floor_worlds.py`). `fcslam map` maps each pair by its default configuration.

- pair: two robots on one floor, with about 27 or 40 % of the walls in common.
- year: two robots on one real floor, in two of three years, each for five minutes.
- onto: the same, the second robot mapped on the mission of the first one.
- other floor: two robots on two floors of one building.
- mirrored, shifted, refurnished: one robot on a floor, the other on a copy of it.

Joined: both robots are in one map. Right: they are joined, and the error (RMSE) of both paths together after one rigid
alignment is below 0.5 m. The common walls are the share of the walls of the robot that saw less.
"""

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import common
from worlds.floor_worlds import FLOORS, Floor, drive, joint_errors, maps_of, mirrored, refurnished, shifted

RIGHT_M = 0.5
SCANNERS = "rplidar", "sick", "short"
YEARS = "eng2_7f_2015_02", "eng2_7f_2018_01", "eng2_7f_2021_03"
BUILDINGS = ("gdc1", "gdc2"), ("eng6_1f", "eng6_2f"), ("eng6_1f", "eng6_3f"), ("eng6_2f", "eng6_3f")
COPIES = {"mirrored": mirrored, "shifted": shifted, "refurnished": lambda floor: refurnished(floor, seed=1)}
KINDS = "pair", "year", "onto", "other floor", *COPIES
COUNTS = {"kind": "", "pairs": "", "joined": "", "right": "", "wrong": "", "mean ATE, m": ".3f"}
COLUMNS = {"kind": "", "floors": "", "seed": "", "common walls": ".2f", "joined": "", "ATE, m": ".3f", "places": "",
           "seen by both, m": ".0f", "contradicting, m": ".1f", "likeness": ".2f"}  # fmt: skip


class Pair(NamedTuple):
    """Two recordings of one or two floors."""

    kind: str
    floors: str
    seed: int
    common: float
    """Share of walls that both saw; NaN if they were on different floors."""
    recordings: tuple[Path, Path]
    truths: tuple[Path, Path]


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--floors", nargs="+", choices=FLOORS, default=FLOORS, help="floors of pairs and copies")
    parser.add_argument(
        "--work", type=Path, default=common.REPOSITORY / "build" / "floors", help="folder of the drives"
    )
    chosen = parser.parse_args()
    common.recordings(kind="floors")
    kept = common.Kept(chosen.work / "rows.jsonl")
    chosen.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for pair in pairs(chosen.kinds, chosen.floors, chosen.work):
        rows += kept.rows((pair.kind, pair.floors, pair.seed), lambda pair=pair: [row(pair, chosen.work)])
        print(*rows[-1], flush=True)
    report = common.Report(__file__, __doc__, chosen)
    report.table("Outcomes", COUNTS, counts(rows))
    report.table("Pairs", COLUMNS, rows)
    report.write()
    if any(joined == "yes" and kind not in ("pair", "year", "onto") for kind, *_, joined in (r[:5] for r in rows)):
        sys.exit("robots on different floors were joined")


def pairs(kinds: list[str], floors: list[str], work: Path) -> Iterator[Pair]:
    if "pair" in kinds:
        for floor, (seed, overlap) in itertools.product(floors, ((2, 0.4), (3, 0.4), (5, 0.27))):
            folder = work / f"{floor}-{seed}-{overlap}"
            info = drive(floor, folder, "--seed", seed, "--overlap", overlap)
            yield Pair("pair", floor, seed, info["overlap"]["anna-ben"], *of(folder, folder, ("anna", "ben")))
    for kind in {"year", "onto"} & set(kinds):
        for (a, b), seed in itertools.product(itertools.combinations(YEARS, 2), (1, 2, 3)):
            scanners = SCANNERS[seed % 3], SCANNERS[(seed + 1) % 3]
            folders = [alone(floor, seed, scanner, 5, work) for floor, scanner in zip((a, b), scanners, strict=True)]
            yield Pair(kind, f"{a}, {b}", seed, float("nan"), *of(*folders))
    if "other floor" in kinds:
        for (a, b), (seed, scanner) in itertools.product(BUILDINGS, ((5, "rplidar"), (6, "sick"), (7, "sick"))):
            folders = [alone(floor, seed, scanner, 3, work) for floor in (a, b)]
            yield Pair("other floor", f"{a}, {b}", seed, float("nan"), *of(*folders))
    for kind, floor in itertools.product([kind for kind in COPIES if kind in kinds], floors):
        copy = work / "copies" / f"{floor}-{kind}.npz"
        if not copy.exists():
            copy.parent.mkdir(parents=True, exist_ok=True)
            COPIES[kind](Floor.read(floor)).write(copy)
        folders = alone(floor, 4, "rplidar", 3, work), alone(copy.stem, 5, "rplidar", 3, work, copy.parent)
        yield Pair(kind, floor, 4, float("nan"), *of(*folders))


def alone(floor: str, seed: int, scanner: str, minutes: int, work: Path, floors: Path | None = None) -> Path:
    folder = work / f"{floor}-{seed}-{scanner}-{minutes}"
    drive(floor, folder, "--seed", seed, "--robots", 1, "--minutes", minutes, "--scanners", scanner, floors=floors)
    return folder


def of(a: Path, b: Path, names: tuple[str, str] = ("anna", "anna")) -> tuple[tuple[Path, Path], tuple[Path, Path]]:
    recordings = a / names[0], b / names[1]
    return recordings, tuple(path.with_name(f"{path.name}.truth.tum") for path in recordings)


def row(pair: Pair, work: Path) -> tuple:
    run = work / "runs" / f"{pair.kind}-{pair.floors}-{pair.seed}".replace(", ", "-").replace(" ", "-")
    (a, b), begun = (f"{name}={path}" for name, path in zip("ab", pair.recordings, strict=True)), run / "first"
    if pair.kind == "onto":
        common.run_fcslam("map", a, "--output", begun, "--force")
        common.run_fcslam("map", b, "--onto", begun, "--output", run / "run", "--force")
    else:
        common.run_fcslam("map", a, b, "--output", run / "run", "--force")
    truths = run / "truth"
    truths.mkdir(exist_ok=True)
    for name, truth in zip("ab", pair.truths, strict=True):
        (truths / f"{name}.truth.tum").write_bytes(truth.read_bytes())
    maps = maps_of(run / "run")
    joined = maps["a"] == maps["b"]
    of_b = [session for session, number in maps.items() if number == maps["b"]]
    ate_m = joint_errors(truths, run / "run", of_b).rmse_m if joined else float("nan")
    places, seen_m, against_m, likeness = evidence(run / "run")
    return *pair[:4], "yes" if joined else "no", ate_m, places, seen_m, against_m, likeness


def evidence(run: Path) -> tuple[int, float, float, float]:
    """Places, wall seen by both, contradicting wall and likeness of the strongest join."""
    lines = [line.split(",") for line in (run / "joins.csv").read_text(encoding="utf-8").splitlines()[1:]]
    if not lines:
        return 0, float("nan"), float("nan"), float("nan")
    _, _, _, places, *numbers = max(lines, key=lambda line: int(line[3]))
    seen_m, against_m, likeness, _ = (float(number or "nan") for number in numbers)
    return int(places), seen_m, against_m, likeness


def counts(rows: list[tuple]) -> Iterator[tuple]:
    for kind in KINDS:
        mine = [row for row in rows if row[0] == kind]
        joined = [row for row in mine if row[4] == "yes"]
        right = [row[5] for row in joined if row[5] < RIGHT_M and kind in ("pair", "year", "onto")]
        if mine:
            mean_m = sum(right) / len(right) if right else float("nan")
            yield kind, len(mine), len(joined), len(right), len(joined) - len(right), mean_m


if __name__ == "__main__":
    main()
