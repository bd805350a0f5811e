"""`fcslam evaluate closures`: precision and recall of the closures of a run."""

from typing import TYPE_CHECKING

from fcslam.cli.evaluate.arguments import Reference, RunFolder
from fcslam.cli.evaluate.fleet import percent
from fcslam.cli.options import Csv
from fcslam.cli.output import answers, notices, print_line

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.lab.evaluation.fleet.closures import ClosureReport
    from fcslam.metrics.closures import Precision


def closures(
    run: RunFolder,
    reference: Reference,
    *,
    csv: Csv = None,
) -> None:
    """Measure precision and recall of a run's closures, by stage, against the optimised graph of the relations."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.fleet.closures import closure_metrics, evaluate_closures
    from fcslam.lab.evaluation.fleet.relations import write_metrics

    with ProgressDisplay(notices()) as display:
        display.start("evaluating")
        report = evaluate_closures(run, reference)
    _show_closures(report)
    if csv is not None:
        write_metrics(closure_metrics(report), csv)


def _show_closures(report: "ClosureReport") -> None:
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
    console = answers()
    console.print(counts)
    console.print(errors)
    _explain_closures(console, report)


def _explain_closures(console: "Console", report: "ClosureReport") -> None:
    """Print the reference and the definitions behind the tables."""
    from fcslam.lab.evaluation.fleet.closures import closure_metrics
    from fcslam.metrics.closures import BRIDGE_S, REACH_M, WITHIN_GAP_S, WRONG_DEG, WRONG_M
    from fcslam.metrics.relations import ACROSS_ROBOTS_GAP_S

    value = {metric.name: metric.value for metric in closure_metrics(report)}
    lines = [
        f"Reference: {value['relations']} relations optimised together; {value['relation_components']} components of "
        f"{value['relation_stamps']} stamps ({value['relation_stamps_in_run']} in the run), "
        f"{value['relation_stamps_in_largest_component']} in the largest.",
        f"Residuals of the relations: median {value['relation_residual_translation_median']:.3f} m, "
        f"{value['relation_residual_rotation_median']:.2f} deg; maximum "
        f"{value['relation_residual_translation_max']:.3f} m, {value['relation_residual_rotation_max']:.2f} deg.",
        f"Wrong: off by more than {WRONG_M:g} m or {WRONG_DEG:g} deg. Errors: median / maximum; up "
        f"to {BRIDGE_S:g} s to the relations' stamps are bridged by the run's own trajectory.",
        f"Revisits: relations over more than {WITHIN_GAP_S:g} s within a robot, {ACROSS_ROBOTS_GAP_S:g} s "
        f"between robots; found if a correct closure ends within {REACH_M:g} m of path at both sides.",
        "Chain: relations from one end to the other, median / maximum; a long one adds its own error.",
        "One relation: closures that a single relation covers.",
        "A robot reports only closures that it accepts, so candidates within robots are not known.",
    ]
    if value["relations_contradicted"]:
        left_out = f"{value['relations_contradicted']} of {value['relations']} left out by the robust solve"
        lines.insert(2, f"The relations contradict each other: {left_out}.")
    for line in lines:
        print_line(console, line)


def _error_cells(found: "Precision") -> tuple[str, str]:
    (middle_m, most_m), (middle_deg, most_deg) = found.translation_m, found.rotation_deg
    return f"{middle_m:.3f} / {most_m:.3f}", f"{middle_deg:.2f} / {most_deg:.2f}"
