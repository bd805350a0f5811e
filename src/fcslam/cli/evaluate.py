"""`fcslam evaluate`: run folders against references."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.evaluate_federated import federated
from fcslam.cli.evaluate_fleet import fleet, percent
from fcslam.cli.evaluate_homography import homography
from fcslam.cli.evaluate_places import places
from fcslam.cli.evaluate_vocabulary import vocabulary

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.evaluation.fleet.closures import ClosureReport
    from fcslam.metrics.closures import ClosureCriteria, Precision
    from fcslam.metrics.relations import RelationErrors

app = typer.Typer(no_args_is_help=True, help="Measure run folders against references, and detectors.")
app.command(epilog="Example: fcslam evaluate fleet fleet/run --truth fleet")(fleet)
app.command(epilog="Example: fcslam evaluate federated robot1 robot2 robot3 --output study")(federated)
app.command(epilog="Example: fcslam evaluate homography hpatches --detector onnx --detector orb --figures figures")(
    homography
)
app.command(
    epilog="Example: fcslam evaluate places corridor tower --features onnx --train-on photos --verify -o places"
)(places)
app.command(epilog="Example: fcslam evaluate vocabulary tower corridor --first photos --output growth")(vocabulary)


@app.command(epilog="Example: fcslam evaluate relations out/intel intel.relations.gz --across-robots")
def relations(
    run: Annotated[Path, typer.Argument(help="The run folder to measure.")],
    reference: Annotated[Path, typer.Argument(metavar="RELATIONS", help="Relations file; .gz and .xz are read too.")],
    *,
    across_robots: Annotated[
        bool, typer.Option("--across-robots", help="Only relations between stamps of different robots.")
    ] = False,
    gap_s: Annotated[
        float | None,
        typer.Option(min=0.0, help="Only relations that span more seconds; 20 across robots, else everything."),
    ] = None,
    parts: Annotated[
        Path | None,
        typer.Option(
            help="Run folder that says which stamps belong to which robot, if not RUN: measures one robot's "
            "run by the relations of a run of several."
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="Write the numbers to this file as well (as JSON if it ends in .json).")
    ] = None,
) -> None:
    """Errors of a run by the relations metric of Kuemmerle et al. 2009: mean, standard deviation and maximum."""
    from fcslam.evaluation.fleet.relations import (
        RelationsQuestion,
        evaluate_relations,
        relation_metrics,
        write_metrics,
    )

    errors = evaluate_relations(run, reference, RelationsQuestion(across_robots, gap_s, parts))
    _show_relations(errors, "relations across robots" if across_robots else "relations")
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


def _show_relations(errors: "RelationErrors", what: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("error", "mean", "std", "max", caption=f"{errors.used} of {errors.total} {what} used")
    for name, spread, digits in (("translation, m", errors.translation, 4), ("rotation, deg", errors.rotation, 3)):
        table.add_row(name, *(f"{value:.{digits}f}" for value in (spread.mean, spread.std, spread.maximum)))
    Console().print(table)


@app.command(epilog="Example: fcslam evaluate closures out/intel intel.relations.gz")
def closures(
    run: Annotated[Path, typer.Argument(help="The run folder to measure.")],
    reference: Annotated[Path, typer.Argument(metavar="RELATIONS", help="Relations file; .gz and .xz are read too.")],
    *,
    wrong_m: Annotated[float, typer.Option(min=0.0, help="A closure that is off by more is wrong.")] = 0.5,
    wrong_deg: Annotated[float, typer.Option(min=0.0, help="Or turned by more.")] = 10.0,
    bridge_s: Annotated[
        float, typer.Option(min=0.0, help="A closure's stamps and the relations' may lie this far apart.")
    ] = 1.0,
    reach_m: Annotated[
        float, typer.Option(min=0.0, help="A closure finds a revisit this near along the path at both ends.")
    ] = 2.0,
    csv: Annotated[
        Path | None, typer.Option(help="Write the numbers to this file as well (as JSON if it ends in .json).")
    ] = None,
) -> None:
    """Precision and recall of a run's closures, stage by stage, against the optimised graph of the relations."""
    from fcslam.evaluation.fleet.closures import closure_metrics, evaluate_closures
    from fcslam.evaluation.fleet.relations import write_metrics
    from fcslam.metrics.closures import ClosureCriteria

    criteria = ClosureCriteria(bridge_s, wrong_m, wrong_deg, reach_m)
    report = evaluate_closures(run, reference, criteria)
    _show_closures(report, criteria)
    if csv is not None:
        write_metrics(closure_metrics(report), csv)


def _show_closures(report: "ClosureReport", criteria: "ClosureCriteria") -> None:
    from rich.console import Console
    from rich.table import Table

    counts = Table("closures", "all", "covered", "wrong", "precision", "revisits found")
    errors = Table("closures", "error, m", "error, deg", "chain", "one relation")
    names = {"intra_robot": "within", "inter_robot": "between"}
    for (within, status), score in report.scores.items():
        name, graph, single, recall = f"{names[within]}, {status}", score.graph, score.single, score.recall
        covered = f"{graph.covered}, {percent(graph.coverage)}"
        found = "" if recall is None else f"{recall.found}/{recall.revisits}, {percent(recall.recall)}"
        counts.add_row(name, str(graph.closures), covered, str(graph.wrong), percent(graph.precision), found)
        if graph.covered:
            chain = f"{score.chain[0]:.0f} / {score.chain[1]:.0f}"
            errors.add_row(name, *_error_cells(graph), chain, f"{single.covered}, {single.wrong} wrong")
    console = Console()
    console.print(counts)
    console.print(errors)
    _explain_closures(console, report, criteria)


def _explain_closures(console: "Console", report: "ClosureReport", criteria: "ClosureCriteria") -> None:
    """What the tables rest on."""
    from fcslam.evaluation.fleet.closures import closure_metrics
    from fcslam.metrics.relations import ACROSS_ROBOTS_GAP_S

    value = {metric.name: metric.value for metric in closure_metrics(report)}
    lines = [
        f"Reference: {value['relations']} relations optimised together; {value['relation_components']} components of "
        f"{value['relation_stamps']} stamps ({value['relation_stamps_in_run']} in the run), "
        f"{value['relation_stamps_in_largest_component']} in the largest.",
        f"Residuals of the relations: median {value['relation_residual_translation_median']:.3f} m, "
        f"{value['relation_residual_rotation_median']:.2f} deg; maximum "
        f"{value['relation_residual_translation_max']:.3f} m, {value['relation_residual_rotation_max']:.2f} deg.",
        f"Wrong: off by more than {criteria.wrong_m:g} m or {criteria.wrong_deg:g} deg. Errors: median / maximum; up "
        f"to {criteria.bridge_s:g} s to the relations' stamps are bridged by the run's own trajectory.",
        f"Revisits: relations over more than {criteria.within_gap_s:g} s within a robot, {ACROSS_ROBOTS_GAP_S:g} s "
        f"between robots; found if a correct closure ends within {criteria.reach_m:g} m of path at both sides.",
        "Chain: relations from one end to the other, median / maximum; a long one adds its own error.",
        "One relation: closures that a single relation covers.",
        "A robot reports only closures that it accepts, so candidates within robots are not known.",
    ]
    if value["relations_contradicted"]:
        left_out = f"{value['relations_contradicted']} of {value['relations']} left out by the robust solve"
        lines.insert(2, f"The relations contradict each other: {left_out}.")
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)


def _error_cells(found: "Precision") -> tuple[str, str]:
    (middle_m, most_m), (middle_deg, most_deg) = found.translation_m, found.rotation_deg
    return f"{middle_m:.3f} / {most_m:.3f}", f"{middle_deg:.2f} / {most_deg:.2f}"
