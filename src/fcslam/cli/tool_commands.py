"""Short commands of `fcslam tools`: configuration, changes of a building, features of images, credentials."""

import os
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import Force, mission_config, output_option
from fcslam.cli.output import CHANGES, FEATURES, new_folder, notices, print_line
from fcslam.errors import FeatureError, InputError, PacketError
from fcslam.features.detector_kinds import DetectorKind
from fcslam.lab.presets import Preset

_WHEN = "a session, a date (2026-11-23: its end), a time of ISO 8601, or a stamp in seconds"


def config(
    preset: Annotated[Preset | None, typer.Argument(help="A preset in place of the defaults.")] = None,
) -> None:
    """Print a complete configuration of a mission as YAML. A comment above each key explains it."""
    from fcslam.config import dump

    typer.echo(dump(mission_config(None if preset is None else [preset])), nl=False)


def changes(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder with a mission file.")],
    *,
    since: Annotated[
        str | None,
        typer.Option(metavar="WHEN", help=f"Compare with the map as it was then: {_WHEN}.", show_default="the oldest"),
    ] = None,
    until: Annotated[
        str | None, typer.Option(metavar="WHEN", help="The later time, in the same forms.", show_default="the newest")
    ] = None,
    map_index: Annotated[int, typer.Option("--map", min=0, help="Number of the map in the run folder.")] = 0,
    output: Annotated[Path | None, output_option("Folder to write.", CHANGES)] = None,
    force: Force = False,
) -> None:
    """Show what appeared and disappeared in the building between two sessions or dates."""
    from fcslam import api
    from fcslam.mission.map_changes import PICTURE, TABLE

    output = output or new_folder(CHANGES)
    found = api.changes(run, since=since, until=until, map_index=map_index, output=output, force=force)
    for kind in ("appeared", "disappeared"):
        regions = [region for region in found.regions if region.kind == kind]
        area_m2 = sum(region.area_m2 for region in regions)
        typer.echo(f"{kind}: {len(regions)} region{'s' * (len(regions) != 1)}, {area_m2:.2f} m2 of surface")
    typer.echo(f"picture: {output / PICTURE}")
    typer.echo(f"regions: {output / TABLE}")


def extract(
    images: Annotated[Path, typer.Argument(help="An image, or a folder of images, searched with its subfolders.")],
    *,
    output: Annotated[
        Path | None, output_option("Folder for the features, one .npz file for each image.", FEATURES)
    ] = None,
    detector: Annotated[
        str,
        typer.Option(metavar="orb|onnx|FILE", help="orb, onnx (the bundled network), or the .onnx file of a network."),
    ] = "onnx",
    keypoints: Annotated[
        int, typer.Option(min=1, max=2000, help="Number of keypoints to keep of each image, strongest first.")
    ] = 1000,
) -> None:
    """Find keypoints in images and describe each with 256 bits."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.features.classical import make_detector
    from fcslam.features.detector import MATCHING_SCALES, OnnxConfig
    from fcslam.features.files import extract_all, find_files

    named = detector in list(DetectorKind)
    kind = DetectorKind(detector) if named else DetectorKind.ONNX
    onnx = OnnxConfig(weights=None if named else Path(detector), most_features=keypoints, scales=MATCHING_SCALES)
    finder = make_detector(kind, onnx)
    files = [path for path in find_files(images) if path.suffix != ".npz"]  # an earlier output may be among them
    root = images.parent if os.path.isfile(images) else images
    output = output or new_folder(FEATURES)
    console, done, empty = notices(), 0, 0
    longest_side_px = 2048  # of larger images, which are shrunk
    outcomes = extract_all(files, root, output, finder, longest_side_px)
    with ProgressDisplay(console) as display:
        extracted_one = display.start("extracting", len(files))
        for _, found in outcomes:
            extracted_one()
            if isinstance(found, str):
                print_line(console, f"skipped: {found}")
                continue
            done, empty = done + 1, empty + (not found)
    if not done:
        raise FeatureError(f"{images}: no usable image there, {len(files)} files skipped; give JPEG, PNG, PPM or TIFF")
    without = f", {empty} of them without a keypoint" if empty else ""
    skipped = f", {len(files) - done} files skipped" if done < len(files) else ""
    typer.echo(f"{finder.version}: features of {done} images{without}{skipped}: {output}")


def certificates(
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the credentials. Existing ones are kept.")
    ] = Path("credentials"),
    host: Annotated[
        list[str] | None, typer.Option(help="Host name or IP address of the service. Can be repeated.")
    ] = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="Name of a robot, which gets a token and a certificate. Can be repeated.")
    ] = None,
    viewer: Annotated[
        list[str] | None, typer.Option(help="Name of a user who may read everything. Can be repeated.")
    ] = None,
    admin: Annotated[
        list[str] | None, typer.Option(help="Name of a user who may also manage missions. Can be repeated.")
    ] = None,
    cluster: Annotated[
        bool,
        typer.Option(
            "--cluster", help="Also make an authority and a certificate for a Dask cluster, see `fcslam map --workers`."
        ),
    ] = False,
) -> None:
    """Make a certificate authority, certificates of the service and of robots, and tokens for robots and users."""
    import datetime

    from fcslam.cloud.sessions import check_robot
    from fcslam.service.authentication import Role
    from fcslam.service.credentials import folder_of, make_cluster_credentials, make_credentials
    from fcslam.wire.checks import check_name

    wanted = {Role.ROBOT: robot or [], Role.VIEWER: viewer or [], Role.ADMIN: admin or []}
    names = [(name, role) for role, given in wanted.items() for name in given]
    for name, role in names:
        if [other for other, _ in names].count(name) > 1:
            raise InputError(f"'{name}' is named twice; every token needs another name")
        try:
            check_name(name, role)
            check_robot(name)
        except PacketError as error:
            raise InputError(str(error)) from error
    now = datetime.datetime.now(datetime.UTC)
    make_credentials(output, host or [], dict(names), now)
    if cluster:
        make_cluster_credentials(output, now)
    typer.echo(f"authority, for all clients: {output / 'ca.pem'}")
    typer.echo(f"for the service: {output / 'cloud.pem'}, {output / 'cloud.key'}, {output / 'tokens.yaml'}")
    for name, role in names:
        typer.echo(f"for {role} {name}: {folder_of(output, name, role)}")
    if cluster:
        stem = output / "cluster"
        typer.echo(f"for a cluster, robots excepted: {stem / 'ca.pem'}, {stem / 'member.pem'}, {stem / 'member.key'}")
