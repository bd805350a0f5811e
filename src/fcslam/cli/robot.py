"""`fcslam robot`: a live robot, which maps and sends to a cloud service."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.inputs import is_live, live_source
from fcslam.cli.live import drive_live
from fcslam.cli.options import (
    STATE,
    Budget,
    ConfigFiles,
    Credentials,
    Floor,
    Quiet,
    RosParameters,
    Sensors,
    ServerUrl,
    Space,
    UseSimTime,
    access,
    mission_config,
    output_option,
)
from fcslam.cli.output import RUNS, notices
from fcslam.cli.training_options import Learn, learning_plan
from fcslam.cli.warm_up import copied_process
from fcslam.errors import InputError


def robot(
    address: Annotated[
        str,
        typer.Argument(
            metavar="ADDRESS",
            help="The robot: ros2:/NAMESPACE or zenoh:/NAMESPACE, without a namespace ros2:/. The namespace names the "
            "robot; NAME=ADDRESS gives another name.",
        ),
    ],
    *,
    server: ServerUrl = None,
    credentials: Credentials = None,
    budget_kBps: Budget = None,
    state: Annotated[Path | None, STATE] = None,
    output: Annotated[Path | None, output_option("Run folder, with the robot's own map.", RUNS)] = None,
    floor: Floor = "",
    config: ConfigFiles = None,
    in_space: Space = False,
    sensors: Sensors = None,
    ros_parameters: RosParameters = None,
    use_sim_time: UseSimTime = False,
    learn: Learn = False,
    quiet: Quiet = False,
) -> None:
    """Map a live robot, alone or with the fleet of a cloud service."""
    from fcslam.api import in_3d
    from fcslam.live.records import Wiring
    from fcslam.live.robot import Robot
    from fcslam.storage.files import keep_private

    keep_private()
    if not is_live(address):
        raise InputError(
            f"{address}: is not the address of a live robot, such as ros2:/robot1; `fcslam play` plays a recording to "
            "a service"
        )
    settings, cloud = mission_config(config, in_space=in_space), access(server, credentials, budget_kBps)
    live = live_source(address, sensors, ros_parameters, use_sim_time)
    live = live._replace(options=in_3d(live.options, settings) or live.options)
    plan = learning_plan(settings.robot, cloud, credentials, state) if learn else None
    with copied_process(None if settings.fleet.dimensions == 3 else settings.robot) as worker:
        wiring = Wiring(worker, keeps_keyframes=learn)
        start = partial(Robot, server=cloud, state=state, config=settings, floor=floor, wiring=wiring)
        drive_live(live, start, output, notices(quiet), plan)
