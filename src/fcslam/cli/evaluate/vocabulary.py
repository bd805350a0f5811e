"""`fcslam evaluate vocabulary`: how well vocabularies tell places apart as places arrive (figure 4 of the paper)."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.evaluate.arguments import EvaluationSeed, Features, Label, Sets, TrainOn
from fcslam.cli.options import Quiet, output_option
from fcslam.cli.output import EVALUATIONS, answers, new_folder, notices, print_line

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console
    from rich.table import Table

    from fcslam.lab.evaluation.places.vocabulary_growth import Growth


def vocabulary(
    sets: Sets,
    *,
    output: Annotated[Path | None, output_option("Folder for the figure and its table.", EVALUATIONS)] = None,
    features: Features = "orb",
    first: Annotated[
        list[Path] | None, typer.Option(help="Folder of images that arrive before the sets. Can be repeated.")
    ] = None,
    train_on: TrainOn = None,
    label: Label = None,
    groups: Annotated[
        int, typer.Option(min=1, help="Number of target places, each with a second view and 8 wrong places.")
    ] = 120,
    seed: EvaluationSeed = 1,
    quiet: Quiet = False,
) -> None:
    """Measure significance, mismatches and words of every vocabulary strategy while places arrive, 40 at a time."""
    import numpy as np

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.errors import EvaluationError
    from fcslam.lab.evaluation.places.features import choose_features, describe_sets, describe_training
    from fcslam.lab.evaluation.places.growth_figure import write_growth
    from fcslam.lab.evaluation.places.vocabulary_growth import (
        BATCH,
        Arrival,
        draw_groups,
        fixed_growths,
        grow_vocabulary,
    )
    from fcslam.places.vocabulary import Strategy, VocabularyConfig

    chosen = choose_features(features)
    output = output or new_folder(EVALUATIONS)
    with ProgressDisplay(notices(quiet)) as display:
        described_one = display.start("describing")
        earlier = describe_training(first or (), chosen, described_one)
        training = describe_training(train_on or (), chosen, described_one)
        described = describe_sets(sets, label or (), chosen, described_one)
        probes, arrivals = draw_groups(described, groups, np.random.default_rng(seed))
        arrivals = [Arrival(f"first {k}", codes) for k, codes in enumerate(earlier)] + arrivals
        if not probes or len(arrivals) < BATCH:
            raise EvaluationError(
                f"{len(arrivals)} places and {len(probes)} targets; give sets with {BATCH} places and a target at least"
            )
        growths = fixed_growths(arrivals, probes, training, seed)
        grown_one = display.start("growing", len(Strategy) * (len(arrivals) // BATCH))
        for strategy in Strategy:
            growths[strategy] = grow_vocabulary(strategy, arrivals, probes, VocabularyConfig(), seed, grown_one)
    names = ", ".join(each.place_set.name for each in described)
    write_growth(output, growths, f"{len(arrivals)} places, {len(probes)} groups; sets: {names}", seed)
    _show(answers(), growths, seed)
    print_line(answers(), f"{len(probes)} groups, {len(arrivals)} places; written: {output}")


def _show(console: "Console", growths: "Mapping[str, Growth]", seed: int) -> None:
    console.print(_table(growths, seed))
    print_line(console, "After the last batch; in brackets: 95 % intervals by bootstrap over groups.")


def _table(growths: "Mapping[str, Growth]", seed: int) -> "Table":
    import numpy as np
    from rich.table import Table

    from fcslam.lab.evaluation.places.vocabulary_growth import MEASURES

    table = Table("", *MEASURES, "words", "s for 40 places, median", title_justify="left")
    for name, growth in growths.items():
        cells = [
            f"{value.mean:.4g} [{value.low:.2g}, {value.high:.2g}]" for value in growth.intervals(-1, seed).values()
        ]
        rest = (growth.words[-1], float(np.median(growth.seconds)))
        table.add_row(name, *cells, *("" if np.isnan(value) else f"{value:.4g}" for value in rest))
    return table
