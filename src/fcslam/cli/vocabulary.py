"""`fcslam tools vocabulary`: the words that robots and cloud share, and robots send in place of descriptors."""

from pathlib import Path
from typing import Annotated

import typer

from fcslam.errors import SourceError

MOST_WORDS = 4096
SEED = 0


def vocabulary(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Runs of `fcslam map` whose places the words are trained on."),
    ],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="File for the vocabulary.")],
    words: Annotated[int, typer.Option(min=2, max=65536, help="Most words of each channel.")] = MOST_WORDS,
) -> None:
    """Train the words that robots send in place of descriptors (robot.sends: words)."""
    import numpy as np

    from fcslam.mission.mission_file import read_mission
    from fcslam.places.words import short, train_words, write_vocabularies
    from fcslam.records import Channel, Place

    found: dict[Channel, dict[str, list[np.ndarray]]] = {}
    for run in runs:
        for sent in read_mission(run).in_order:
            if isinstance(place := sent.packet.body, Place) and len(place.descriptors):
                found.setdefault(place.channel, {}).setdefault(place.detector_version, []).append(place.descriptors)
    if not found:
        raise SourceError(f"{', '.join(map(str, runs))}: no place with descriptors; give runs of robots that send them")
    vocabularies = []
    for channel, by_version in sorted(found.items()):
        if len(by_version) > 1:
            raise SourceError(
                f"{channel} places of detectors {', '.join(sorted(by_version))}; words are of one detector, so give "
                "runs of one"
            )
        ((version, descriptors),) = by_version.items()
        trained = train_words(channel, version, np.concatenate(descriptors), words, SEED)
        vocabularies.append(trained)
        count, where = len(trained.centres), f"{len(descriptors)} places of {version}"
        typer.echo(f"{channel}: {count} words from {where}, version {short(trained.digest)}")
    write_vocabularies(vocabularies, output)
    typer.echo(str(output))
