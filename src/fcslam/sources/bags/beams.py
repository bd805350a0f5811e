"""Resamples scans of a laser whose beams vary from scan to scan."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from fcslam.sources.bags.messages import Beams, ScanMessage

_SAME_FIELD_OF_VIEW_RAD = 0.05


class NominalBeams:
    """The most frequent beam geometry of the first scans."""

    def __init__(self, first_scans: Sequence[ScanMessage]) -> None:
        count, _ = Counter(scan.beam_count for scan in first_scans).most_common(1)[0]
        self.beams = next(scan.beams for scan in first_scans if scan.beam_count == count)

    def resampled(self, scan: ScanMessage) -> ScanMessage | None:
        """Resample a scan to the nominal beams by nearest neighbour; None if its field of view differs.

        A scan with the nominal beams is returned unchanged. A nominal beam outside the scan becomes NaN.
        """
        if scan.beams == self.beams:
            return scan
        apart_rad = _apart_rad(scan.beams, self.beams)
        if scan.beam_count == self.beams.beam_count and apart_rad < 0.25 * self.beams.angle_increment_rad:
            return scan
        if apart_rad > _SAME_FIELD_OF_VIEW_RAD:
            return None
        angles_rad = self.beams.angle_min_rad + self.beams.angle_increment_rad * np.arange(self.beams.beam_count)
        nearest = np.rint((angles_rad - scan.beams.angle_min_rad) / scan.beams.angle_increment_rad).astype(np.intp)
        inside = (nearest >= 0) & (nearest < scan.beam_count)
        ranges = np.full(self.beams.beam_count, np.nan, dtype=np.float32)
        ranges[inside] = scan.raw_ranges_m[nearest[inside]]
        return scan._replace(beams=self.beams, raw_ranges_m=ranges)


def _apart_rad(a: Beams, b: Beams) -> float:
    """Largest difference between the directions of the first beams and of the last beams."""
    first = a.angle_min_rad - b.angle_min_rad
    return max(abs(first), abs(first + a.span_rad - b.span_rad))
