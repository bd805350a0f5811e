"""fcslam: several robots map one building together.

    import fcslam

    run = fcslam.map_recordings(["robot1.clf", "robot2.clf"], output="runs/building")
    run.trajectories["robot1"].T_map_base  # poses (x, y, theta) at every scan, shape (N, 3)
    run.maps[0].cells  # the occupancy grid, shape (H, W)

Everything in ``__all__`` is public. Modules load when a name is used for the first time.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any, Final

__version__ = "0.1.0"

_LAZY: Final = {
    imported.name: statement.module
    for statement in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(statement, ast.ImportFrom)
    for imported in statement.names
}
"""The module of each public name, by the file that type checkers read."""

__all__ = sorted([*_LAZY, "__version__"])  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'fcslam' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__
