"""`fcslam tools changes`: a run folder in, what changed in the building between two times out."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import Force, output_option
from fcslam.cli.output import CHANGES, new_folder

_WHEN = "a session, a date (2026-11-23: its end), a time of ISO 8601, or a stamp in seconds"


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
    from fcslam.mission.map_changes import PICTURE, TABLE, check_output, find_changes, save_changes

    output = output or new_folder(CHANGES)
    check_output(output, force)
    found = find_changes(run, since, until, map_index)
    save_changes(found, output, force)
    for kind in ("appeared", "disappeared"):
        regions = [region for region in found.regions if region.kind == kind]
        area_m2 = sum(region.area_m2 for region in regions)
        typer.echo(f"{kind}: {len(regions)} region{'s' * (len(regions) != 1)}, {area_m2:.2f} m2 of surface")
    typer.echo(f"picture: {output / PICTURE}")
    typer.echo(f"regions: {output / TABLE}")
