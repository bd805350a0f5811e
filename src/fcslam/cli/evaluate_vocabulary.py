"""`fcslam evaluate vocabulary`: what the words of a vocabulary tell while places arrive, the paper's figure 4."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.place_options import Features, Label, Sets, TrainOn

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console
    from rich.table import Table

    from fcslam.evaluation.places.vocabulary_growth import Growth


def vocabulary(
    sets: Sets,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the picture and its table.")],
    features: Features = "orb",
    first: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of images that arrive before; may be given several times."),
    ] = None,
    train_on: TrainOn = None,
    label: Label = None,
    groups: Annotated[int, typer.Option(min=1, help="Targets, each with another view and 8 wrong places.")] = 120,
    seed: Annotated[int, typer.Option(min=0, help="Of groups, vocabularies and the bootstrap.")] = 1,
) -> None:
    """Significance, mismatches and words of every strategy as places arrive 40 at a time, set after set."""
    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from fcslam.errors import EvaluationError
    from fcslam.evaluation.places.features import choose_features, describe_sets, describe_training
    from fcslam.evaluation.places.growth_figure import write_growth
    from fcslam.evaluation.places.vocabulary_growth import BATCH, Arrival, draw_groups, fixed_growths, grow_vocabulary
    from fcslam.places.vocabulary import Strategy, VocabularyConfig

    chosen = choose_features(features)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("describing", total=None)
        earlier = describe_training(first or (), chosen, lambda: bar.advance(task))
        training = describe_training(train_on or (), chosen, lambda: bar.advance(task))
        described = describe_sets(sets, label or (), chosen, lambda: bar.advance(task))
        probes, arrivals = draw_groups(described, groups, np.random.default_rng(seed))
        arrivals = [Arrival(f"first {k}", codes) for k, codes in enumerate(earlier)] + arrivals
        if not probes or len(arrivals) < BATCH:
            raise EvaluationError(
                f"{len(arrivals)} places and {len(probes)} targets; give sets with {BATCH} places and a target at least"
            )
        growths = fixed_growths(arrivals, probes, training, seed)
        task = bar.add_task("growing", total=len(Strategy) * (len(arrivals) // BATCH))
        for strategy in Strategy:
            growths[strategy] = grow_vocabulary(
                strategy, arrivals, probes, VocabularyConfig(), seed, lambda: bar.advance(task)
            )
    names = ", ".join(each.place_set.name for each in described)
    write_growth(output, growths, f"{len(arrivals)} places, {len(probes)} groups; sets: {names}", seed)
    _show(Console(), growths, seed)
    typer.echo(f"{len(probes)} groups, {len(arrivals)} places; written: {output}")


def _show(console: "Console", growths: "Mapping[str, Growth]", seed: int) -> None:
    console.print(_table(growths, seed))
    line = "After the last batch; in brackets: 95 % intervals by bootstrap over groups."
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def _table(growths: "Mapping[str, Growth]", seed: int) -> "Table":
    import numpy as np
    from rich.table import Table

    from fcslam.evaluation.places.vocabulary_growth import MEASURES

    table = Table("", *MEASURES, "words", "s for 40 places, median", title_justify="left")
    for name, growth in growths.items():
        cells = [
            f"{value.mean:.4g} [{value.low:.2g}, {value.high:.2g}]" for value in growth.intervals(-1, seed).values()
        ]
        rest = (growth.words[-1], float(np.median(growth.seconds)))
        table.add_row(name, *cells, *("" if np.isnan(value) else f"{value:.4g}" for value in rest))
    return table
