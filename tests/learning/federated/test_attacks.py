"""Attacks on a fleet: a stranger who reaches the port, and a robot whose token is valid. None succeeds.

All servers listen on loopback.
"""

import ssl
import threading
import time

import httpx
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")

from fcslam.errors import InputError
from fcslam.learning.federated.client import ClientUpdate
from fcslam.learning.federated.settings import FederatedSettings
from tests.learning.federated.fakes import Fake
from tests.learning.federated.live import LiveFleet, honest_update

pytestmark = [pytest.mark.training, pytest.mark.attack]

HONEST = ("one", "two", "three", "four")
HOSTILE = "hostile"
RUN_S = 90.0


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    return LiveFleet(tmp_path_factory.mktemp("fleet"), (*HONEST, HOSTILE))


def chosen_settings():
    return FederatedSettings.model_validate({"rounds": 3, "local_steps": 1, "minimum_robots": 4, "deadline_s": 20.0})


@pytest.fixture(scope="module")
def undisturbed(fleet, tmp_path_factory):
    """The weights of a run of the honest robots alone."""
    with fleet.server() as grid:
        start_honest(fleet)
        state, reports = fleet.run(grid, tmp_path_factory.mktemp("undisturbed"), chosen_settings())
    assert [report.robots for report in reports] == [tuple(sorted(HONEST))] * 3
    return state.weights


def start_honest(fleet):
    for seed, robot in enumerate(HONEST):
        fleet.start(Fake(robot, answer=honest_update(seed)))


# ---- a robot with a valid token ----


class HostileClient:
    """Falsifies what an honest robot would send."""

    name = HOSTILE

    def __init__(self, falsify):
        self._honest, self._falsify = honest_update(99), falsify

    def train(self, request):
        update, losses = self._falsify(self._honest(request.weights, request.round_number), request.weights)
        return ClientUpdate(update, losses)

    def evaluate(self, *_):
        return {"repeatability": 1.0, "mma_3px": 1.0}


def flipped(update, sent, factor=-1.0):
    return update | {"a.weight": (sent["a.weight"] + factor * (update["a.weight"] - sent["a.weight"]))}, {"x": 1.0}


POISON = {
    "NaN losses": lambda update, _: (update, {"detector": float("nan")}),
    "infinite losses": lambda update, _: (update, {"detector": float("inf")}),
    "losses beyond all measure": lambda update, _: (update, {"detector": 1e300}),
    "NaN weights": lambda update, _: (update | {"a.weight": update["a.weight"] * np.nan}, {}),
    "tripled variances": lambda update, _: (update | {"a.running_var": 3.0 * update["a.running_var"]}, {}),
    "variances of a third": lambda update, _: (update | {"a.running_var": update["a.running_var"] / 3.0}, {}),
    "shifted means": lambda update, _: (update | {"a.running_mean": update["a.running_mean"] + 3.0}, {}),
    "one variance of 1e9": lambda update, _: (update | {"a.running_var": with_first(update["a.running_var"], 1e9)}, {}),
    "flipped update": flipped,
    "long flipped update": lambda update, sent: flipped(update, sent, -10.0),
    "wrong shape": lambda update, _: (update | {"a.weight": update["a.weight"][:5]}, {}),
    "another array": lambda update, _: (update | {"b.weight": update["a.weight"][:5]}, {}),
    "huge array": lambda update, _: (update | {"a.weight": np.zeros((3000, 3000), np.float32)}, {}),
}


def with_first(array, value):
    changed = array.copy()
    changed[0] = value
    return changed


@pytest.mark.parametrize("poison", POISON)
def test_a_poisoned_update_changes_nothing(poison, fleet, undisturbed, tmp_path):
    with fleet.server() as grid:
        fleet.start(HostileClient(POISON[poison]))
        start_honest(fleet)
        wait_for_all(grid)
        state, reports = fleet.run(grid, tmp_path, chosen_settings())
    assert [report.robots for report in reports] == [tuple(sorted(HONEST))] * 3
    assert all(HOSTILE in report.left_out for report in reports)
    assert all(np.isfinite(list(report.losses.values())).all() for report in reports)
    for name, array in undisturbed.items():
        assert np.array_equal(state.weights[name], array), name


def wait_for_all(grid):
    wait_until(lambda: len(grid.robots()) == len(HONEST) + 1)


def wait_until(happened):
    end = time.monotonic() + RUN_S
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_robot_that_sends_noise_is_left_out(fleet, undisturbed, tmp_path):
    ended = threading.Event()

    def send_noise():
        with fleet.link(HOSTILE) as link:
            while not ended.is_set():
                found = link.fetch()
                if found is not None:
                    assert link.reply(found[0] + 1, b"x") is not None  # the request of another robot
                    link.reply(found[0], np.random.default_rng(1).bytes(50_000))

    with fleet.server() as grid:
        thread = threading.Thread(target=send_noise)
        thread.start()
        start_honest(fleet)
        wait_for_all(grid)
        state, reports = fleet.run(grid, tmp_path, chosen_settings())
        ended.set()
        thread.join()
    assert all(report.left_out[HOSTILE] for report in reports)
    assert all(np.array_equal(state.weights[name], array) for name, array in undisturbed.items())


def test_a_robot_cannot_answer_in_the_name_of_another(fleet):
    with fleet.server(), fleet.link("one", owner=HOSTILE) as link, pytest.raises(InputError, match="no token of"):
        link.fetch()


@pytest.mark.parametrize(
    "operation", ["control/start-run", "control/register-node", "runtime/acquire-task", "fleet/push-messages"]
)
def test_a_robot_cannot_start_a_run_or_send_to_robots(operation, fleet):
    """Its token opens the operations of a robot and nothing else."""
    path = f"/v1/{operation}"
    with fleet.server():
        headers = {"Authorization": f"Bearer {fleet.token(HOSTILE)}"}
        trusted = ssl.create_default_context(cafile=fleet.ca)
        answer = httpx.post(f"https://{fleet.address}{path}", headers=headers, verify=trusted)
    assert answer.status_code == 404
    assert any(line.startswith(f"refused: POST {path} from 127.0.0.1: nobody starts a run") for line in fleet.notices)


def test_a_robot_cannot_hold_many_requests_open(fleet):
    """Four wait for work, the rest are refused at once."""
    refused = []

    def fetch():
        with fleet.link(HOSTILE) as link:
            try:
                link.fetch()
            except ConnectionError as error:
                refused.append(str(error))

    with fleet.server():
        threads = [threading.Thread(target=fetch) for _ in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert refused == ["the server answers with status 429"] * 8


# ---- a stranger who has nothing but the certificate of the authority ----


def test_a_stranger_finds_no_operation(fleet):
    """What Flower's servers and a web server may offer; nothing is answered without a token."""
    operations = ("control/start-run", "control/register-node", "runtime/acquire-task", "fleet/push-messages")
    paths = [f"/v1/{each}" for each in operations] + ["/", "/docs", "/openapi.json", "/health", "/v1/health"]
    with (
        fleet.server(),
        httpx.Client(base_url=f"https://{fleet.address}", verify=ssl.create_default_context(cafile=fleet.ca)) as client,
    ):
        unknown = {client.request(method, path).status_code for path in paths for method in ("GET", "POST")}
        operations = [f"/api/v1/robots/one/learning/{name}" for name in ("next", "alive", "reply/1")]
        unsigned = {client.post(path).status_code for path in operations}
        client.headers["Authorization"] = "Bearer guessed"
        named = {client.post(path, content=b"x").status_code for path in operations}
    assert (unknown, unsigned, named) == ({404}, {401}, {401})
