"""One small fleet for all tests that need one: simulated once, its packets made once."""

import gc
import re
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer.main
from hypothesis import settings

from fcslam.cloud import recognition
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.features import network_check
from fcslam.lab.simulation.recording import write_ground_truth
from fcslam.lab.simulation.simulated_fleet import SimulatedFleet
from fcslam.storage import database
from fcslam.wire.messages import Packet
from tests import small_fleet
from tests.carmen_logs import write_carmen
from tests.postgres import HAS_POSTGRES, WHY_NOT, Server
from tests.scripted import ScriptedMatcher

# How long an example takes says something of the machine, and of code that is compiled at its first call.
# More examples find little that these do not; `make fuzz` tries thousands of broken inputs.
settings.register_profile("fcslam", deadline=None, max_examples=30)
settings.load_profile("fcslam")


SLOW = frozenset({"drawn", "packets", "logs", "desk", "postgres_server"})
"""Fixtures that simulate and map a fleet, or start a server: what uses one of them is slow."""


SECURITY = Path(__file__).parents[1] / "docs" / "develop" / "security.md"
THREATS = frozenset(re.findall(r"`(test_\w+)`", SECURITY.read_text(encoding="utf-8")))
"""The tests that the page on security names: they play an attacker."""


def pytest_report_header():
    return [] if find_spec("torch") else "without torch (fcslam[train]), no training is tested"


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collecting tests leaves no garbage, and they stay to the end: nobody looks through them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items):
    for item in items:
        if item.originalname in THREATS:
            item.add_marker(pytest.mark.attack)
        if SLOW & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    # Tests that wait for servers come first: at the end, the others are short enough to be shared by all workers.
    items.sort(key=lambda item: item.get_closest_marker("system") is None)


@pytest.fixture(scope="session", autouse=True)
def no_wait_for_the_disk():
    """No test cuts the power, so none waits until the disk has what was written."""

    def connected(*arguments, connect=database._connected, **options):
        connection = connect(*arguments, **options)
        connection.execute("PRAGMA synchronous=OFF")
        return connection

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "_connected", connected)
        patch.setattr("os.fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def networks_tried_once():
    """A network that ran in a process with limits does so again, so it is not tried once more."""
    passed = set()

    def try_once(path, run=network_check._try):
        if (content := path.read_bytes()) not in passed:
            run(path)
            passed.add(content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network_check, "_try", try_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def commands_built_once():
    """typer makes all commands and options anew for each command; they are always the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.main.get_command", cache(typer.main.get_command))
        yield


@pytest.fixture(scope="session")
def postgres_server(tmp_path_factory):
    """A PostgreSQL server, in a folder that its user may enter."""
    if not HAS_POSTGRES:
        pytest.skip(WHY_NOT)
    with tempfile.TemporaryDirectory(prefix="fcslam-postgres-") as folder:
        server = Server(Path(folder))
        yield server
        server.stop()


@pytest.fixture
def postgres(postgres_server):
    """A connection to a PostgreSQL server with the tables of this version and, perhaps, missions of other tests."""
    from fcslam.service.shared.mission_tables import prepare
    from fcslam.storage.postgres import Postgres, take_password

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PGPASSWORD", "")
        server = Postgres(take_password(postgres_server.url), "tests")
        prepare(server)
        yield server
        server.close()


@pytest.fixture(scope="session")
def drawn() -> SimulatedFleet:
    """Three robots, 8 m each, that meet."""
    return small_fleet.draw(3, 8.0)


@pytest.fixture(scope="session")
def packets(drawn) -> list[Packet]:
    """Packets of the three robots, in canonical order."""
    return small_fleet.in_order(packet for robot in drawn.robots for packet in small_fleet.sent_by(robot))


@pytest.fixture(scope="session")
def logs(drawn, tmp_path_factory):
    """The three recordings as CARMEN logs, with the truth beside them."""
    folder = tmp_path_factory.mktemp("recordings")
    for robot in drawn.robots:
        write_carmen(folder / f"{robot.name}.clf", robot.scans())
    write_ground_truth(drawn, folder)
    return [folder / f"{robot.name}.clf" for robot in drawn.robots]


@pytest.fixture(scope="module")
def brief_validation():
    """Few and small views to validate networks on: validation takes most of a short training."""
    if find_spec("torch") is None:  # nothing is trained
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fcslam.learning.validation.VALIDATION_VIEW", (96, 96))
        yield


@pytest.fixture
def scripted(monkeypatch):
    """Makes a cloud whose place matcher finds what the given scripts say."""
    monkeypatch.setattr(recognition, "PlaceMatcher", ScriptedMatcher)

    def make(*scripts, **settings) -> Cloud:
        monkeypatch.setattr(ScriptedMatcher, "script", [line for script in scripts for line in script])
        monkeypatch.setattr(ScriptedMatcher, "predictions", {})
        return Cloud(FleetConfig(**settings), seed=0)

    return make
