"""Attacks on a fleet by a robot whose token is valid. None succeeds."""

import threading
import time
from dataclasses import replace

import httpx
import numpy as np
import pytest

from fcslam.errors import UnavailableError
from fcslam.learning.federated.coordinator import RULES
from tests.learning.federated.fakes import Fake, fleet_of, run, settings
from tests.learning.federated.live import LiveFleet

pytestmark = [pytest.mark.training, pytest.mark.attack]

HONEST = ("one", "two", "three", "four")
HOSTILE = "hostile"
RUN_S = 90.0
RNG = np.random.default_rng(4)
COMMON = RNG.normal(size=(80, 80))
"""The direction in which all robots' images pull."""
WEIGHTS = {
    "a.weight": RNG.normal(size=(80, 80)).astype(np.float32),
    "a.running_mean": RNG.normal(size=64).astype(np.float32),
    "a.running_var": RNG.uniform(0.5, 2.0, 64).astype(np.float32),
}


def honest_update(seed):
    """Trains in the common direction and in one of its own, and has seen other light than the others."""

    def answer(weights, round_number):
        rng = np.random.default_rng([seed, round_number])
        step = 0.02 * (0.4 * COMMON + 0.9 * rng.normal(size=COMMON.shape))
        return {
            "a.weight": (weights["a.weight"] + step).astype(np.float32),
            "a.running_mean": (weights["a.running_mean"] + rng.normal(0.0, 0.2, 64)).astype(np.float32),
            "a.running_var": (weights["a.running_var"] * np.exp(rng.normal(0.0, 0.2, 64))).astype(np.float32),
        }

    return answer


def honest_robots():
    return [Fake(robot, answer=honest_update(seed)) for seed, robot in enumerate(HONEST)]


def trained(folder, fleet):
    chosen = settings(rounds=3, minimum_robots=4, deadline_s=20.0)
    return run([], folder, chosen, fleet, WEIGHTS, RULES)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The weights of a run of the honest robots alone."""
    state, reports = trained(tmp_path_factory.mktemp("undisturbed"), fleet_of(honest_robots()))
    assert [report.robots for report in reports] == [tuple(sorted(HONEST))] * 3
    return state.weights


def flipped(update, sent, factor=-1.0):
    return update | {"a.weight": (sent["a.weight"] + factor * (update["a.weight"] - sent["a.weight"]))}, {"x": 1.0}


def with_first(array, value):
    changed = array.copy()
    changed[0] = value
    return changed


POISON = {
    "tripled variances": lambda update, _: (update | {"a.running_var": 3.0 * update["a.running_var"]}, {}),
    "variances of a third": lambda update, _: (update | {"a.running_var": update["a.running_var"] / 3.0}, {}),
    "shifted means": lambda update, _: (update | {"a.running_mean": update["a.running_mean"] + 3.0}, {}),
    "one variance of 1e9": lambda update, _: (update | {"a.running_var": with_first(update["a.running_var"], 1e9)}, {}),
    "flipped update": flipped,
    "long flipped update": lambda update, sent: flipped(update, sent, -10.0),
}


@pytest.mark.parametrize("poison", POISON)
def test_a_poisoned_update_changes_nothing(poison, undisturbed, tmp_path):
    class Hostile(Fake):
        def __call__(self, request):
            update, _ = super().__call__(request)
            return POISON[poison](update, request.weights)

    robots = [*honest_robots(), Hostile(HOSTILE, answer=honest_update(99))]
    state, reports = trained(tmp_path, fleet_of(robots))
    assert [report.robots for report in reports] == [tuple(sorted(HONEST))] * 3
    assert all(HOSTILE in report.left_out for report in reports)
    assert all(np.isfinite(list(report.losses.values())).all() for report in reports)
    for name, array in undisturbed.items():
        assert np.array_equal(state.weights[name], array), name


@pytest.mark.parametrize("length", [1.0, 3.0, 5.9])
def test_a_robot_of_three_moves_the_weights_by_its_share_however_long_its_updates_are(length, tmp_path):
    """It goes in a direction of its own, in which screening sees nothing odd: as far as the honest ones in theirs."""
    own = np.random.default_rng(5).normal(size=COMMON.shape)
    common, own = (each / np.linalg.norm(each) for each in (COMMON, own))

    def answer_of(seed):
        def answer(weights, round_number):
            noise = np.random.default_rng([seed, round_number]).normal(size=COMMON.shape)
            return {"a.weight": (weights["a.weight"] + 0.4 * common + 0.9 * noise / 80.0).astype(np.float32)}

        return answer

    def hostile(weights, _):
        return {"a.weight": (weights["a.weight"] + length * own).astype(np.float32)}

    start = {"a.weight": 10.0 * WEIGHTS["a.weight"]}
    robots = [Fake("one", answer=answer_of(1)), Fake("two", answer=answer_of(2)), Fake(HOSTILE, answer=hostile)]
    state, _ = run(robots, tmp_path, settings(rounds=20), start=start, rules=replace(RULES, momentum=0.0))
    moved = state.weights["a.weight"] - start["a.weight"]
    assert (moved * own).sum() < 1.2 * (moved * common).sum()


def test_a_robot_that_sends_noise_is_left_out(undisturbed, tmp_path):
    """Over HTTP, where the honest robots end as they do in one process."""
    ended, fleet = threading.Event(), LiveFleet()

    def send_noise():
        with fleet.link(HOSTILE) as link:
            while not ended.is_set():
                found = link.fetch()
                if found is not None:
                    assert link.reply(found[0] + 1, b"x") == "nobody waits for this reply"
                    link.reply(found[0], np.random.default_rng(1).bytes(50_000))

    with fleet.running():
        thread = threading.Thread(target=send_noise, daemon=True)
        thread.start()
        for robot in honest_robots():
            fleet.start(robot)
        end = time.monotonic() + RUN_S
        while len(fleet.grid.robots()) < len(HONEST) + 1:
            assert time.monotonic() < end
            time.sleep(0.05)
        state, reports = trained(tmp_path, fleet.grid)
        ended.set()
        thread.join()
    assert all(report.left_out[HOSTILE] for report in reports)
    assert all(np.array_equal(state.weights[name], array) for name, array in undisturbed.items())


def test_a_robot_cannot_hold_many_requests_open():
    """Four wait for work, the rest are refused at once."""
    refused, fleet = [], LiveFleet()

    def fetch():
        with fleet.link(HOSTILE) as link:
            try:
                link.fetch()
            except UnavailableError as error:
                refused.append(str(error))

    with fleet.running():
        threads = [threading.Thread(target=fetch) for _ in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(refused) == 8
    assert all("429" in reason for reason in refused)


def test_nothing_else_can_be_asked():
    """What Flower's servers and a web server may offer."""
    operations = ("control/start-run", "control/register-node", "runtime/acquire-task", "fleet/push-messages")
    paths = [f"/v1/{each}" for each in operations] + ["/", "/docs", "/openapi.json", "/health", "/v1/health"]
    fleet = LiveFleet()
    with fleet.running(), httpx.Client(base_url=fleet.address) as client:
        assert {client.request(method, path).status_code for path in paths for method in ("GET", "POST")} == {404}
