"""`fcslam evaluate quality`: the certificate of a run."""

import json

from fcslam.cli.evaluate.arguments import RunFolder
from fcslam.cli.output import answers, print_line


def quality(run: RunFolder) -> None:
    """Print how good the maps of a run are, by its certificate, and what to drive again."""
    from fcslam.errors import EvaluationError
    from fcslam.runs import QUALITY, open_run

    content = open_run(run).quality.get(f"{QUALITY}.json")
    if content is None:
        raise EvaluationError(f"{run}: has no {QUALITY}.json; map the recordings again with this version")
    try:
        certificates = dict(json.loads(content))
    except (ValueError, TypeError) as error:
        raise EvaluationError(f"{run}: {QUALITY}.json is broken ({error})") from error
    console = answers()
    for k, one in certificates.items():
        limit = one["bar"]
        good = sum(cell["bound_95"] <= limit for cell in one["cells"])
        print_line(
            console, f"map {k}: {good} of {len(one['cells'])} m2 are good to {limit:g} m within {one['within']:g} m"
        )
        for stretch in one["open_stretches"]:
            print_line(
                console,
                f"map {k}: open: {stretch['robot']} for {stretch['length']:g} m from {stretch['from']} to "
                f"{stretch['to']}; the scans do not fix the motion along it",
            )
        for drive in one["drives"]:
            print_line(console, f"map {k}: {drive['text']}")
