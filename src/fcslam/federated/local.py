"""A whole fleet in one process: each folder of images is a robot's, and only Flower's messages pass between them."""

from collections.abc import Sequence
from pathlib import Path

from fcslam.errors import TrainingError
from fcslam.federated.client import RobotClient, seeded_noise
from fcslam.federated.client_app import build_client_app
from fcslam.federated.flower import Context
from fcslam.federated.grid import InProcessGrid
from fcslam.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.learning.trainer import ExecutionOptions


def federate_locally(
    folders: Sequence[Path], task: FederatedJob, pace: ExecutionOptions, watches: ProgressCallbacks
) -> list[Path]:
    """Run or resume federated training of robots with their images in ``folders``; returns the files that were made.

    Raises:
        TrainingError: folders have one name, a folder is unusable, no robot can train, or the output is another run's.
        OutputError: something cannot be written.
    """
    names = [folder.resolve().name for folder in folders]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise TrainingError(f"two folders are called {min(twice)}; a folder's name is the robot's, so rename one")
    for folder in folders:
        if not folder.is_dir():
            raise TrainingError(f"{folder}: is no folder; give one folder of images for each robot")
    robots = [
        RobotClient(
            name,
            folder,
            task.output / "robots" / name,
            seeded_noise(name, task.settings.training.seed),
            pace.device,
            watches.steps,
        )
        for name, folder in zip(names, folders, strict=True)
    ]

    def robot_of(context: Context) -> RobotClient:
        return robots[int(context.node_config["partition-id"])]

    return run_job(task, pace, watches, InProcessGrid(build_client_app(robot_of), len(robots)))
