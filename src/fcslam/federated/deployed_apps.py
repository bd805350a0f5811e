"""The apps inside Flower's own processes: the server's beside a SuperLink, a robot's beside its SuperNode."""

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
"""Time after which a round is tried again that could not be completed."""


def encode_job(job: FederatedJob, device: str) -> str:
    """A job and the device to work on as one line of text."""
    paths = {"output": str(job.output.resolve()), "public": [str(path.resolve()) for path in job.public]}
    start = None if job.start is None else str(job.start.resolve())
    settings = job.settings.model_dump(mode="json")
    return json.dumps({**paths, "start": start, "settings": settings, "device": device})


def decode_job(text: str) -> tuple[FederatedJob, str]:
    """The job and the device of ``encode_job``."""
    content = json.loads(text)
    start = None if content["start"] is None else Path(content["start"])
    settings = FederatedSettings.model_validate(content["settings"])
    public = tuple(Path(path) for path in content["public"])
    return FederatedJob(Path(content["output"]), settings, start, public), content["device"]


def write_status(folder: Path, state: str, text: str) -> None:
    """Write the server's state into the run folder, where the process that started it can read it.

    Args:
        folder: of the run.
        state: `running`, `waiting`, `done` or `failed`.
        text: the reason for `waiting` and `failed`.

    Raises:
        OutputError: the file cannot be written.
    """
    path = folder / STATUS_FILE
    try:
        write_file(path, json.dumps({"state": state, "text": text}))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error})") from error


def read_status(folder: Path) -> tuple[str, str]:
    """State and text of ``write_status``; `running` if there is no file yet."""
    try:
        content = json.loads((folder / STATUS_FILE).read_text(encoding="utf-8"))
        return str(content["state"]), str(content["text"])
    except (OSError, ValueError, KeyError, TypeError):
        return "running", ""


server_app = ServerApp()
"""The app of the server; ``launch`` names it to the SuperLink."""


@server_app.main()
def run_server(grid: Grid, context: Context) -> None:
    """Run the job in the run's configuration, and write every outcome into its folder."""
    job, device = decode_job(str(context.run_config["task"]))

    def wait(reason: str) -> None:
        write_status(job.output, "waiting", reason)
        time.sleep(WAIT_S)
        write_status(job.output, "running", "")

    try:
        run_job(job, ExecutionOptions(device=device), ProgressCallbacks(), grid, wait)
        write_status(job.output, "done", "")
    except FcslamError as error:
        write_status(job.output, "failed", str(error))
        raise


def _client_of(context: Context) -> RobotClient:
    config: dict[str, Any] = context.node_config
    name = str(config["robot"])
    seed = config.get("noise-seed")
    noise = secret_noise if seed is None else seeded_noise(name, int(seed))
    return RobotClient(name, Path(str(config["images"])), Path(str(config["labels"])), noise, str(config["device"]))


robot_app = build_client_app(_client_of)
"""The app of every robot; ``launch`` names it to the SuperLink, which sends it to the SuperNodes."""
