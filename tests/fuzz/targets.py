"""Targets of the fuzzer: each reads one broken input. Everything but an answer or a refusal in words is a finding."""

import json
import random
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import islice, repeat
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np

from fcslam.cloud.settings import CloudConfig
from fcslam.config import dump, load
from fcslam.errors import FcslamError, PacketError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.mission.localization import read_map
from fcslam.mission.mission import MissionConfig
from fcslam.mission.mission_store import MissionStore, StoredPacket, check_mission
from fcslam.records import (
    Cut,
    FloorLabel,
    LaserModel,
    LaserScan,
    ManualClosure,
    MapRegion,
    Pin,
    Placement,
    RegionUse,
    Removal,
    Undo,
    Veto,
    frozen,
)
from fcslam.service.detectors import DetectorStore
from fcslam.sources import open_source, write_bag
from fcslam.storage.database import seal
from fcslam.wire.batches import MEDIA_TYPE, read_batch, write_batch
from fcslam.wire.packets import decode, encode, read_label
from tests.carmen_logs import write_carmen
from tests.fuzz.mutations import NUMBERS, TOKENS, mutate
from tests.fuzz.packets import BREAKERS, packets_of_every_kind
from tests.scripted import rectangle, stream

CELLS = (
    None, 0, -1, 1, 2**63 - 1, -(2**63), 0.5, -1e308, float("inf"), "", "a", "x" * 5000, "\x00", "{", "{}", "[1]", b"",
    b"\xff" * 300,
)  # fmt: skip
"""Replacements of a value of a mission."""
CORNERS = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0))
EDITS = (
    Removal("a"), Undo(1), Veto("a", "a", (1.0, 5.0)), Pin("a", "a", (1.0, 5.0)), Cut("a", 2.0, 3.0),
    ManualClosure("a", 1.0, "a", 6.0, (0.5, 0.0, 0.1), (0.1, 0.1)), Placement("a", 1.0, (1.0, 2.0, 0.5)),
    MapRegion(RegionUse.ERASE, "", "a", 1.0, CORNERS), MapRegion(RegionUse.AREA, "Room 1", "a", 1.0, CORNERS),
    FloorLabel("a", "2"),
)  # fmt: skip
"""Edits of every kind."""
LONGEST_REASON = 2000
"""Characters of a refusal."""

Attempt = Callable[[random.Random], bool]
"""Breaks one input and reads it: whether it could be read. Raises AssertionError or anything else for a finding."""


class Target(NamedTuple):
    """What is fuzzed."""

    attempt: Attempt
    read: Callable[[bytes], Any] | None = None
    """Reads one input, for a fuzzer that makes inputs by coverage; None if there is no one file or message."""
    seeds: tuple[bytes, ...] = ()
    """Valid inputs of ``read``."""


def attempt(read: Callable[[], Any]) -> bool:
    """Whether something could be read; a refusal must be words on a line."""
    try:
        read()
    except FcslamError as error:
        length = len(str(error))
        if not 0 < length < LONGEST_REASON:
            raise AssertionError(f"a reason of {length} characters: {str(error)[:300]!r}") from error
        return False
    return True


@contextmanager
def packets(_: Path) -> Iterator[Target]:
    """One packet or a batch of them: what is read can be sent on and says the same."""
    corpus, names = list(packets_of_every_kind(random.Random(0))), list(BREAKERS)

    def read(data: bytes) -> None:
        packet = decode(data)
        again = encode(packet)
        assert encode(decode(again)) == again, "written and read again, it is another"
        assert read_label(data).robot == packet.robot

    def one(rng: random.Random) -> bool:
        data = BREAKERS[rng.choice(names)](rng, corpus)
        if rng.random() < 0.1:
            try:
                batch = write_batch([data, rng.choice(corpus)])
            except PacketError:  # longer than a packet may be
                batch = data
            return attempt(lambda: read_batch(mutate(rng, batch, corpus)))
        return attempt(lambda: read(data))

    yield Target(one, read, tuple(corpus))


@contextmanager
def logs(folder: Path) -> Iterator[Target]:
    """CARMEN logs: surveyed and read to the end."""
    yield _recordings(folder, ("log.clf", "log.clf.gz", "log.clf.xz", "log.clf.bz2"))


@contextmanager
def bags(folder: Path) -> Iterator[Target]:
    """ROS bags: surveyed and read to the end."""
    yield _recordings(folder, ("bag.bag", "bag.mcap", "bag.db3", "bag"))


def _recordings(folder: Path, names: Sequence[str]) -> Target:
    laser = LaserModel(181, -np.pi / 2, np.pi / 180, 50.0, (0.1, 0.0, 0.0))
    scans = [
        LaserScan(100 + 0.2 * k, frozen(np.full(181, 2.25 + k), np.float32), laser, frozen((0.1 * k, 0.0, 0.01 * k)))
        for k in range(12)
    ]
    (valid := folder / "valid").mkdir()
    for name in names:
        if name.startswith("log"):
            write_carmen(valid / name, scans)
        else:
            write_bag(valid / name, scans)
    corpus = _contents(valid)

    def read(path: Path) -> None:
        source = open_source(path)
        source.survey()
        for _ in islice(source.records(), 10_000):
            pass

    def one(rng: random.Random) -> bool:
        chosen = rng.choice(list(corpus))
        path = _broken_copy(rng, folder / f"broken-{chosen}", corpus[chosen])
        return attempt(lambda: read(path))

    def read_bytes(data: bytes) -> None:
        (path := folder / "file").write_bytes(data)
        read(path)

    return Target(one, read_bytes, tuple(files["."] for files in corpus.values() if "." in files))


@contextmanager
def imports(folder: Path) -> Iterator[Target]:
    """Mission files, with valid seals too, and networks: checked, opened and read."""
    whole = folder / "valid.sqlite"
    with closing(MissionStore(folder / "first.sqlite")) as store:
        store.configure(CloudConfig())
        _fill(store)
        store.export(whole)
    mission, network = whole.read_bytes(), BUNDLED_NETWORK.read_bytes()
    path, detectors = folder / "broken.sqlite", DetectorStore(folder / "detectors")

    def read_mission() -> None:
        check_mission(path)
        with closing(MissionStore(path)) as opened:
            opened.configure(CloudConfig())
            for _ in (
                opened.envelopes(),
                opened.arrivals(0, 1000),
                opened.edits(),
                opened.finalizations(),
                opened.tracks(),
            ):
                pass
            opened.export(folder / "again.sqlite")

    def one(rng: random.Random) -> bool:
        kind = rng.random()
        if kind < 0.3:
            return attempt(lambda: detectors.announce(mutate(rng, network, [mission])))
        for old in (*folder.glob(f"{path.name}*"), folder / "again.sqlite"):
            old.unlink(missing_ok=True)
        path.write_bytes(mission)
        if kind < 0.7:
            _change_cell(rng, path)
        else:
            path.write_bytes(mutate(rng, mission, [network]))
        return attempt(read_mission)

    def read(data: bytes) -> None:
        for old in (*folder.glob(f"{path.name}*"), folder / "again.sqlite"):
            old.unlink(missing_ok=True)
        path.write_bytes(data)
        _seal(path)
        read_mission()

    yield Target(one, read, (mission,))


@contextmanager
def configuration(folder: Path) -> Iterator[Target]:
    """Settings files."""
    corpus = [dump(MissionConfig()).encode(), b"seed: 3\nrobot:\n  channels: [lidar]\n", b"{}\n"]
    path = folder / "config.yaml"

    def one(rng: random.Random) -> bool:
        path.write_bytes(mutate(rng, rng.choice(corpus), corpus))
        return attempt(lambda: load(MissionConfig, path))

    yield Target(one)


@contextmanager
def maps(folder: Path) -> Iterator[Target]:
    """Maps of map_server: the description and the image."""
    description = (
        b"image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2.0, 0.0]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    image = b"P5\n# made\n40 30\n255\n" + bytes(range(240)) * 5

    def one(rng: random.Random) -> bool:
        first = rng.random() < 0.6
        files = ("map.yaml", mutate(rng, description, [image])), ("map.pgm", image)
        if not first:
            files = ("map.yaml", description), ("map.pgm", mutate(rng, image, [description]))
        for name, content in files:
            (folder / name).write_bytes(content)
        return attempt(lambda: read_map(folder / "map.yaml"))

    def read(data: bytes) -> None:
        parts = data.partition(b"\0\0")
        (folder / "map.yaml").write_bytes(parts[0])
        (folder / "map.pgm").write_bytes(parts[2])
        read_map(folder / "map.yaml")

    _, png = cv2.imencode(".png", np.arange(240, dtype=np.uint8).reshape(12, 20))
    yield Target(one, read, tuple(description + b"\0\0" + each for each in (image, png.tobytes())))


@contextmanager
def federated(_: Path) -> Iterator[Target]:
    """Replies of robots to the server, as bytes, and the server's requests to a robot."""
    from fcslam.learning.federated.messages import (
        TrainingReply,
        TrainingRequest,
        collect_updates,
        read_reply,
        read_request,
        write_reply,
        write_request,
    )
    from fcslam.learning.federated.screening import BOUNDS, screen
    from fcslam.learning.federated.settings import FederatedSettings

    rng = np.random.default_rng(0)
    names = ("a.weight", "a.bias", "a.running_mean", "a.running_var")
    sent = {name: np.abs(rng.normal(size=4)).astype(np.float32) for name in names}
    moved = {
        robot: {name: (array * (1.0 + 0.01 * k)).astype(np.float32) for name, array in sent.items()}
        for k, robot in enumerate(("alice", "bob", "carol", "dave"))
    }
    replies = [
        write_reply(TrainingReply(robot, "light-1", weights, {"detector": 0.5})) for robot, weights in moved.items()
    ]
    asked = write_request(TrainingRequest(True, sent, "light-1", 0, "run", FederatedSettings()))

    def one(rng: random.Random) -> bool:
        data = mutate(rng, rng.choice((asked, *replies)), replies)
        try:
            reply = read_reply(data)
        except ValueError:
            return attempt(lambda: read_request(data))
        found = collect_updates({"alice": reply}, ["alice"], "light-1")
        assert all(text.isprintable() and text for text in found.left_out.values())
        refused = screen(moved | found.weights, sent, BOUNDS)
        kept = [weights for robot, weights in (moved | found.weights).items() if robot not in refused]
        assert all(np.isfinite(array).all() for weights in kept for array in weights.values())
        return bool(found.weights)

    yield Target(one)


@contextmanager
def http(folder: Path) -> Iterator[Target]:
    """Requests to the service by its own description: no answer is an internal error."""
    from tests.service.http.desk import A, B, Desk

    with ExitStack() as stack:
        desk = stack.enter_context(Desk(folder / "data"))
        desk.client.timeout = 20.0
        desk.told(desk.send("a", A))
        desk.told(desk.send("b", B))
        mission = desk.ask("GET", "/api/v1/missions/mission/export", "boss").content
        described = desk.app.openapi()
        operations = [
            (method.upper(), path, each) for path, item in described["paths"].items() for method, each in item.items()
        ]
        bodies = [write_batch(A), *(write_batch([data]) for data in (A[0], B[0])), mission, b"{}", b"[]"]

        def one(rng: random.Random) -> bool:
            method, path, operation = rng.choice(operations)
            if rng.random() < 0.03:
                method = rng.choice(("PUT", "PATCH", "HEAD", "OPTIONS", "TRACE", "BREW"))
            query = {}
            for parameter in operation.get("parameters", ()):
                value = _value(rng)
                if parameter["in"] == "path":
                    path = path.replace("{" + parameter["name"] + "}", quote(value, safe="") or "a")
                elif parameter["in"] == "query" and rng.random() < 0.7:
                    query[parameter["name"]] = value
            kinds = list(operation.get("requestBody", {}).get("content", {"application/json": {}}))
            headers = {"Content-Type": rng.choice((*kinds, *kinds, MEDIA_TYPE, "text/plain", "x")), "Fcslam-Agent": "x"}
            if rng.random() < 0.1:
                headers[rng.choice(("Range", "Last-Event-ID", "If-None-Match", "Content-Encoding", "Host"))] = "a" * 50
            body = None
            if "requestBody" in operation or rng.random() < 0.05:
                body = json.dumps(_document(rng, 3)).encode() if rng.random() < 0.5 else rng.choice(bodies)
                body = mutate(rng, body, bodies) if rng.random() < 0.7 else body
            as_ = rng.choice(("boss", "boss", "a", "eye", None))
            if as_ is not None:
                headers["Authorization"] = f"Bearer token of {as_}"
            with desk.client.stream(method, path, params=query, headers=headers, content=body) as response:
                status, kind = response.status_code, response.headers.get("content-type", "")
                text = "" if kind.startswith("text/event-stream") else response.read()[:300]
            assert status < 500 or status in (503, 507), f"{method} {path} {query} as {as_}: {status} {text!r}"
            return status < 400

        yield Target(one)


TARGETS: dict[str, Callable[[Path], Any]] = {
    each.__name__: each for each in (packets, imports, logs, bags, http, federated, configuration, maps)
}


def _contents(folder: Path) -> dict[str, dict[str, bytes]]:
    """Every recording below the folder: the content of its files by their path in it; a lone file is at ``.``."""
    found = {}
    for path in sorted(folder.iterdir()):
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        found[path.name] = {str(file.relative_to(path)): file.read_bytes() for file in files}
    return found


def _broken_copy(rng: random.Random, path: Path, files: dict[str, bytes]) -> Path:
    """The files again at ``path``, one of them broken."""
    broken = rng.choice(list(files))
    for name, content in files.items():
        target = path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(mutate(rng, content, list(files.values())) if name == broken else content)
    return path


def _fill(store: MissionStore) -> None:
    """A robot's packets, as the service stores them, and edits of every kind."""
    for packet in stream("a", rectangle(9), 0.0):
        label = read_label(data := encode(packet))
        number = packet.robot, packet.epoch, packet.sequence
        store.put([StoredPacket(*number, packet.time, label.kind, label.channel, data)], 1.0)
    for content in EDITS:
        store.edit(content, "boss", 2.0)
    store.ask_to_finalize()


def _seal(path: Path) -> None:
    """Seal every row of a mission, as who writes the file can do it."""
    with suppress(sqlite3.Error, UnicodeError, OverflowError), closing(sqlite3.connect(path)) as opened:
        steps = repeat(False, 1000)
        opened.set_progress_handler(lambda: next(steps, True), 100_000)
        opened.create_function("seal", -1, seal, deterministic=True)
        for name in ("packets", "edits", "finalizations", "facts"):
            columns = [row[1] for row in opened.execute(f"PRAGMA table_info({name})")][:-1]
            opened.execute(f"UPDATE {name} SET seal = seal('{name}', {', '.join(columns)})")
        opened.commit()


def _change_cell(rng: random.Random, path: Path) -> None:
    """A value of a mission becomes another one under a valid seal, as who writes the file can make it."""
    with closing(sqlite3.connect(path, isolation_level=None)) as opened:
        opened.create_function("seal", -1, seal, deterministic=True)
        for _ in range(rng.choice((1, 1, 3))):
            value = rng.choice(CELLS)
            name = rng.choice(("packets", "edits", "finalizations", "facts"))
            columns = [row[1] for row in opened.execute(f"PRAGMA table_info({name})")][:-1]
            column = rng.choice(columns)
            rows = opened.execute(f"SELECT rowid, * FROM {name}").fetchall()
            rowid, *values, _ = rng.choice(rows)
            old = values[columns.index(column)]
            if isinstance(old, str | bytes) and rng.random() < 0.5:
                data = mutate(rng, old if isinstance(old, bytes) else old.encode(), [b"x"])
                value = data if isinstance(old, bytes) else data.decode("latin-1")
            values[columns.index(column)] = value
            try:
                opened.execute(f"UPDATE {name} SET {column} = ? WHERE rowid = ?", (value, rowid))
                key = value if column == columns[0] and isinstance(value, int) and name != "facts" else rowid
                stored = opened.execute(f"SELECT {', '.join(columns)} FROM {name} WHERE rowid = ?", (key,)).fetchone()
                if stored is not None:
                    opened.execute(f"UPDATE {name} SET seal = ? WHERE rowid = ?", (seal(name, *stored), key))
            except (sqlite3.Error, OverflowError, UnicodeError):
                pass  # the schema does not take it


def _value(rng: random.Random) -> str:
    """Of a parameter: mostly a sensible one."""
    hostile = rng.choice(NUMBERS + TOKENS)[:2000].decode("latin-1")
    return rng.choice(("a", "b", "mission", "0", "1", "camera", "lidar", hostile, "\u00e9", "..", "a/b"))


def _document(rng: random.Random, depth: int) -> Any:
    if depth == 0 or rng.random() < 0.3:
        return rng.choice((None, True, 0, -1, 1.5, 2**70, "", "a", "a+1", "\u0000", "x" * 5000, [], {}))
    if rng.random() < 0.3:
        return [_document(rng, depth - 1) for _ in range(rng.randrange(4))]
    keys = ("robot", "name", "i", "j", "index", "session", "epoch", "number", "a", "b", "reason")
    return {rng.choice(keys): _document(rng, depth - 1) for _ in range(rng.randrange(5))}
