"""`fcslam map`: recordings of several robots in, one map out."""

import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.recordings import (
    CameraTopic,
    LaserPose,
    OdomTopic,
    ScanTopic,
    bag_options,
    open_recording,
    show_faults,
    show_notes,
)
from fcslam.cloud.fusion_strategy import FusionStrategy

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.mission import MissionConfig, Progress, Watch
    from fcslam.records import Veto
    from fcslam.runs import Run
    from fcslam.sources import Source


def map_recordings(
    logs: Annotated[
        list[str],
        typer.Argument(metavar="LOG...", help="One recording a robot, which is named after it; NAME=LOG names it so."),
    ],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="The run folder to write.")],
    split: Annotated[int, typer.Option(min=1, help="Cut one LOG into this many robots of equal scan count.")] = 1,
    no_fuse: Annotated[bool, typer.Option("--no-fuse", help="Map each robot alone.")] = False,
    fusion: Annotated[
        FusionStrategy | None,
        typer.Option(
            help="How maps become one: a joint robust graph, or rigid maps laid on one another by matched points; "
            "the configuration's if not given."
        ),
    ] = None,
    veto: Annotated[
        Path | None,
        typer.Option(
            help="Closures known to be false: lines of a run's closures.csv; without stamps, all of two robots."
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Configuration file; see `fcslam config dump`.")
    ] = None,
    scan_topic: ScanTopic = None,
    odom_topic: OdomTopic = None,
    camera_topic: CameraTopic = None,
    laser_pose: LaserPose = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the run; the configuration's if not given.")] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace a run that is there already.")] = False,
) -> None:
    """Map recordings together: one map, every robot's trajectory in it, and the closures that hold it together."""
    from fcslam.runs import prepare_output, read_vetoes

    prepare_output(output, force)
    settings = _settings(config, seed, no_fuse, fusion)
    vetoes = read_vetoes(veto) if veto else ()
    options = bag_options(scan_topic, odom_topic, camera_topic, laser_pose)
    sources = _sources([open_recording(log, options) for log in logs], split)
    map_sources(sources, settings, output, force, vetoes)


def map_sources(
    sources: "Sequence[Source]", settings: "MissionConfig", output: Path, force: bool, vetoes: "Sequence[Veto]" = ()
) -> "Run":
    """Run the mission with a progress display, write the run folder, say what came out.

    A run that appeared at ``output`` meanwhile is replaced only by ``force``.
    """
    from rich.console import Console

    from fcslam.mission import run_mission

    console = Console(stderr=True)
    surveys = [source.survey() for source in sources]  # refuses bad recordings before the work
    show_notes(console, (note for survey in surveys for note in survey.notes))
    began = time.perf_counter()
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)  # many small arrays and no cycles: looking for some costs a tenth of the time
    with _progress(console, sum(survey.scan_count for survey in surveys)) as watch:
        run = run_mission(sources, settings, watch, vetoes)
    run.save(output, force)
    show_faults(console, sources)
    _report(Console(), run, time.perf_counter() - began, output, settings.fleet.join_maps)
    return run


def _settings(config: Path | None, seed: int | None, no_fuse: bool, fusion: FusionStrategy | None) -> "MissionConfig":
    from fcslam.config import load
    from fcslam.errors import ConfigError
    from fcslam.mission import MissionConfig

    settings = MissionConfig() if config is None else load(MissionConfig, config)
    if seed is not None:
        settings = settings.model_copy(update={"seed": seed})
    if no_fuse and fusion is not None:
        raise ConfigError("--no-fuse leaves nothing to fuse; drop it or --fusion")
    changes: dict[str, object] = {"join_maps": False} if no_fuse else {}
    changes |= {"fusion": fusion} if fusion is not None else {}
    return settings.model_copy(update={"fleet": settings.fleet.model_copy(update=changes)})


def _sources(sources: "list[Source]", parts: int) -> "list[Source]":
    from fcslam.errors import SourceError
    from fcslam.sources import split

    if parts == 1:
        return sources
    if len(sources) != 1:
        raise SourceError(f"--split cuts one recording, {len(sources)} are given; map them one by one")
    return split(sources[0], parts)


@contextmanager
def _progress(console: "Console", total: int) -> "Iterator[Watch]":
    """A live line: scans, speed against real time, keyscans, closures per kind."""
    from rich import progress

    columns = [
        progress.TextColumn("{task.fields[stage]}"), progress.BarColumn(bar_width=24), progress.MofNCompleteColumn(),
        progress.TextColumn("scans, {task.fields[what]}"), progress.TimeRemainingColumn(),
    ]  # fmt: skip
    # where nobody watches, even an erased display leaves an empty line
    with progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, stage="mapping", what="")
        began = time.perf_counter()

        def watch(now: "Progress") -> None:
            what = _what(now, time.perf_counter() - began)
            bar.update(task, completed=now.scans, stage="fusing" if now.fusing else "mapping", what=what)

        yield watch


def _what(progress: "Progress", elapsed_s: float) -> str:
    closures = ", ".join(f"{count} {kind}" for kind, count in progress.closures.items() if count)
    speed = progress.recorded_s / max(elapsed_s, 1e-9)
    return f"{speed:.0f} x real time, {progress.keyscans} keyscans, closures: {closures or 'none'}"


def _report(console: "Console", run: "Run", elapsed_s: float, output: Path, joined: bool) -> None:
    from rich.table import Table

    from fcslam.cloud.sessions import robot_of

    values = {name: metric.value for name, metric in run.metrics.items()}
    table = Table("robot", "map", "path, m", "scans")
    for trajectory in run.trajectories.values():
        table.add_row(
            trajectory.robot, str(trajectory.map_index), f"{trajectory.path_length_m:.1f}", str(len(trajectory.stamps))
        )
    console.print(table)
    console.print(
        f"{values['scans']:.0f} scans in {elapsed_s:.1f} s ({values['recorded_time'] / elapsed_s:.0f} x real time), "
        f"{values['intra_robot_closures_accepted']:.0f} closures within robots, "
        f"{values['inter_robot_closures_accepted']:.0f} between them",
        highlight=False,
        soft_wrap=True,
    )
    for session in run.trajectories.values():
        if robot_of(session.robot) != session.robot:
            console.print(
                f"{session.robot}: {robot_of(session.robot)} was lost, and began anew at {session.stamps[0]:.3f}",
                highlight=False, soft_wrap=True,
            )  # fmt: skip
    maps = int(values["maps"])
    if maps > 1:
        why = (
            "some robots share no place that geometry confirms (see closures.csv)"
            if joined
            else "one a robot, as asked"
        )
        console.print(f"{maps} maps: {why}", highlight=False, soft_wrap=True)
    console.print(f"map: {output / 'map.png'}", highlight=False, markup=False, soft_wrap=True)
