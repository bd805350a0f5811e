"""`fcslam info`: what is in a recording."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.inputs import bag_options, named_path
from fcslam.cli.options import Sensors
from fcslam.cli.output import notices
from fcslam.errors import InputError, SourceError, printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fcslam.sources import BagOptions
    from fcslam.sources.inspection import Inspection, LaserContents


def info(
    recording: Annotated[str, typer.Argument(metavar="RECORDING", help="Recording in any known format.")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="Estimate clocks, beam times, the mounting of the laser and the scale of odometry from the motion in "
            "a bag.",
        ),
    ] = False,
    sensors: Sensors = None,
) -> None:
    """List what is in a recording, and whether it can be mapped. If not, say why and exit with code 1."""
    from fcslam.sources import BagOptions
    from fcslam.sources.formats import CLOUDS, format_of, robot_in
    from fcslam.sources.inspection import inspect

    if as_json and calibrate:
        raise InputError("--json has no calibration; leave out --json or --calibrate")
    path, options = named_path(recording)[0], bag_options(sensors)
    if format_of(robot_in(path)[0]) == CLOUDS:
        options = replace(options or BagOptions(), in_3d=True)
    found = _with_contradictions(inspect(path, options), options)
    if as_json:
        typer.echo(json.dumps(asdict(found), default=str, indent=2, allow_nan=False))
    else:
        for line in _lines(found):
            typer.echo(printable(line))
        for each in found.robots or [found]:
            for line in _calibration(each.path, options) if calibrate and each.problem is None else ():
                typer.echo(printable(line))
    if any(each.problem is not None for each in (found, *found.robots)):
        raise typer.Exit(1)


def _with_contradictions(found: "Inspection", options: "BagOptions | None") -> "Inspection":
    from fcslam.robot.calibrating import bodies_of, contradictions_of, ramps_of
    from fcslam.sources import open_source

    if found.robots:
        return replace(found, robots=tuple(_with_contradictions(robot, options) for robot in found.robots))
    if found.problem is not None:
        return found
    source = open_source(found.path, options)
    lines = (*contradictions_of(source), *bodies_of(source), *ramps_of(source), *_in_space(found.path, options))
    return replace(found, notes=(*found.notes, *lines))


def _in_space(recording: Path, options: "BagOptions | None") -> tuple[str, ...]:
    from fcslam.sources import BagOptions, open_source, whole_clouds
    from fcslam.sources.bags.cloud_bag import CloudBag

    options = replace(options or BagOptions(), in_3d=True)
    source = whole_clouds(open_source(recording, options), options)
    try:
        return source.inputs if isinstance(source, CloudBag) else ()
    except SourceError as error:
        return (f"--3d: {error}",)


def _calibration(recording: Path, options: "BagOptions | None") -> "Iterator[str]":
    from fcslam.cli.warm_up import compiled
    from fcslam.lidar.frontend import LidarConfig
    from fcslam.robot.calibrating import calibrate_bag
    from fcslam.sources.formats import bag_of, open_source

    bag = bag_of(open_source(recording, options))
    if bag is None:
        yield "calibration: of ROS bags only"
        return
    with compiled(notices()):
        found = calibrate_bag(bag, LidarConfig())
    estimated = found.calibration
    mounting = estimated.mounting or (None, None, None)
    yield "calibration from motion (standard deviation):"
    for name, estimate, factor, unit in (
        ("odometry's clock ahead of the scans'", estimated.delay, 1e3, "ms"),
        ("turn by scans per turn by odometry", estimated.turn_scale, 1.0, ""),
        ("distance by scans per distance by odometry", estimated.distance_scale, 1.0, ""),
        ("duration of a scan as a share of the time assumed", estimated.sweep_share, 1.0, ""),
        ("laser off along x", mounting[0], 1.0, "m"),
        ("laser off along y", mounting[1], 1.0, "m"),
        ("laser turned to the left", mounting[2], 180.0 / math.pi, "deg"),
    ):
        value, sigma = (None, None) if estimate is None else (factor * estimate.value, factor * estimate.sigma)
        yield f"  {name}: " + ("unknown" if value is None else f"{value:.3f} ({sigma:.3f}) {unit}".rstrip())
    yield from (f"  {line}" for line in found.lines)


def _lines(found: "Inspection") -> "Iterator[str]":
    from fcslam.sources.formats import CLOUDS

    yield f"{found.path}: {found.format}"
    if found.bag is not None:
        yield "topics:"
        for topic in found.bag.topics:
            rate = "" if topic.rate_hz is None else f", {topic.rate_hz:.1f} Hz"
            frames = found.bag.laser_frames.get(topic.name, ())
            seen_from = f", frame{'s' * (len(frames) > 1)} {', '.join(frames)}" * bool(frames)
            yield f"  {topic.name}: {topic.type}, {topic.messages} messages{rate}{seen_from}"
        if found.bag.transforms:
            yield f"transforms: {', '.join(f'{parent} -> {child}' for parent, child in found.bag.transforms)}"
    if found.robots:
        yield f"robots: {len(found.robots)}"
        for robot in found.robots:
            yield from _lines(robot)
        return
    if found.problem is not None:
        yield f"cannot be mapped: {found.problem}"
        return
    yield f"robot: {found.robot}"
    yield f"{found.scans} scans in {found.duration_s:.1f} s, path of {found.path_length_m:.1f} m by odometry"
    if found.odometry_from is not None:
        rate = f" at {found.odometry / found.duration_s:.1f} Hz" if found.duration_s > 0.0 else ""
        yield f"odometry: {found.odometry} readings of {found.odometry_from}{rate}"
    for number, laser in enumerate(found.lasers):
        yield f"laser {number}: {_laser(laser)}"
    if found.camera is not None:
        camera = found.camera
        yield f"camera: {found.images} images of {camera.width} x {camera.height} pixels"
    if found.faults:
        yield f"faults: {found.faults}"
    yield from found.notes
    yield f"can be mapped{' with --3d' * (found.format == CLOUDS)}"


def _laser(laser: "LaserContents") -> str:
    from fcslam.geometry.beams import beam_step

    model, (x, y, theta), step = laser.model, laser.model.T_base_laser, beam_step(laser.model.beams)
    first_deg = math.degrees(model.angle_min_rad)
    last_deg = first_deg + math.degrees(model.beams.span_rad)
    rate = "" if laser.rate_hz is None else f" at {laser.rate_hz:.1f} Hz"
    return (
        f"{laser.scans} scans{rate}, {model.beam_count} beams from {first_deg:.1f} to {last_deg:.1f} degrees"
        f"{'' if step == 1 else f' (1 of {step} is mapped)'}, "
        f"range up to {model.max_range_m:g} m, mounted at x {x:g} m, y {y:g} m, {math.degrees(theta):.1f} degrees"
    )
