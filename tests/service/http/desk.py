"""A service on a port of this machine, its worker in the same process, and who talks to it."""

import hashlib
import socket
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import httpx
import uvicorn

from fcslam.cloud.settings import CloudConfig
from fcslam.mission.mission_store import MissionStore
from fcslam.records import Channel
from fcslam.service.audit_log import audit_file
from fcslam.service.authentication import Authenticator, Role, TokenEntry
from fcslam.service.http.app import create_app
from fcslam.service.http.state import EventStream, ServiceState
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.missions import Missions
from fcslam.service.supervisor import PROGRESS
from fcslam.service.worker import Worker
from fcslam.wire.batches import MEDIA_TYPE, read_batch, write_batch
from fcslam.wire.packets import decode, encode
from tests.scripted import closures, rectangle, stream
from tests.service.inline import InlineTask

POSES = rectangle(29)
SCRIPT = closures(("a", POSES), ("b", POSES), [(0, 0), (8, 8), (16, 16), (24, 24)])
A, B = ([encode(packet) for packet in stream(robot, POSES, start_s)] for robot, start_s in (("a", 0.0), ("b", 500.0)))

CLOUD = CloudConfig()
TOKENS = {"a": Role.ROBOT, "b": Role.ROBOT, "eye": Role.VIEWER, "boss": Role.ADMIN}
ENTRIES = [
    TokenEntry(name=name, role=role, sha256=hashlib.sha256(f"token of {name}".encode()).hexdigest())
    for name, role in TOKENS.items()
]


def put_detector(desk, content):
    path = desk.state.missions.detectors.path(Channel.CAMERA, "v1")
    path.parent.mkdir(parents=True)
    path.write_bytes(content)


class InlineWorker:
    """Works whenever it is notified of work."""

    pid: int | None = 1
    starts = 1
    is_ready = True

    def __init__(self, folder: MissionFolder) -> None:
        self._now = 0.0
        self._store = MissionStore(folder.store)
        self.applied = 0
        self._working, self.notified_by = threading.Lock(), set[int]()
        """Threads that notified it."""
        self._worker = Worker(folder, self._store, lambda: self._now, self._note, InlineTask)

    def _note(self, event: str, content: int) -> None:
        if event == PROGRESS:
            self.applied = content

    def notify(self) -> None:
        self.notified_by.add(threading.get_ident())
        with self._working:
            self._now += 1000.0
            while self._worker.step():
                self._now += 1.0

    def stop(self) -> None:
        self._store.close()


class Desk:
    """The service, and requests to it as one of ``TOKENS`` or as nobody."""

    def __init__(
        self,
        root: Path,
        tokens: Sequence[TokenEntry] | None = tuple(ENTRIES),
        config: CloudConfig = CLOUD,
        **options: object,
    ) -> None:
        """``options`` of uvicorn."""
        self.now = 0.0
        missions = Missions(root, config, lambda: self.now, lambda: 1e9 + self.now, InlineWorker)
        self.state = ServiceState(
            missions,
            Authenticator(tokens),
            EventStream(beat_s=0.0),
            audit_file(root / "audit.jsonl", lambda: 1e9 + self.now),
        )
        self.app = create_app(self.state)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._server = uvicorn.Server(uvicorn.Config(self.app, log_level="critical", ws="none", **options))
        self.serving = threading.Thread(target=self._server.run, kwargs={"sockets": [self._listening]})
        port = self._listening.getsockname()[1]
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0)

    def __enter__(self) -> "Desk":
        self.serving.start()
        while not self._server.started:
            assert self.serving.is_alive()
            time.sleep(0.01)
        return self

    def __exit__(self, *error: object) -> None:
        self.client.close()
        self._server.should_exit = True
        self.serving.join()
        self._listening.close()

    def ask(self, method, path, as_=None, headers=None, **more):
        headers = dict(headers or {})
        if as_ is not None:
            headers["Authorization"] = f"Bearer token of {as_}"
        return self.client.request(method, path, headers=headers, **more)

    def send(self, robot, data, as_=None, **headers):
        path = f"/api/v1/robots/{robot}/packets"
        headers = {"Content-Type": MEDIA_TYPE, "Fcslam-Agent": "x", **headers}
        return self.ask("POST", path, as_ or robot, headers, content=write_batch(data))

    def told(self, response):
        assert response.status_code == 200, response.text
        return [decode(data).body for data in read_batch(response.content)]
