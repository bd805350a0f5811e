"""A copy of the maps of a cloud, for a robot that finds itself in them: also when the cloud cannot be reached."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.errors import CloudError, InputError, SourceError, UnavailableError
from fcslam.maps.occupancy_map import area_of, map_stem, parse_map
from fcslam.records import FloatArray, frozen
from fcslam.runs import RobotTrajectory, Run, open_run, prepare_output
from fcslam.runs.folder import is_run_folder
from fcslam.wire.fleet_client import FleetClient
from fcslam.wire.fleet_replies import ServedMap
from fcslam.wire.http_transport import addresses
from fcslam.wire.keys import Server

_ATTEMPTS: Final = 3
"""The cloud may draw its maps again while the robot reads them."""


def fetch_maps(folder: Path, server: Server) -> str | None:
    """Copy the maps of a cloud into a run folder, whole or not at all: their files, robots and floors.

    An earlier copy in ``folder`` is replaced. The token of ``server`` has the rights of a viewer.

    Returns:
        None; or why the cloud cannot be reached, if ``folder`` holds an earlier copy, which then stays as it is.
    """
    if is_run_folder(folder) and _has_poses(open_run(folder, maps=False)):
        raise InputError(f"{folder}: is a run folder, not a copy of a cloud's maps; give another folder")
    prepare_output(folder, force=True)
    troubles = []
    for address in addresses(server.url):
        with closing(FleetClient(replace(server, url=address))) as client:
            try:
                _read(client, address).save(folder, force=True)
                return None
            except UnavailableError as error:
                troubles.append(str(error))
    trouble = "; ".join(troubles)
    if not is_run_folder(folder):
        raise CloudError(f"{trouble}; {folder} holds no earlier copy of the map")
    return trouble


def _has_poses(run: Run) -> bool:
    """Whether it is no copy of a cloud's maps: their poses stay in the cloud."""
    return bool(run.localized) or any(len(track.stamps) for track in run.trajectories.values())


def _read(client: FleetClient, server: str) -> Run:
    for _ in range(_ATTEMPTS):
        served = [one for one in client.maps() if one.extent_m is not None]
        if not served:
            raise SourceError(f"{server}: has no map yet; let a robot send its scans first")
        files = {
            f"{map_stem(one.number)}.{suffix}": client.file(one.number, suffix)
            for one in served
            for suffix in ("yaml", *["ply"] * one.in_space, "pgm")
        }
        if all(_fits(one, files, server) for one in served):
            poses: tuple[FloatArray, FloatArray] = frozen(np.empty(0)), frozen(np.empty((0, 3)))
            trajectories = {
                robot: RobotTrajectory(robot, one.number, *poses, one.floor) for one in served for robot in one.robots
            }
            return Run(trajectories=trajectories, map_files=files)
    raise UnavailableError(f"{server}: its maps change all the time")


def _fits(served: ServedMap, files: dict[str, bytes], server: str) -> bool:
    """Whether the image and the description of a map are of one moment: that of the list of maps."""
    stem = map_stem(served.number)
    image, description = files[f"{stem}.pgm"], files[f"{stem}.yaml"].decode("utf-8", errors="replace")
    try:
        _, extent_m = area_of(stem, image, description)
        if not np.allclose(extent_m, served.extent_m or (), rtol=0.0, atol=1e-6):
            return False
        parse_map(stem, image, description)
    except InputError as error:
        raise CloudError(f"{server}: {error}") from error
    return True
