"""`fcslam localize`: a robot and a finished map in, the poses of the robot in the map out."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import is_live, live_source, open_recording, pose, print_faults
from fcslam.cli.live import drive_live
from fcslam.cli.options import (
    ConfigFiles,
    Credentials,
    Force,
    Quiet,
    RosParameters,
    Sensors,
    ServerUrl,
    UseSimTime,
    access,
    mission_config,
    output_option,
)
from fcslam.cli.output import RUNS, new_folder, notices, print_line
from fcslam.cli.warm_up import compiled, copied_process
from fcslam.errors import InputError

if TYPE_CHECKING:
    from fcslam.mission.localization import LocalizationProgress
    from fcslam.runs import Run


def localize(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="The robot's recording, or a live robot as ros2:/NAMESPACE. The file or the namespace names the "
            "robot; NAME=SOURCE gives another name.",
        ),
    ],
    *,
    map_path: Annotated[
        Path,
        typer.Option(
            "--map",
            metavar="MAP",
            help="Run folder, mission file, or the YAML file of a ROS map. With --server, a folder for a copy of the "
            "cloud's maps; if the cloud cannot be reached, an earlier copy is used.",
        ),
    ],
    output: Annotated[Path | None, output_option("Run folder to write.", RUNS)] = None,
    initial_pose: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,THETA",
            help="About where the robot starts in the map (metres, radians).",
            show_default="anywhere",
        ),
    ] = None,
    floor: Annotated[
        str, typer.Option(help="Floor that the robot is on.", show_default="the floor of the map, if it has only one")
    ] = "",
    update: Annotated[
        bool,
        typer.Option(
            "--update",
            help="Update the map of the run folder where at least three scans show a change. The previous map stays "
            "beside it as map_before.",
        ),
    ] = False,
    config: ConfigFiles = None,
    server: ServerUrl = None,
    credentials: Credentials = None,
    sensors: Sensors = None,
    ros_parameters: RosParameters = None,
    use_sim_time: UseSimTime = False,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Find a robot in a finished map and follow it. The map does not change.

    The run folder has the poses of all localized scans, and for every scan its standard deviations and quality.
    """
    from fcslam.api import localize as localize_recording
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.mission.localization import read_finished
    from fcslam.runs import prepare_output
    from fcslam.storage.files import keep_private

    settings, console = mission_config(config), notices(quiet)
    initial = None if initial_pose is None else pose("--initial-pose", initial_pose)
    cloud, live = access(server, credentials), is_live(source)
    if live and update:
        raise InputError("--update draws what a recording saw; record the drive, and localize the recording")
    if cloud is not None:
        from fcslam.live.served_map import fetch_maps

        keep_private()
        trouble = fetch_maps(map_path, cloud)
        copied = f"copied the maps of {cloud.url} to {map_path}"
        print_line(console, f"{trouble}; the robot uses the earlier copy in {map_path}" if trouble else copied)
    if live:
        from fcslam.live.localized_robot import LocalizedRobot
        from fcslam.live.records import Wiring

        robot = live_source(source, sensors, ros_parameters, use_sim_time)
        with copied_process(settings.robot) as worker:
            start = partial(LocalizedRobot, map=map_path, initial_pose=initial, config=settings, floor=floor)
            drive_live(robot, partial(start, wiring=Wiring(worker)), output, console)
        return
    output = output or new_folder(RUNS)
    prepare_output(output, force)
    with compiled(console):
        finished = read_finished(map_path, floor)
        recording, survey = open_recording(source, sensors, console, bool(finished.ply), settings.robot.lidar)
        with ProgressDisplay(console) as display:

            def watch(now: "LocalizationProgress") -> None:
                state = f"localized, quality {now.quality:.2f}" if now.is_localized else "not localized"
                display.show("localizing", now.scans, survey.scan_count, state)

            run = localize_recording(
                recording, finished, initial_pose=initial, config=settings, progress=watch, update=update
            )
            run.save(output, force)
    print_faults(console, {recording.name: recording.faults})
    _report(run, recording.name, output)


def _report(run: "Run", robot: str, output: Path) -> None:
    values = {name: metric.value for name, metric in run.metrics.items()}
    share, scans = values["localized_share"], int(values["scans"])
    if not values["fixes"]:
        typer.echo(
            f"{robot}: not localized in {scans} scans; is this the right map, and did the robot drive far enough?",
        )
    else:
        times = "" if values["losses"] == 0 else f", lost {values['losses']:.0f} x"
        typer.echo(
            f"{robot}: localized after {values['first_fix_after']:.1f} m, at {share:.0%} of {scans} scans{times}",
        )
    typer.echo(f"poses: {output / 'localization' / f'{robot}.csv'}")
    typer.echo(f"map: {output / 'map.png'}")
