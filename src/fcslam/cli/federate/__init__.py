"""`fcslam tools federate`: robots train one detector together, and no image leaves its robot."""

import typer

from fcslam.cli.examples import examples
from fcslam.cli.federate.join import join
from fcslam.cli.federate.local import local
from fcslam.cli.federate.serve import serve

_LOCAL = "fcslam tools federate local robot1 robot2 robot3 --public photos -o fleet"
_SERVE = "fcslam tools federate serve lab:8000 --insecure --public photos -o fleet"
_JOIN = "fcslam tools federate join http://server.lab:8000 images --name robot1 -o home"

app = typer.Typer(no_args_is_help=True)


@app.callback(epilog=examples(_LOCAL, _SERVE, _JOIN))
def federate() -> None:
    """Train one detector on the images of many robots. No image leaves its robot."""


app.command(epilog=examples(_LOCAL, "fcslam tools federate local robot1 robot2 --quick"))(local)
app.command(epilog=examples(_SERVE))(serve)
app.command(epilog=examples(_JOIN))(join)
