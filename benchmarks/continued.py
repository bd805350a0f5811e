"""A mission that goes on the next day: what `fcslam map --onto` costs, and whether the map is that of all logs at once.

    python benchmarks/continued.py [--log intel] [--parts 3] [--repetitions 2]

A recording of the SLAM benchmark is cut into robots as by `--split`. One command maps all of them. Two others map all
but the last, and then the last one onto that run. CPU is that of the whole command, the least of the repetitions.
"""

import tempfile
from pathlib import Path

import common

COLUMNS = {"command": "", "CPU, s": ".1f", "of all at once": ".2f", "files unlike those of all at once": ","}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--log", default="intel", help="of the SLAM benchmark")
    parser.add_argument("--parts", type=int, default=3, help="robots that the log is cut into")
    parser.add_argument("--repetitions", type=int, default=2, help="of each command")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        rows = measured(common.log_path(folder, chosen.log), chosen.parts, chosen.repetitions, Path(place))
    report.table(f"{chosen.log} in {chosen.parts}", COLUMNS, rows)
    report.write()


def measured(log: Path, parts: int, repetitions: int, place: Path) -> list[tuple[str, float, float, int]]:
    from fcslam import sources

    logs = [place / f"{number}.mcap" for number in range(parts)]
    for path, part in zip(logs, sources.split(sources.open_source(log), parts), strict=True):
        sources.write_bag(path, part.records())
    whole, begun = place / "whole", place / "begun"
    commands = {
        "all at once": (*logs, "-o", whole),
        "all but the last": (*logs[:-1], "-o", begun),
        "the last": (logs[-1], "--onto", begun, "-o", place / "last"),
    }
    cpu_s: dict[str, float] = {}
    for _ in range(repetitions):
        for name, arguments in commands.items():
            cost = common.run_fcslam("map", *arguments, "--force")
            cpu_s[name] = min(cpu_s.get(name, cost.cpu_s), cost.cpu_s)
    unlike = {name: differing(whole, arguments[-1]) for name, arguments in commands.items()}
    return [(name, spent_s, spent_s / cpu_s["all at once"], unlike[name]) for name, spent_s in cpu_s.items()]


def differing(one: Path, other: Path) -> int:
    """How many files of two run folders are not the same bytes."""
    names = {path.relative_to(run) for run in (one, other) for path in run.rglob("*") if path.is_file()}
    return sum(content(one / name) != content(other / name) for name in names)


def content(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


if __name__ == "__main__":
    main()
