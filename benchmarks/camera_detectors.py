"""What detectors are worth to the camera channel: fleets mapped by camera places alone, one detector after another.

    python benchmarks/camera_detectors.py [--weights detector.onnx ...] [--fleets FOLDER [--simulate-only]]

The fleets of `benchmarks/simulated_fleet.py`: per seed three robots in the default building, 60 m each, once in equal
light and once where every robot drives in another light (day, evening, some lamps off) and half of the furniture has
moved. Recordings are kept in FOLDER, if one is given, and made only once. Without --weights the network is the one that
comes with fcslam. Everything else is as configured by default; it needs a GL library.

Recall is that of revisits between robots by correct verified closures: of all, of those with like headings, and at
100 % precision, by the closures alone that are more similar than every wrong one. Differences are seed by seed, with
95 % intervals by bootstrap over seeds.
"""

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import common
import numpy as np
from simulated_fleet import ROBOTS, SEEDS, read, recorded

from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig, OnnxDetector
from fcslam.metrics.bootstrap import mean_interval

COMPARED = ("default", "default, other light")
ORB = "orb"
VERIFIED, ACCEPTED = "inter_robot_verified_camera", "inter_robot_accepted_camera"
RECALLS = {"at 100 %": "recall_full_precision", "recall": "recall", "like heading": "recall_like_heading"}
COLUMNS = {"building": "", "seed": "", "detector": "", "maps": ".0f", "false joins": ".0f", "verified": ".0f",
           "wrong": ".0f", "accepted": ".0f", "wrong ": ".0f"} | dict.fromkeys(RECALLS, ".3f") | {
           "camera places": ".0f", "kB a place": ".1f", "map, s": ".1f"}  # fmt: skip
SUMMARY = {"building": "", "detector": "", "one map": "", "false joins": ".0f", "verified": ".0f", "wrong": ".0f",
           "accepted": ".0f", "wrong ": ".0f"} | dict.fromkeys(RECALLS, ".3f")  # fmt: skip
GAINS = {"building": "", "detector": ""} | {f"{name} above ORB": "" for name in RECALLS} | {"seeds ahead": ""}


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fleet, mapped with one detector."""

    case: str
    seed: int
    detector: str
    found: Mapping[str, float]
    wall_s: float

    @property
    def row(self) -> tuple:
        found = self.found
        closures = (found[f"{stage}_{what}"] for stage in (VERIFIED, ACCEPTED) for what in ("closures", "wrong"))
        places = found["camera_places"]
        head = (self.case, self.seed, self.detector, found["maps"], found["false_joins"], *closures)
        return *head, *self.recalls, places, found["camera_place_bytes"] / max(places, 1.0) / 1e3, self.wall_s

    @property
    def recalls(self) -> tuple[float, ...]:
        return tuple(self.found[f"{VERIFIED}_{name}"] for name in RECALLS.values())


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the fleets")
    parser.add_argument("--cases", nargs="+", choices=COMPARED, default=COMPARED, help="kinds of fleet")
    parser.add_argument("--weights", nargs="+", type=Path, default=[BUNDLED_NETWORK], help="networks")
    parser.add_argument("--fleets", type=Path, help="folder of recordings; those that are missing are made there")
    parser.add_argument("--simulate-only", action="store_true", help="make the recordings, map nothing")
    parser.add_argument("--jobs", type=int, default=1, help="maps at the same time")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(chosen.jobs) as pool:
        fleets = {
            (case, seed): recorded(case, seed, chosen.fleets or Path(place))
            for seed in chosen.seeds
            for case in chosen.cases
        }
        if chosen.simulate_only:
            return
        detectors = settings(chosen.weights, Path(place))
        work = [(*fleet, path, name) for fleet, path in fleets.items() for name in detectors]
        outcomes = list(pool.map(lambda each: mapped(*each, detectors[each[-1]]), work))
    report.table("Recall above ORB's", GAINS, gains(outcomes, chosen.cases, tuple(detectors)))
    report.table("Summary", SUMMARY, summary(outcomes, chosen.cases, tuple(detectors)))
    report.table("Fleets", COLUMNS, [outcome.row for outcome in outcomes])
    report.write()


def settings(weights: Sequence[Path], folder: Path) -> dict[str, Path]:
    """A configuration file for each detector, by the detector's version."""
    views = {ORB: "detector: orb"}
    for path in weights:
        version = OnnxDetector(OnnxConfig(weights=path)).version
        views[version] = f"detector: onnx, weights: '{path.resolve()}'"
    for name, view in views.items():
        text = f"robot: {{channels: [camera], views: {{{view}}}}}\n"
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    return {name: folder / f"{name}.yaml" for name in views}


def mapped(case: str, seed: int, fleet: Path, detector: str, configuration: Path) -> Outcome:
    """One fleet by one detector, against the truth."""
    with tempfile.TemporaryDirectory() as place:
        run, result = Path(place) / "run", Path(place) / "result.json"
        robots = [fleet / f"robot_{k + 1}" for k in range(ROBOTS)]
        cost = common.run_fcslam("map", *robots, "--config", configuration, "--output", run)
        common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
        outcome = Outcome(case, seed, detector, read(result), cost.wall_s)
    print(case, seed, detector, *(f"{recall:.3f}" for recall in outcome.recalls), file=sys.stderr)
    return outcome


def gains(outcomes: Sequence[Outcome], cases: Sequence[str], detectors: Sequence[str]) -> Iterator[tuple]:
    """Each network against ORB on the same fleets; seeds are ahead by recall at 100 % precision."""
    for case in cases:
        recalls = {name: np.array([o.recalls for o in of(outcomes, case, name)]) for name in detectors}
        for name in detectors:
            if name != ORB:
                above = recalls[name] - recalls[ORB]
                intervals = (mean_interval(gain, np.random.default_rng(1)) for gain in above.T)
                shown = (f"{each.mean:+.3f} [{each.low:+.3f}, {each.high:+.3f}]" for each in intervals)
                yield case, name, *shown, f"{np.sum(above[:, 0] > 0.0)} of {len(above)}"


def summary(outcomes: Sequence[Outcome], cases: Sequence[str], detectors: Sequence[str]) -> Iterator[tuple]:
    """Each detector over all seeds: sums of closures, means of recalls."""
    for case in cases:
        for name in detectors:
            rows = [dict(zip(COLUMNS, o.row, strict=True)) for o in of(outcomes, case, name)]
            counts = (sum(row[key] for row in rows) for key in list(SUMMARY)[3:8])
            means = (float(np.mean([row[key] for row in rows])) for key in RECALLS)
            yield case, name, f"{sum(row['maps'] == 1 for row in rows)} of {len(rows)}", *counts, *means


def of(outcomes: Sequence[Outcome], case: str, detector: str) -> list[Outcome]:
    return [each for each in outcomes if (each.case, each.detector) == (case, detector)]


if __name__ == "__main__":
    main()
