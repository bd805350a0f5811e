"""Whether pictures can be rendered here."""

import pytest

from fcslam.errors import InputError
from fcslam.lab.simulation.engine import gl_context


def require_gl() -> None:
    """Skip the test, and say what to install, where there is no GL library."""
    try:
        gl_context(16, 16).free()
    except InputError as error:
        pytest.skip(str(error))
