"""Mean bytes of a keyscan's ranges, by encoding, over all scans of three logs, for docs/reference/wire-coding.md.

    FCSLAM_DATA=/path/to/data python benchmarks/ranges_encoding.py

The logs were recorded in steps of 1 cm, so they are measured once more with 5 mm of added noise, as a finer sensor
would give. "Differences deflated": of neighbours, as 16-bit numbers, high and low bytes apart. The wire uses the last.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path

import common
import numpy as np

from fcslam.records import LaserScan
from fcslam.sources import open_source
from fcslam.wire.quantisation import quantise
from fcslam.wire.streams import RangeCodes, pack_ranges, unpack_ranges

COLUMNS = {"log": "", "added noise, mm": ".0f", "scans": ",", "beams": ".0f", "16-bit": ".0f", "deflated": ".0f",
           "differences deflated": ".0f", "coded": ".0f"}  # fmt: skip
RAW_DEFLATE = -zlib.MAX_WBITS


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for noise_m in (0.0, 0.005):
        for name in common.SPLITS:
            scans = codes(common.log_path(folder, name), noise_m, np.random.default_rng(0))
            sizes = np.array([encoded_sizes(scan) for scan in scans])
            rows.append((name, 1e3 * noise_m, len(sizes), *sizes.mean(axis=0)))
    report.table("Bytes of a keyscan's ranges", COLUMNS, rows)
    report.write()


def codes(log: Path, noise_m: float, rng: np.random.Generator) -> Iterator[RangeCodes]:
    """Every scan's ranges in the wire's steps; no return is 0."""
    for record in open_source(log).records():
        if isinstance(record, LaserScan):
            ranges = record.ranges_m.astype(np.float64)
            hit = (ranges > 0.0) & (ranges < record.laser.max_range_m)
            yield quantise(np.where(hit, ranges + noise_m * rng.standard_normal(len(ranges)), 0.0))


def encoded_sizes(scan: RangeCodes) -> tuple[int, ...]:
    """Beams, and bytes in each encoding."""
    packed = pack_ranges(scan)
    if not np.array_equal(unpack_ranges(packed, len(scan)), scan):
        raise AssertionError("the ranges do not survive the wire")
    deflated = zlib.compress(scan.tobytes(), wbits=RAW_DEFLATE)
    differences = np.diff(scan, prepend=np.uint16(0)).view(np.uint8).reshape(-1, 2)
    apart = zlib.compress(np.ascontiguousarray(differences.T).tobytes(), wbits=RAW_DEFLATE)
    return len(scan), scan.nbytes, len(deflated), len(apart), len(packed)


if __name__ == "__main__":
    main()
