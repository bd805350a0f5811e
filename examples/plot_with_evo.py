"""Plot the trajectories of a run with evo, and compare one with another system's.

python examples/plot_with_evo.py [RUN_FOLDER [OTHER.tum]]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from evo.core import metrics, sync
from evo.tools import file_interface, plot


def main(folder: Path, other: Path) -> None:
    paths = {file.stem: file_interface.read_tum_trajectory_file(file) for file in folder.glob("trajectories/*.tum")}
    figure = plt.figure()
    plot.trajectories(figure, paths, plot.PlotMode.xy)
    figure.savefig(folder / "evo.png")
    print(f"{len(paths)} trajectories: {folder / 'evo.png'}")

    first, second = sync.associate_trajectories(paths[other.stem], file_interface.read_tum_trajectory_file(other))
    second.align(first)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((first, second))
    print(f"{other}: RMSE {error.get_statistic(metrics.StatisticsType.rmse):.3f} m after alignment")


if __name__ == "__main__":
    run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/two")
    main(run, Path(sys.argv[2]) if len(sys.argv) > 2 else run / "local" / "anna.tum")
