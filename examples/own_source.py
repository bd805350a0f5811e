"""Map recordings of a format of your own: here, arrays in memory.

python examples/own_source.py [RUN_FOLDER]
"""

import sys
from collections.abc import Iterator

import numpy as np

import fcslam

LASER = fcslam.LaserModel(beam_count=360, angle_min_rad=-3.14, angle_increment_rad=np.pi / 180, max_range_m=12.0)


class Room:
    """A robot that circles in a room of 8 m x 6 m. Replace the content of `records` by your reader."""

    name, faults = "mine", fcslam.Faults({})

    def survey(self) -> fcslam.Survey:
        return fcslam.Survey(200, 40.0, 8.0, (LASER,), self.faults)

    def records(self) -> Iterator[fcslam.LaserScan]:
        for number in range(200):
            heading = 0.04 * number
            pose = np.array([np.sin(heading), 1.0 - np.cos(heading), np.arctan2(np.sin(heading), np.cos(heading))])
            beam = LASER.angles_rad() + heading
            x_m = np.where(np.cos(beam) > 0, 4.0 - pose[0], 4.0 + pose[0]) / np.abs(np.cos(beam))
            y_m = np.where(np.sin(beam) > 0, 4.0 - pose[1], 2.0 + pose[1]) / np.abs(np.sin(beam))
            yield fcslam.LaserScan(0.2 * number, np.minimum(x_m, y_m).astype(np.float32), LASER, pose)


if __name__ == "__main__":
    run = fcslam.map_recordings([Room()], output=[*sys.argv, "runs/own"][1], force=True)
    print("the map has", run.maps[0].cells.shape, "cells")
