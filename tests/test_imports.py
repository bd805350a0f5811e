"""Rooms import only rooms above them in the table of the architecture, and `import fcslam` is light."""

import ast
import itertools
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from tests.sources.carmen_text import drive
from tests.test_supply_chain import normal

PACKAGE = Path(__file__).parents[1] / "src" / "fcslam"

# From the ground up. A room may import itself and every room that stands before it.
ROOMS = [
    "errors",
    "untrusted",
    "compiled",
    "processes",
    "records",
    "config",
    "geometry",
    "metrics",
    "storage",
    "maps.occupancy_map",
    "maps.ros_map",
    "graph.evidence",
    "runs",
    "sources",
    "graph",
    "lidar",
    "lidar3d",
    "cluster",
    "features",
    "maps",
    "places",
    "wire",
    "robot",
    "cloud",
    "anchoring",
    "mission",
    "warmup",
    "api",
    "service",
    "live",
    "page",
    "ros",
    "learning",
    "learning.federated",
    "lab",
    "lab.presets",
    "lab.simulation",
    "lab.evaluation",
    "cli",
]

# Rooms that may see less than what stands before them: the last room that each may import.
CEILINGS = {"learning": "features", "lab.simulation": "sources"}


def room_of(module: str) -> str:
    """Room of a dotted module name; empty for the package itself."""
    parts = module.split(".")[1:]
    return ".".join(parts[:2]) if ".".join(parts[:2]) in ROOMS else parts[0] if parts else ""


def allowed(room: str) -> set[str]:
    """Rooms that ``room`` may import, the package's own __init__ (its version) included."""
    ceiling = ROOMS.index(CEILINGS[room]) + 1 if room in CEILINGS else ROOMS.index(room)
    return {"", room, *ROOMS[:ceiling]}


@pytest.fixture(scope="module")
def statements() -> dict[Path, list[ast.stmt]]:
    """The imports and classes of every module, also those inside functions, by its path in the package."""
    kinds = ast.Import | ast.ImportFrom | ast.ClassDef
    return {
        path.relative_to(PACKAGE): [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, kinds)]
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def imported_modules(nodes: list[ast.stmt], package: list[str]) -> Iterator[str]:
    """Every fcslam module that a module of ``package`` imports."""
    for node in nodes:
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            # `from fcslam import runs` names a room, `from fcslam.runs import Run` does not: both begin with the room.
            names = [f"{origin}.{alias.name}" for alias in node.names] if origin == "fcslam" else [origin]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "fcslam" and not name.endswith(".__version__"))


def violations(nodes: list[ast.stmt], path: Path) -> list[str]:
    parts = ["fcslam", *path.with_suffix("").parts]
    package = parts[:-1]
    room = room_of(".".join(package if path.name == "__init__.py" else parts))
    seen = {room_of(module) for module in imported_modules(nodes, package)}
    may = allowed(room) if room else {""}  # public names are imported late
    return [f"{path}: {room or 'fcslam'} imports {other}" for other in sorted(seen - may)]


def test_every_room_is_known():
    rooms = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert rooms - {"__init__"} <= set(ROOMS)


def test_rooms_import_only_rooms_above(statements):
    assert [found for path, nodes in statements.items() for found in violations(nodes, path)] == []


def test_packages_that_are_imported_are_declared(statements):
    project = tomllib.loads((PACKAGE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = itertools.chain.from_iterable(project["optional-dependencies"].values())
    declared = {normal(re.split(r"[^\w.-]", each)[0]) for each in (*project["dependencies"], *extras)}
    of_module = packages_distributions()
    for path, nodes in statements.items():
        for node in nodes:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and not node.level else []
            for name in {name.split(".")[0] for name in names} - {"fcslam", *sys.stdlib_module_names}:
                assert declared & set(map(normal, of_module.get(name, [name]))), f"{path} imports {name}"


def test_no_module_imports_itself_through_others(statements):
    modules = {
        ".".join(["fcslam", *path.with_suffix("").parts]).removesuffix(".__init__"): nodes
        for path, nodes in statements.items()
    }
    graph: dict[str, set[str]] = {}
    for name, nodes in modules.items():
        found = set()
        for node in nodes:
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= inner & modules.keys() or {node.module}
        graph[name] = found & modules.keys() - {name}
    assert len(graph["fcslam.mission.mission"]) > 5
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


def test_a_class_name_has_one_meaning(statements):
    classes = [node.name for nodes in statements.values() for node in nodes if isinstance(node, ast.ClassDef)]
    assert [name for name, count in Counter(classes).items() if count > 1 and not name.startswith("_")] == []


def test_one_module_starts_processes(statements):
    starts = {"multiprocessing", "multiprocessing.process", "subprocess", "ProcessPoolExecutor", "fork", "Popen"}
    found = {
        path.as_posix()
        for path, nodes in statements.items()
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
        and {getattr(node, "module", None), *(alias.name for alias in node.names)} & starts
    }
    assert found == {"processes.py"}


def printed(program: list[str], folder: Path) -> str:
    """What the lines of a program print in a fresh interpreter."""
    command = [sys.executable, "-c", "\n".join(program)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_a_log_is_mapped_without_bags_plans_servers_and_plots(tmp_path):
    (tmp_path / "r.log").write_text("\n".join(drive(30, beams=180)))
    program = [
        "import sys, fcslam.cli",
        "fcslam.cli.main(['map', 'r.log', '-o', 'run', '-q'])",
        "print(*sys.modules)",
    ]
    loaded = set(printed(program, tmp_path).split())
    assert {"fcslam.sources.logs.carmen", "fcslam.maps.drawing"} <= loaded
    others = ["asyncio", "httpx", "fastapi", "matplotlib", "pandas", "onnxruntime", "psycopg", "rosbags"]
    unused = ["sources.bags.rosbag", "anchoring.plan", "anchoring.gnss", "wire.http_transport", "live.robot", "page"]
    assert not loaded & {*others, "scipy.sparse", *(f"fcslam.{module}" for module in unused)}


@pytest.mark.slow
def test_a_live_robot_does_not_load_scipy(tmp_path):
    """It takes 46 MB, and as long to load as a thousand scans to map. numba asks for its version alone."""
    program = [
        "import sys, fcslam.mission.mission, fcslam.live.robot",
        "from fcslam.robot.frontend import RobotConfig",
        "fcslam.live.robot.warm_up_tracking(RobotConfig())",
        "print(*(name for name in sys.modules if name.startswith('scipy.') and not name.startswith('scipy._')))",
    ]
    assert printed(program, tmp_path).split() == ["scipy.version"]


@pytest.mark.slow
def test_code_of_users_finds_the_blas_of_scipy(tmp_path):
    program = [
        "import numba, numpy as np",
        "from fcslam.lidar.field import SurfelField",
        "SurfelField(np.zeros(3)).nearest(np.zeros((1, 2)))",
        "product = numba.njit(lambda a: np.dot(a, a))(2.0 * np.eye(2))",
        "print(product.tolist())",
    ]
    assert printed(program, tmp_path) == "[[4.0, 0.0], [0.0, 4.0]]\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statement", "others"),
    [("import fcslam", set()), ("import fcslam.cli", {"click", "shellingham", "typer", "typing_extensions"})],
)
def test_import_is_light_and_writes_nothing(statement, others, tmp_path):
    program = [
        f"import sys; sys.path.insert(0, {str(PACKAGE.parent)!r}); before = set(sys.modules)",
        statement,
        "print(*{name.partition('.')[0] for name in set(sys.modules) - before} - sys.stdlib_module_names)",
    ]
    environment = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-I", "-B", "-c", "\n".join(program)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert set(done.stdout.split()) <= {"fcslam", *others}
    assert list(tmp_path.iterdir()) == []
