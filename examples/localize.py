"""Find a robot in the map of an earlier mission, which does not change.

    python examples/localize.py [RUN_FOLDER]

The map is that of `examples/map_logs.py`. The starting pose of the robot is unknown.
"""

import sys
from pathlib import Path

import numpy as np

import fcslam

LOGS = Path(__file__).parent / "logs"


def main(folder: str) -> None:
    run = fcslam.localize(LOGS / "cleo.clf.xz", folder)
    found = run.localized["cleo"]
    known = np.isfinite(found.T_map_base[:, 0])
    first = int(np.argmax(known))
    print(f"found after {found.stamps[first] - found.stamps[0]:.0f} s, at {np.sum(known)} of {len(known)} scans")
    x, y, theta = found.T_map_base[-1]
    print(f"ends at ({x:.2f}, {y:.2f}) m, {theta:.2f} rad, quality {found.quality[-1]:.2f}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/two")
