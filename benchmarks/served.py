"""The service and its robots as processes of their own: the map of `fcslam map`, and the bytes that travel for it.

    FCSLAM_DATA=/path/to/data python benchmarks/served.py

Three logs cut into robots, the five runs of Wean Hall, and a simulated fleet with cameras (seed 101; it needs a GL
library, or FLEET of `fcslam tools simulate`). Each is mapped twice by `fcslam serve` and one `fcslam robot` a
robot: all of it as fast as robots can, and then its first seconds at the speed at which they were recorded, all fleets
at the same time. What comes out is compared with what `fcslam map` makes of the same files in one process: packets,
closures (all lines of closures.csv), pose graph, bytes of the maps, poses at keyscans. No tolerance.

"By robot and kind" is what the service says of itself in /metrics after the whole recordings, over their duration. "On
the wire" is of the seconds at real speed: packets by /metrics, and what a proxy between robot and service counted, the
lengths of packets in their batches and the heads of HTTP requests and answers included. TCP and IP are not.
"""

import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
from faults import Proxy, Scenario
from processes import PATIENCE_S, Compared, cloud, compare, finalize, robot, yes
from prometheus_client.parser import text_string_to_metric_families

from fcslam.sources import ScanRange, Source, open_source, split, write_recording

WEAN_HALL, SIMULATED = "wean-hall", "simulated, cameras"
SEED = 101
PLAYED_S = 120.0
UP = ("hello", "keyscan", "constraint", "lidar place", "camera place")
DOWN = ("acknowledgement", "correction")

Counts = Mapping[tuple[str, str], float]
"""Bytes by robot and kind."""

SAME = {"recording": "", "speed": "", "robots": "", "packets": ",.0f", "lost": ".0f", "twice": ".0f", "closures": "",
        "closures the same": "", "graph off by": ".1e", "maps the same": "", "poses the same": "", "s": ".0f",
        "passed": ""}  # fmt: skip
KINDS = {"recording": "", "robot": "", "recorded, s": ".0f", **{f"{kind}, kB/s": ".3f" for kind in UP},
         "up, kB/s": ".2f"}  # fmt: skip
WIRE = {"recording": "", "robot": "", "s": ".0f", "requests": "", "up: packets, kB/s": ".2f", "with HTTP": ".2f",
        **{f"down: {kind}, kB/s": ".3f" for kind in DOWN}, "down: packets, kB/s": ".3f",
        "with HTTP ": ".3f"}  # fmt: skip


class Served(NamedTuple):
    """What a service made of a fleet."""

    compared: Compared
    bytes: Counts
    wire: Mapping[str, Counter[str]]
    """What went through each robot's proxy."""
    wall_s: float


def main() -> None:
    parser = common.options(__doc__)
    names = [*common.SPLITS, WEAN_HALL, SIMULATED]
    parser.add_argument("--recordings", nargs="+", choices=names, default=names)
    parser.add_argument("--fleet", type=Path, help="recorded with cameras, instead of simulating one")
    parser.add_argument("--seconds", type=float, default=PLAYED_S, help="to play at recorded speed; 0: leave that out")
    chosen = parser.parse_args()
    common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    same, kinds, wire = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        fleets = {name: list(recorded(name, place, chosen.fleet)) for name in chosen.recordings}
        for name, sources in fleets.items():
            (served,) = serve(
                {name: written(sources, place / f"{name} whole")}, "max", place / f"{name} served"
            ).values()
            same.append(same_row(name, "max", served))
            kinds += [(name, *kind_row(source, served.bytes)) for source in sources]
            print(*same[-1], flush=True)
        if chosen.seconds:
            played = {
                name: written([Beginning(source, chosen.seconds) for source in sources], place / f"{name} begins")
                for name, sources in fleets.items()
            }
            for name, served in serve(played, 1, place / "at real speed").items():
                same.append(same_row(name, "1", served))
                seconds = {log.stem: open_source(log).survey().duration_s for log in played[name]}
                wire += [(name, each, s, *wire_row(each, s, served)) for each, s in seconds.items()]
    report.table("The same as `fcslam map`", SAME, same)
    report.table("By robot and kind", KINDS, kinds)
    if wire:
        report.table("On the wire, at the speed of the recording", WIRE, wire)
    report.write()
    if not all(row[-1] == "yes" for row in same):
        sys.exit("served: a map is another one")


def recorded(name: str, place: Path, fleet: Path | None) -> Iterator[Source]:
    """The robots of a recording."""
    if name in common.SPLITS:
        yield from split(open_source(common.log_path(common.recordings(), name)), common.SPLITS[name])
    elif name == WEAN_HALL:
        for number in range(1, 6):
            yield open_source(common.recordings() / WEAN_HALL / f"robotdata{number}.log.gz")
    else:
        if fleet is None:
            fleet = place / "fleet"
            common.run_fcslam("tools", "simulate", "--robots", 3, "--seed", SEED, "--output", fleet)
        yield from map(open_source, sorted(fleet.glob("robot_*")))


class Beginning:
    """A recording's first seconds."""

    def __init__(self, whole: Source, seconds: float) -> None:
        survey = whole.survey()
        self._whole, self.name = whole, whole.name
        self._scans = ScanRange(0, max(2, round(survey.scan_count * min(1.0, seconds / survey.duration_s))))

    def survey(self) -> Any:
        return self._whole.survey(self._scans)

    def records(self) -> Any:
        return self._whole.records(self._scans)


def written(sources: Sequence[Any], folder: Path) -> list[Path]:
    """Each robot's recording as a file of its own."""
    folder.mkdir()
    logs = []
    for source in sources:
        logs.append(folder / f"{source.name}.fcslam")
        survey = source.survey()
        write_recording(logs[-1], survey.lasers, survey.camera, source.records())
    return logs


def serve(fleets: Mapping[str, Sequence[Path]], speed: object, place: Path) -> dict[str, Served]:
    """Services of their own for all fleets at once, and `fcslam map` for each of them."""
    place.mkdir()
    references = {name: place / f"{name} reference" for name in fleets}
    for name, logs in fleets.items():
        common.run_fcslam("map", *logs, "--output", references[name])
    began = time.perf_counter()
    with ExitStack() as stack:
        ports, robots, proxies = {}, [], {}
        for name, logs in fleets.items():
            (place / name).mkdir()
            _, ports[name] = stack.enter_context(cloud(place / name))
            for log in logs:
                proxy = stack.enter_context(closing(Proxy(Scenario(), ports[name], np.random.default_rng(0))))
                proxies[name, log.stem] = proxy
                robots.append(stack.enter_context(robot(log, proxy.port, place / name, speed)))
        until = time.monotonic() + PATIENCE_S
        while not all(process.ended() for process in robots):
            if time.monotonic() > until:
                sys.exit(f"robots are not done after {PATIENCE_S} s; see {place}")
            time.sleep(0.1)
        found = {name: (finalize(port), counted(port)) for name, port in ports.items()}
        wall_s = time.perf_counter() - began
    return {
        name: Served(
            compare(run, references[name]), sizes,
            {each: proxy.counts for (fleet, each), proxy in proxies.items() if fleet == name}, wall_s,
        )
        for name, (run, sizes) in found.items()
    }  # fmt: skip


def counted(port: int) -> Counts:
    """Bytes of packets in both directions, as the service counts them."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    sizes: Counter[tuple[str, str]] = Counter()
    for sample in (sample for family in families for sample in family.samples):
        if sample.name in ("fcslam_bytes_total", "fcslam_answer_bytes_total"):
            labels = sample.labels
            sizes[labels["robot"], f"{labels.get('channel', '')} {labels['kind']}".strip()] += sample.value
    return sizes


def same_row(name: str, speed: str, served: Served) -> tuple:
    return name, speed, len(served.wire), *served.compared, served.wall_s, yes(served.compared.passed)


def kind_row(source: Source, sizes: Counts) -> tuple:
    seconds = source.survey().duration_s
    rates = [sizes[source.name, kind] / seconds / 1e3 for kind in UP]
    return source.name, seconds, *rates, sum(rates)


def wire_row(name: str, seconds: float, served: Served) -> tuple:
    """Requests, kB/s up without and with HTTP, down by kind, without and with HTTP."""
    up, down = ([served.bytes[name, kind] / seconds / 1e3 for kind in kinds] for kinds in (UP, DOWN))
    counts = served.wire[name]
    whole = [(counts[f"{way}, HTTP"] + counts[f"{way}, carried"]) / seconds / 1e3 for way in ("up", "down")]
    return counts["requests"], sum(up), whole[0], *down, sum(down), whole[1]


if __name__ == "__main__":
    main()
