"""`fcslam evaluate`: measure runs, detectors and place recognition against references."""

import typer

from fcslam.cli.evaluate.fleet import fleet
from fcslam.cli.evaluate.homography import homography
from fcslam.cli.evaluate.places import places
from fcslam.cli.evaluate.quality import quality
from fcslam.cli.evaluate.relations import relations
from fcslam.cli.examples import examples

_FLEET = "fcslam evaluate fleet fleet/run --truth fleet"
_RELATIONS = "fcslam evaluate relations runs/intel intel.relations.gz"

app = typer.Typer(no_args_is_help=True)


@app.callback(epilog=examples(_FLEET, _RELATIONS))
def evaluate() -> None:
    """Measure runs, detectors and place recognition against references."""


app.command(epilog=examples(_FLEET, "fcslam evaluate fleet demo/run --csv fleet.csv --figure fleet.png"))(fleet)
app.command(epilog=examples(_RELATIONS, "fcslam evaluate relations runs/intel-3 intel.relations.gz --across-robots"))(
    relations
)
app.command(epilog=examples("fcslam evaluate quality fleet/run"))(quality)
app.command(
    epilog=examples(
        "fcslam evaluate homography hpatches --detector onnx --detector orb",
        "fcslam evaluate homography hpatches --detector features --csv pairs.csv",
    )
)(homography)
app.command(
    epilog=examples(
        "fcslam evaluate places corridor tower",
        "fcslam evaluate places corridor --features onnx --train-on photos --verify",
    )
)(places)
