"""`fcslam map`: recordings of several robots in, one map out."""

import gc
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import bag_options, named_path, print_faults, print_notes
from fcslam.cli.options import (
    ConfigFiles,
    Force,
    Quiet,
    Sensors,
    Space,
    WorkersOption,
    mission_config,
    output_option,
    with_starts,
)
from fcslam.cli.output import RUNS, answers, new_folder, notices, verdict_lines
from fcslam.cli.warm_up import compiled, cores
from fcslam.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.mission.mission import MissionConfig, MissionInputs, Progress
    from fcslam.mission.mission_file import SavedMission
    from fcslam.runs import RobotTrajectory, Run
    from fcslam.sources import Source
    from fcslam.sources.faults import Faults


def map_recordings(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="LOG...",
            help="One recording per robot. The file names the robot; NAME=LOG gives it another name. A bag of several "
            "robots gives all of them, and BAG:/ROBOT one. With --onto, none maps the mission again with its edits.",
        ),
    ] = None,
    *,
    output: Annotated[Path | None, output_option("Run folder to write.", RUNS)] = None,
    split: Annotated[
        int, typer.Option(min=1, help="Split the one LOG into this number of robots with equal scan counts.")
    ] = 1,
    onto: Annotated[
        Path | None,
        typer.Option(
            metavar="MISSION",
            help="Run folder or mission file of an earlier mission to continue; its recordings are not needed.",
        ),
    ] = None,
    floor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME[@TIME]=]FLOOR",
            help="Floor of all LOGs, or of the robot NAME; with @TIME, from TIME seconds after its first scan on, "
            "in a new session. Places of different floors are never compared. Can be repeated.",
        ),
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            metavar="PLAN",
            help="Floor plan of the building: a picture (with --plan-scale), a DXF drawing, or the YAML file of a ROS "
            "map. The map is aligned with it, and given in its coordinates.",
        ),
    ] = None,
    plan_scale: Annotated[
        float | None, typer.Option(metavar="M", help="Metres per pixel of the plan, or per unit of a DXF drawing.")
    ] = None,
    tags: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML file of surveyed tags. The map is given in their coordinates."),
    ] = None,
    config: ConfigFiles = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=X,Y,THETA",
            help="Where a robot starts, in metres and radians, in one frame for all robots. It helps to join maps and "
            "forces nothing; `-c 'fleet.start_sigma=[M,RAD]'` says how exactly you know it. Can be repeated.",
        ),
    ] = None,
    in_space: Space = False,
    sensors: Sensors = None,
    force: Force = False,
    quiet: Quiet = False,
    workers: WorkersOption = "1",
) -> None:
    """Map recordings of several robots into one map, with the trajectory of every robot and all closures."""
    recordings = [named_path(log) for log in logs or ()]
    if not recordings and onto is None:
        raise InputError("no recording is given; give one for each robot: fcslam map robot1.bag robot2.bag")
    with _without_collection():
        from fcslam.anchoring.anchors import read_anchors
        from fcslam.api import in_3d, notes_in_space, split_recordings
        from fcslam.cluster.verifying import verifying
        from fcslam.mission.mission import MissionInputs, continued_config
        from fcslam.mission.mission_file import EMPTY, read_mission
        from fcslam.robot.calibrating import calibrated
        from fcslam.runs import prepare_output
        from fcslam.sources import open_fleet

        output = output or new_folder(RUNS)
        prepare_output(output, force)
        earlier = EMPTY if onto is None else read_mission(onto)
        settings = with_starts(mission_config(config, continued_config(earlier), in_space), start)
        anchors = read_anchors(plan, plan_scale, tags)
        options = in_3d(bag_options(sensors), settings)
        with compiled(notices(quiet)):
            opened = [calibrated(source, settings.robot.lidar) for source in open_fleet(recordings, options)]
        print_notes(notices(quiet), notes_in_space(opened, settings))
        sources = split_recordings(opened, split)
        floors = floors_of(floor or [], [source.name for source in sources])
    with verifying(workers) as verify:
        inputs = MissionInputs(earlier, floors=floors, anchors=anchors, verify_pairs=verify)
        map_sources(sources, settings, inputs, output, notices(quiet), force)


def floors_of(options: "Sequence[str]", robots: "Sequence[str]") -> dict[str, str]:
    """The floor of each robot that has one; NAME=FLOOR counts before FLOOR."""
    common = [option for option in options if "=" not in option]
    named = [(name, floor) for name, _, floor in (option.partition("=") for option in options if "=" in option)]
    twice = next((name for name, count in Counter(name for name, _ in named).items() if count > 1), None)
    if twice is not None or len(common) > 1:
        raise InputError(f"--floor: {'all recordings' if twice is None else twice} can be on one floor only")
    return dict.fromkeys(robots, common[0]) | dict(named) if common else dict(named)


def map_sources(
    sources: "Sequence[Source]",
    settings: "MissionConfig",
    inputs: "MissionInputs",
    output: Path,
    console: "Console",
    force: bool = False,
) -> "Run":
    """Run the mission, write the run folder and print a summary; progress and notices go to ``console``.

    A run that appeared at ``output`` meanwhile is replaced only with ``force``.
    """
    with _without_collection():
        from fcslam.cli.progress import ProgressDisplay
        from fcslam.mission.driving import side_by_side
        from fcslam.mission.mission import doubted, run_mission

        surveys = {source.name: source.survey() for source in sources}  # refuses bad recordings before the work
        gc.freeze()
    gc.set_threshold(100_000, 50, 100)  # many small arrays and no cycles: looking for some costs a tenth of the time
    print_notes(console, (note for survey in surveys.values() for note in survey.notes))
    began = time.perf_counter()
    with compiled(console), ProgressDisplay(console) as display:
        faults: dict[str, Faults] = {}
        known = sum(len(track.stamps) for track in inputs.onto.tracks.values())
        progress = _watch(display, known + sum(survey.scan_count for survey in surveys.values()), faults)
        run = doubted(run_mission(sources, settings, progress, inputs, side_by_side(cores())), surveys)
        display.start("writing")
        run.save(output, force)
    print_faults(console, faults)
    _report(run, time.perf_counter() - began, output, inputs.onto)
    return run


@contextmanager
def _without_collection() -> Iterator[None]:
    """Collect no garbage: imports and surveys make many objects, and all of them stay."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def _watch(display: "ProgressDisplay", total: int, faults: "dict[str, Faults]") -> "Callable[[Progress], None]":
    def watch(now: "Progress") -> None:
        counts = f"{sum(now.closures.values())} closures, {now.keyscans} keyscans"
        display.show("mapping", now.scans, total, counts)
        faults.update(now.faults)
        if now.fusing:
            display.start("fusing")

    return watch


def _report(run: "Run", elapsed_s: float, output: Path, earlier: "SavedMission") -> None:
    from rich.table import Table

    from fcslam.anchoring.anchors import anchoring_lines

    values = {name: metric.value for name, metric in run.metrics.items()}
    has_floors = any(trajectory.floor for trajectory in run.trajectories.values())
    table = Table("robot", *["floor"] * has_floors, "map", "path, m", "scans")
    for trajectory in run.trajectories.values():
        table.add_row(
            trajectory.robot,
            *[trajectory.floor] * has_floors,
            str(trajectory.map_index),
            f"{trajectory.path_length_m:.1f}",
            str(len(trajectory.stamps)),
        )
    answers().print(table)
    recorded_s = values["recorded_time"]
    speed = f" ({recorded_s / elapsed_s:.3g} x real time)" if recorded_s > 0.0 < elapsed_s else ""
    typer.echo(
        f"{values['scans']:.0f} scans in {elapsed_s:.1f} s{speed}, "
        f"{values['intra_robot_closures_accepted']:.0f} closures within robots, "
        f"{values['inter_robot_closures_accepted']:.0f} between them",
    )
    lines = [*_session_lines(run, earlier)]
    lines += anchoring_lines(run.map_files)
    lines += [f"map: {output / name}" for name in sorted(run.map_files) if name.endswith((".png", ".ply"))]
    lines += verdict_lines(run.verdict)
    typer.echo("\n".join(lines))


def _session_lines(run: "Run", earlier: "SavedMission") -> Iterator[str]:
    from fcslam.cloud.sessions import robot_and_epoch

    before: dict[str, RobotTrajectory] = {}
    first_s: dict[str, float] = {}
    for session in run.trajectories.values():
        robot, epoch = robot_and_epoch(session.robot)
        last, begin_s = before.get(robot, session), session.stamps[0]
        before[robot] = session
        if epoch <= earlier.session_count(robot):  # the first session of a recording began with it
            first_s[robot] = begin_s
            continue
        remedy = ""
        if begin_s < last.stamps[-1] and last is not session:
            why = "the clock stepped back"
        elif session.floor and session.floor != last.floor:
            why = f"{robot} came to floor {session.floor}"
        else:
            why = f"{robot} was lost or rode in a lift"
            after_s = math.floor(10.0 * (begin_s - first_s.get(robot, begin_s))) / 10.0
            remedy = f"; if it is on another floor then, give --floor {robot}@{after_s:.1f}=FLOOR"
        yield f"{session.robot}: {why}; this session begins at {begin_s:.3f} s{remedy}"
