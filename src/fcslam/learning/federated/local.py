"""Federated training of a whole fleet in one process. Only Flower's messages pass between robots and coordinator."""

from collections.abc import Sequence
from pathlib import Path

from fcslam.errors import TrainingError
from fcslam.learning.federated.client import RobotClient
from fcslam.learning.federated.client_app import in_process_grid
from fcslam.learning.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.learning.trainer import ExecutionOptions


def federate_locally(
    folders: Sequence[Path],
    job: FederatedJob,
    options: ExecutionOptions,
    callbacks: ProgressCallbacks,
    most_images: int | None = None,
) -> list[Path]:
    """Run or continue federated training.

    ``folders`` hold the images of each robot, which has the name of its folder. It trains on its first ``most_images``
    alone; None for all.

    Returns:
        The files for the user, see ``run_job``.

    Raises:
        TrainingError: two folders have the same name, a folder is unusable, no robot can train, or the output folder
            belongs to another run.
        OutputError: a file cannot be written.
    """
    names = [folder.resolve().name for folder in folders]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise TrainingError(f"two folders are called {min(twice)}; a robot has its folder's name, so rename one")
    for folder in folders:
        if not folder.is_dir():
            raise TrainingError(f"{folder}: is not a folder; give one folder of images for each robot")
    clients = [
        RobotClient(
            name, folder, job.output / "robots" / name, options.device, callbacks.steps, most_images=most_images
        )
        for name, folder in zip(names, folders, strict=True)
    ]
    return run_job(job, options, callbacks, in_process_grid(clients))
