"""What runs inside Flower's own processes: the server's app beside a SuperLink, a robot's beside its SuperNode."""

import json
import time
from pathlib import Path
from typing import Any, Final

from fcslam.errors import FcslamError, OutputError
from fcslam.federated.client import RobotClient, secret_noise, seeded_noise
from fcslam.federated.client_app import build_client_app
from fcslam.federated.flower import Context, Grid, ServerApp
from fcslam.federated.job import FederatedJob, ProgressCallbacks, run_job
from fcslam.federated.settings import FederatedSettings
from fcslam.learning.trainer import ExecutionOptions
from fcslam.storage.files import write_file

STATUS_FILE: Final = "status.json"
WAIT_S: Final = 5.0


def encode_job(task: FederatedJob, device: str) -> str:
    """A task as a line that ``decode_job`` understands."""
    paths = {"output": str(task.output.resolve()), "public": [str(path.resolve()) for path in task.public]}
    start = None if task.start is None else str(task.start.resolve())
    settings = task.settings.model_dump(mode="json")
    return json.dumps({**paths, "start": start, "settings": settings, "device": device})


def decode_job(text: str) -> tuple[FederatedJob, str]:
    """A task and the device to work on."""
    content = json.loads(text)
    start = None if content["start"] is None else Path(content["start"])
    settings = FederatedSettings.model_validate(content["settings"])
    public = tuple(Path(path) for path in content["public"])
    return FederatedJob(Path(content["output"]), settings, start, public), content["device"]


def write_status(folder: Path, state: str, text: str) -> None:
    """Say in the run folder how the server fares, for who started it and cannot see it.

    Raises:
        OutputError: it cannot be written.
    """
    path = folder / STATUS_FILE
    try:
        write_file(path, json.dumps({"state": state, "text": text}))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error})") from error


def read_status(folder: Path) -> tuple[str, str]:
    """What ``write_status`` wrote last: `running`, `waiting`, `done` or `failed`, and more in words."""
    try:
        content = json.loads((folder / STATUS_FILE).read_text(encoding="utf-8"))
        return str(content["state"]), str(content["text"])
    except (OSError, ValueError, KeyError, TypeError):
        return "running", ""


server = ServerApp()
"""Named in the app that the SuperLink is given."""


@server.main()
def serve(grid: Grid, context: Context) -> None:
    """Run the task in the run's configuration; all that goes wrong is said in its folder."""
    task, device = decode_job(str(context.run_config["task"]))

    def wait(reason: str) -> None:
        write_status(task.output, "waiting", reason)
        time.sleep(WAIT_S)
        write_status(task.output, "running", "")

    try:
        run_job(task, ExecutionOptions(device=device), ProgressCallbacks(), grid, wait)
        write_status(task.output, "done", "")
    except FcslamError as error:
        write_status(task.output, "failed", str(error))
        raise


def _robot_of(context: Context) -> RobotClient:
    config: dict[str, Any] = context.node_config
    name = str(config["robot"])
    seed = config.get("noise-seed")
    noise = secret_noise if seed is None else seeded_noise(name, int(seed))
    return RobotClient(name, Path(str(config["images"])), Path(str(config["labels"])), noise, str(config["device"]))


robot = build_client_app(_robot_of)
"""Named in the app that every SuperNode runs."""
