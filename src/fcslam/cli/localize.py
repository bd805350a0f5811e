"""`fcslam localize`: a recording and a finished map in, the poses of the robot in the map out."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.mission_options import ConfigFile, mission_config
from fcslam.cli.options import Force, Quiet, output_option
from fcslam.cli.output import RUNS, answers, new_folder, notices, print_line
from fcslam.cli.recordings import (
    BaseFrame,
    CameraTopic,
    CloudHeights,
    InitialPose,
    LaserPose,
    OdomFrame,
    OdomTopic,
    ScanTopic,
    bag_options,
    open_recording,
    pose,
    print_faults,
    print_notes,
)
from fcslam.cli.warm_up import compiled

if TYPE_CHECKING:
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.mission.localization import LocalizationProgress
    from fcslam.runs import Run


def localize(
    recording: Annotated[
        str,
        typer.Argument(
            metavar="RECORDING",
            help="The robot's recording. The file names the robot; NAME=RECORDING gives another name.",
        ),
    ],
    *,
    map_path: Annotated[
        Path,
        typer.Option(
            "--map",
            metavar="MAP",
            help="Run folder, mission file, or the YAML file of a ROS map.",
        ),
    ],
    output: Annotated[Path | None, output_option("Run folder to write.", RUNS)] = None,
    initial_pose: InitialPose = None,
    floor: Annotated[
        str, typer.Option(help="Floor that the robot is on.", show_default="that of the map, if it has one only")
    ] = "",
    update: Annotated[
        bool,
        typer.Option(
            "--update",
            help="Draw what changed since into the map of the run folder, where at least three scans show it. The "
            "map before stays beside it as map_before.",
        ),
    ] = False,
    config: ConfigFile = None,
    scan_topic: ScanTopic = None,
    odom_topic: OdomTopic = None,
    odom_frame: OdomFrame = None,
    base_frame: BaseFrame = None,
    camera_topic: CameraTopic = None,
    laser_pose: LaserPose = None,
    cloud_band: CloudHeights = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Find a robot in a finished map and follow it; the map that is given does not change.

    The run folder holds the poses that the robot believed, and for every scan its standard deviations and quality.
    """
    from fcslam.api import localize as localize_recording
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.runs import prepare_output

    output = output or new_folder(RUNS)
    prepare_output(output, force)
    settings = mission_config(config)
    initial = None if initial_pose is None else pose("--initial-pose", initial_pose)
    source = open_recording(
        recording, bag_options(scan_topic, odom_topic, camera_topic, laser_pose, odom_frame, base_frame, cloud_band)
    )
    survey = source.survey()
    console = notices(quiet)
    print_notes(console, survey.notes)
    with compiled(console), ProgressDisplay(console) as display:
        run = localize_recording(
            source, map_path, initial_pose=initial, config=settings, progress=_watch(display, survey.scan_count),
            floor=floor, update=update,
        )  # fmt: skip
        run.save(output, force)
    print_faults(console, {source.name: source.faults})
    _report(run, source.name, output)


def _watch(display: "ProgressDisplay", total: int) -> "Callable[[LocalizationProgress], None]":
    def watch(now: "LocalizationProgress") -> None:
        state = f"localised, quality {now.quality:.2f}" if now.is_localized else "not localised"
        display.show("localising", now.scans, total, state)

    return watch


def _report(run: "Run", robot: str, output: Path) -> None:
    console, values = answers(), {name: metric.value for name, metric in run.metrics.items()}
    share, scans = values["localized_share"], int(values["scans"])
    if not values["fixes"]:
        print_line(
            console,
            f"{robot}: not localised in {scans} scans; is this the right map, and did the robot drive far enough?",
        )
    else:
        times = "" if values["losses"] == 0 else f", lost {values['losses']:.0f} x"
        print_line(
            console,
            f"{robot}: localised after {values['first_fix_after']:.1f} m, at {share:.0%} of {scans} scans{times}",
        )
    print_line(console, f"poses: {output / 'localization' / f'{robot}.csv'}")
    print_line(console, f"map: {output / 'map.png'}")
