"""The routes of learning in a service."""

import asyncio
from types import SimpleNamespace

import httpx
import pytest
from fastapi import FastAPI

from fcslam.learning.federated.relay import learning_router
from tests.service.http.desk import Desk


@pytest.fixture
def asked(tmp_path):
    """The status of a request of anna, while no process learns."""
    state = SimpleNamespace(require=lambda *_: [], rate=SimpleNamespace(check=lambda _: None))
    app = FastAPI()
    app.include_router(learning_router(state, tmp_path / "nobody"))

    async def ask(operation):
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
            return (await client.post(f"/api/v1/robots/anna/learning/{operation}")).status_code

    return lambda operation: asyncio.run(ask(operation))


def test_while_no_process_learns_a_robot_is_to_try_again(asked):
    assert {asked(operation) for operation in ("next", "reply/7")} == {503}


@pytest.mark.attack
@pytest.mark.parametrize(
    "operation", ["..%2F..%2Fben%2Flearning%2Fnext", "next%2F..", "reply/7/..", "reply/" + "1" * 19]
)
def test_the_path_of_a_robot_leads_to_no_other(asked, operation):
    """The service has checked the token of anna; the process behind it believes the path."""
    assert asked(operation) in (404, 422)


@pytest.mark.attack
def test_a_robot_learns_in_its_own_name_only(tmp_path):
    with Desk(tmp_path) as desk:
        desk.app.include_router(learning_router(desk.state, tmp_path / "nobody"))
        paths = [f"/api/v1/robots/a/learning/{operation}" for operation in ("next", "reply/7")]
        for who, status in ((None, 401), ("b", 403), ("eye", 403), ("a", 503)):
            assert {desk.ask("POST", path, who).status_code for path in paths} == {status}
