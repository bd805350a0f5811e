"""A finished run as one file, and the cost of a page beside the mapping.

    FCSLAM_DATA=/path/to/data python benchmarks/page_of_runs.py

Each recording is mapped as three robots on all cores, with and without `--live`, by turns; a time is the least of its
repetitions. "Same run": whether every file of the run folder is the same, byte for byte.
"""

import tempfile
from pathlib import Path

import common


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--repetitions", type=int, default=3)
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    files, costs = [], []
    for name in common.SPLITS:
        with tempfile.TemporaryDirectory() as place:
            plain, live, html = (Path(place) / each for each in ("plain", "live", "report.html"))
            turns = [
                (mapped(folder, name, plain), mapped(folder, name, live, "--live", "--no-open"))
                for _ in range(chosen.repetitions)
            ]
            without, with_page = (min(cost.wall_s for cost in each) for each in zip(*turns, strict=True))
            same = "yes" if contents(plain) == contents(live) else "NO"
            costs.append((name, without, with_page, with_page / without, same))
            written = common.run_fcslam("show", plain, "--html", html)
            files.append((name, html.stat().st_size / 1e6, written.wall_s))
    report.table("A run as one file", {"": "", "MB": ".2f", "written in, s": ".1f"}, files)
    columns = {"": "", "without a page, s": ".1f", "with --live, s": ".1f", "ratio": ".2f", "same run": ""}
    report.table("Wall time of the mapping", columns, costs)
    report.write()


def mapped(folder: Path, name: str, run: Path, *options: str) -> common.Cost:
    """`fcslam map` of a recording as three robots."""
    return common.run_fcslam("map", common.log_path(folder, name), "--split", 3, "-o", run, "--force", *options)


def contents(run: Path) -> dict[str, bytes]:
    """Every file of a run folder."""
    return {str(path.relative_to(run)): path.read_bytes() for path in run.rglob("*") if path.is_file()}


if __name__ == "__main__":
    main()
