"""`fcslam demo`: a small fleet drawn on the spot and mapped by the real command."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the recordings and the run.")] = Path(
        "demo"
    ),
    robots: Annotated[int, typer.Option(min=1, max=8, help="How many robots drive.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws another building.")] = 1,
) -> None:
    """Draw a building, drive robots with drifting odometry through it, map their logs, compare with the truth."""
    import numpy as np
    from rich.console import Console

    from fcslam.cli.evaluate import relations
    from fcslam.cli.map import map_sources
    from fcslam.errors import OutputError
    from fcslam.mission import MissionConfig
    from fcslam.runs import prepare_output
    from fcslam.simulation.drawn_fleet import FleetSettings, draw_fleet, write_fleet
    from fcslam.sources import open_source

    console = Console()
    recordings, run = output / "recordings", output / "run"
    prepare_output(run, force=True)
    try:
        recordings.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be used as the output folder ({error})") from error
    rng = np.random.default_rng(seed)
    logs = write_fleet(draw_fleet(FleetSettings(robots=robots), rng), recordings, rng)
    console.print(f"recordings: {', '.join(str(log) for log in logs)}", highlight=False, markup=False, soft_wrap=True)
    map_sources([open_source(log) for log in logs], MissionConfig(seed=seed), run, force=True)
    relations(run, recordings / "ground_truth" / "relations", across_robots=len(logs) > 1)
