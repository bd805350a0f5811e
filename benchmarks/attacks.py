"""One robot's token attacks a service: how long requests of other robots take, and when their packets take effect.

    python benchmarks/attacks.py [--robots 20] [--seconds 40] [--ways NAME ...] [--shapes 100]

`fcslam serve` runs on this machine with tokens and without TLS. Robots ask for their news once a second, each with its
token and over a connection of its own. One more robot begins a session again and again, and waits for the first
correction of each. All of it is measured alone, and then while another process attacks with the token of one robot,
from five seconds after the robots have connected.

Ways
- unfinished bodies: 4,300 POSTs whose body never comes, opened again when the service closes them
- refused packets: constraints of keyscans that do not exist, as many as the service takes
- costly packets: keyscans with all their beams, as many as the service takes
- reads: 40 connections that ask for the robot's state without pause
- mixed: 40 connections with requests of random methods, paths, headers, lengths and pauses, cut at random bytes

Then a fuzzer draws shapes of requests: how many connections, method, path, headers, announced and real length, pieces
and pauses, requests at once on a connection, and what is read of the answer. Each attacks for five seconds while the
robots send keyscans twice a second. In the end, the service must have all of them.
"""

import asyncio
import multiprocessing
import random
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

import common
import httpx
import numpy as np
from idle_connections import SETTLE_S, asked, make_tokens
from processes import cloud

from fcslam.records import Constraint, ConstraintKind, Keyscan, KeyscanId, LaserModel, frozen
from fcslam.service.http.protocol import allow_many_connections
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, MEDIA_TYPE, read_batch, write_batch
from fcslam.wire.messages import Body, Correction, Hello, Packet
from fcslam.wire.packets import decode, encode
from fcslam.wire.quantisation import dequantise

COLUMNS = {
    "way": "", "robots": "d", "requests": ",d", "lost": "d", "median, ms": ".1f", "99 %, ms": ".1f",
    "most, ms": ".1f", "effects": "d", "effect, median, s": ".2f", "effect, most, s": ".2f",
}  # fmt: skip
SHAPES = {
    "connections": "d", "request": "", "body, bytes": "", "pieces, bytes": ",d", "pause, s": ".3f", "at once": "d",
    "reads": "", "requests": "d", "99 %, ms": ".1f", "most, ms": ".1f",
}  # fmt: skip
TOGETHER = {"shapes": "d", "requests": ",d", "lost": "d", "packets": ",d", "packets lost": "d", "99 %, ms": ".1f",
            "most, ms": ".1f", "shapes with 99 % over 500 ms": "d"}  # fmt: skip
SHAPE_S, WORST_SHOWN = 5.0, 10
HOST = "127.0.0.1"
HOSTILE, MEASURED = "robot0", "robot1"
UNFINISHED, CONNECTIONS, BATCH = 4300, 40, 500
LASER = LaserModel(1080, -2.35, 0.00435, 30.0)
LONGEST_EFFECT_S = 120.0


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=40.0, help="of each measurement")
    parser.add_argument("--ways", nargs="+", choices=["none", *WAYS], default=["none", *WAYS])
    parser.add_argument("--shapes", type=int, default=100, help="of requests that the fuzzer draws")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for way in chosen.ways:
            rows.append((way, chosen.robots, *measured(Path(place) / way.replace(" ", "-"), way, chosen)))
            print(*rows[-1], flush=True)
        if chosen.shapes:
            together, each = fuzzed(Path(place) / "fuzzer", chosen.robots, chosen.shapes)
    report.table("Requests and packets of other robots", COLUMNS, rows)
    if chosen.shapes:
        report.table("Under all shapes of the fuzzer", TOGETHER, [together])
        report.table("Shapes with the longest requests", SHAPES, sorted(each, key=lambda row: -row[-2])[:WORST_SHOWN])
    report.write()


def measured(place: Path, way: str, chosen: object) -> tuple[object, ...]:
    """Requests, how many failed twice, quantiles of their time, and those of the time until a packet has an effect."""
    place.mkdir()
    with ExitStack() as stack:
        tokens = make_tokens(place, chosen.robots + 2)
        _, port = stack.enter_context(cloud(place, "--credentials", place / "service"))
        attacker = multiprocessing.Process(target=attack, args=(port, tokens.pop(HOSTILE), way), daemon=True)
        attacker.start()
        stack.callback(attacker.join)
        stack.callback(attacker.kill)
        token = tokens.pop(MEASURED)

        async def both() -> tuple[tuple[list[float], int], list[float]]:
            return await asyncio.gather(asked(port, tokens, chosen.seconds), effects(port, token, chosen.seconds))

        (took_s, failed), effects_s = asyncio.run(both())
    quantiles = 1e3 * np.quantile(took_s, (0.5, 0.99, 1.0))
    return len(took_s), failed, *quantiles.tolist(), len(effects_s), float(np.median(effects_s)), max(effects_s)


class Shape(NamedTuple):
    """What one way of the fuzzer sends, again and again."""

    connections: int
    method: str
    path: str
    headers: bytes
    length: int
    """What is announced; -1: chunks."""
    body: bytes
    piece: int
    pause_s: float
    at_once: int
    """Requests that are sent before an answer is read."""
    reads: str


def drawn_shape(number: int) -> Shape:
    """A shape of the fuzzer."""
    rng = random.Random(number)
    own, valid = f"/api/v1/robots/{HOSTILE}", packets(HOSTILE, 0, 0, (Hello(HOSTILE, 0, (LASER,), {}),))
    bodies = (b"", b"abc", valid, valid[:-3], valid * 300, rng.randbytes(1 << 20), bytes(4 << 20), b"{" * 60_000)
    body = rng.choice(bodies)
    return Shape(
        rng.choice((1, 8, 40, 200, 1000)),
        rng.choice(("POST", "POST", "POST", "GET", "HEAD", "PUT", "DELETE", "?")),
        rng.choice((f"{own}/packets", f"{own}/packets", f"{own}/state", f"{own}/map", "/", "/x" * 5000)),
        rng.choice((b"", b"Expect: 100-continue\r\n", b"Connection: close\r\n", b"X: " + b"y" * 9000 + b"\r\n",
                    b"".join(b"A%d: b\r\n" % k for k in range(90)), b"Content-Encoding: gzip\r\n")),
        rng.choice((len(body), len(body), len(body), len(body) + 1000, 1 << 40, -1)),
        body,
        rng.choice((1, 100, 5000, 1 << 22)),
        rng.choice((0.0, 0.0, 0.001, 0.1, 1.0)),
        rng.choice((1, 1, 3, 100)),
        rng.choice(("all", "all", "some", "nothing")),
    )  # fmt: skip


def fuzzed(place: Path, robots: int, shapes: int) -> tuple[tuple[object, ...], list[tuple[object, ...]]]:
    """All shapes together, and each with the requests of the robots while it attacks."""
    place.mkdir()
    each: list[tuple[object, ...]] = []
    took_s: list[float] = []
    with ExitStack() as stack:
        tokens = make_tokens(place, robots + 1)
        _, port = stack.enter_context(cloud(place, "--credentials", place / "service"))
        token = tokens.pop(HOSTILE)
        senders = [Sender(port, name, one) for name, one in tokens.items()]

        async def all_shapes() -> list[int]:
            await send_all(senders, SHAPE_S)  # alone, so that all have their connections
            for number in range(shapes):
                for sender in senders:
                    sender.took_s.clear()
                shape = drawn_shape(number)
                attacker = multiprocessing.Process(target=attack_by, args=(port, token, shape), daemon=True)
                attacker.start()
                await send_all(senders, SHAPE_S)
                attacker.kill()
                some = [second for sender in senders for second in sender.took_s]
                took_s.extend(some)
                most = 1e3 * np.quantile(some, (0.99, 1.0))
                asked, body = f"{shape.method} {shape.path[:40]}", f"{shape.length:,} announced, {len(shape.body):,}"
                way = (shape.connections, asked, body, shape.piece, shape.pause_s, shape.at_once, shape.reads)
                each.append((*way, len(some), *most.tolist()))
                print(number, *each[-1], flush=True)
            return [await sender.stored() for sender in senders]

        stored = asyncio.run(all_shapes())
    sent, failed = sum(sender.sent for sender in senders), sum(sender.failed for sender in senders)
    most = 1e3 * np.quantile(took_s, (0.99, 1.0))
    slow = sum(row[-2] > 500.0 for row in each)
    return (shapes, len(took_s), failed, sent, sent - sum(stored), *most.tolist(), slow), each


class Sender:
    """An honest robot that sends keyscans."""

    def __init__(self, port: int, robot: str, token: str) -> None:
        self._port, self._robot = port, robot
        self._client = httpx.AsyncClient(headers=headers_of(token), timeout=60.0, trust_env=False)
        self.sent, self.failed, self.took_s = 0, 0, list[float]()

    async def send(self, seconds: float, delay_s: float) -> None:
        """Send twice a second; a request whose connection was closed is sent again."""
        await asyncio.sleep(delay_s)
        end, url = time.perf_counter() + seconds, packets_url(self._port, self._robot)
        while time.perf_counter() < end:
            k, began = max(0, (self.sent - 1) // 2), time.perf_counter()
            drive = keyscan(self._robot, k), motion(self._robot, k)
            bodies = drive if self.sent else (Hello(self._robot, 0, (LASER,), {}), *drive)
            batch = packets(self._robot, 0, self.sent, bodies)
            try:
                try:
                    answer = await self._client.post(url, content=batch)
                except httpx.TransportError:
                    answer = await self._client.post(url, content=batch)
                answer.raise_for_status()
                self.sent += len(bodies)
            except httpx.HTTPError:
                self.failed += 1
            self.took_s.append(time.perf_counter() - began)
            await asyncio.sleep(max(0.0, began + 0.5 - time.perf_counter()))

    async def stored(self) -> int:
        """How many packets the service has without a gap."""
        answer = await self._client.get(f"http://{HOST}:{self._port}/api/v1/robots/{self._robot}/state")
        return int(answer.json()["next"]["0"])


async def send_all(senders: list[Sender], seconds: float) -> None:
    """All robots send, one after another."""
    await asyncio.gather(*(sender.send(seconds, 0.5 * k / len(senders)) for k, sender in enumerate(senders)))


def attack_by(port: int, token: str, shape: Shape) -> None:
    """Attack by a shape for ever."""
    allow_many_connections()
    length = b"Transfer-Encoding: chunked" if shape.length < 0 else b"Content-Length: %d" % shape.length
    head = request(token, shape.method, shape.path, 0).replace(b"Content-Length: 0", length)[:-2] + shape.headers
    body = b"%x\r\n%s\r\n0\r\n\r\n" % (len(shape.body), shape.body) if shape.length < 0 else shape.body
    data = (head + b"\r\n" + body) * shape.at_once if len(body) < 1 << 18 else head + b"\r\n" + body

    async def once() -> None:
        reader, writer = await asyncio.open_connection(HOST, port)
        try:
            for at in range(0, len(data), shape.piece):
                writer.write(data[at : at + shape.piece])
                await writer.drain()
                await asyncio.sleep(shape.pause_s)
            if shape.reads != "nothing":
                await asyncio.wait_for(reader.read(1 << 16 if shape.reads == "all" else 1), 5.0)
        finally:
            writer.close()

    async def again() -> None:
        while True:
            with suppress(OSError, TimeoutError):
                await once()
            await asyncio.sleep(shape.pause_s)

    async def all_of_them() -> None:
        await asyncio.gather(*(again() for _ in range(shape.connections)))

    asyncio.run(all_of_them())


async def effects(port: int, token: str, seconds: float) -> list[float]:
    """Seconds from a session's first packets to its first correction, one session after another."""
    took_s, end, epoch = [], time.perf_counter() + seconds, 0
    async with httpx.AsyncClient(headers=headers_of(token), timeout=60.0, trust_env=False) as client:
        while time.perf_counter() < end:
            bodies = Hello(MEASURED, epoch, (LASER,), {}), keyscan(MEASURED, 0)
            batch, began = packets(MEASURED, epoch, 0, bodies), time.perf_counter()
            while time.perf_counter() < began + LONGEST_EFFECT_S:
                with suppress(httpx.TransportError):
                    answer = await client.post(packets_url(port, MEASURED), content=batch)
                    told = [decode(data) for data in read_batch(answer.content)] if answer.status_code == 200 else []
                    if any(isinstance(packet.body, Correction) and packet.epoch == epoch for packet in told):
                        break
                await asyncio.sleep(0.05)
            took_s.append(time.perf_counter() - began)
            epoch += 1
            await asyncio.sleep(1.0)
    return took_s


def attack(port: int, token: str, way: str) -> None:
    """Attack for ever."""
    if way == "none":
        return
    time.sleep(SETTLE_S)
    allow_many_connections()
    count, attacker = WAYS[way]

    async def again(number: int) -> None:
        while True:
            with suppress(OSError, httpx.HTTPError, asyncio.IncompleteReadError):
                await attacker(port, token, number)
            await asyncio.sleep(0.1)

    async def all_of_them() -> None:
        await asyncio.gather(*(again(number) for number in range(count)))

    asyncio.run(all_of_them())


async def never_finish(port: int, token: str, _: int) -> None:
    """A request whose body does not come."""
    reader, writer = await asyncio.open_connection(HOST, port)
    writer.write(request(token, "POST", f"/api/v1/robots/{HOSTILE}/packets", 1000) + b"abc")
    try:
        await reader.read()
    finally:
        writer.close()


def flood(bodies: Callable[[int], Iterator[Body]]) -> Callable[[int, str, int], Coroutine[None, None, None]]:
    """Batches of packets as fast as the service takes them."""

    async def send(port: int, token: str, _: int) -> None:
        async with httpx.AsyncClient(headers=headers_of(token), timeout=60.0, trust_env=False) as client:
            state = (await client.get(f"http://{HOST}:{port}/api/v1/robots/{HOSTILE}/state")).json()
            sent = state["next"].get("0", 0)
            while True:
                chosen = (Hello(HOSTILE, 0, (LASER,), {}), *bodies(sent)) if sent == 0 else tuple(bodies(sent))
                answer = await client.post(packets_url(port, HOSTILE), content=packets(HOSTILE, 0, sent, chosen))
                if answer.status_code == 200:
                    sent += len(chosen)
                else:
                    await asyncio.sleep(float(answer.headers.get("retry-after", 1.0)))

    return send


def refused(_: int) -> Iterator[Body]:
    """Constraints that are well-formed, of keyscans that do not exist."""
    for k in range(BATCH):
        yield motion(HOSTILE, 10**6 + k)


def costly(sent: int) -> Iterator[Body]:
    """Keyscans with all beams, each with its motion."""
    first = max(0, (sent - 1) // 2)
    for k in range(first, first + BATCH // 10):
        yield keyscan(HOSTILE, k)
        yield motion(HOSTILE, k)


async def read_state(port: int, token: str, _: int) -> None:
    """Read the state of the own robot without pause."""
    async with httpx.AsyncClient(headers=headers_of(token), timeout=60.0, trust_env=False) as client:
        while True:
            await client.get(f"http://{HOST}:{port}/api/v1/robots/{HOSTILE}/state")


async def mixed(port: int, token: str, number: int) -> None:
    """A request of a random shape, sent in random pieces."""
    rng = random.Random(f"{number} {time.monotonic_ns()}")
    path = rng.choice(("packets", "state", "fleet", "map", "x" * rng.randrange(2000), "../../fleet"))
    sent = request(token, rng.choice(("GET", "POST", "PUT", "HEAD", "?")), f"/api/v1/robots/{HOSTILE}/{path}",
                   rng.choice((0, 7, 1 << 20, 1 << 40)))  # fmt: skip
    sent = (sent + rng.randbytes(rng.choice((0, 7, 5000, 1 << 20))))[: rng.choice((40, 400, 1 << 22))]
    reader, writer = await asyncio.open_connection(HOST, port)
    try:
        for at in range(0, len(sent), step := rng.choice((50, 5000, 1 << 20))):
            writer.write(sent[at : at + step])
            await writer.drain()
            await asyncio.sleep(rng.choice((0.0, 0.0, 0.01, 0.5)))
        await asyncio.wait_for(reader.read(rng.choice((1, 1 << 16))), rng.choice((0.01, 1.0, 30.0)))
    except TimeoutError:
        pass
    finally:
        writer.close()


def request(token: str, method: str, path: str, length: int) -> bytes:
    """Head of a request."""
    head = f"{method} {path} HTTP/1.1\r\nHost: {HOST}\r\nContent-Length: {length}\r\n"
    return head.encode() + "".join(f"{k}: {v}\r\n" for k, v in headers_of(token).items()).encode() + b"\r\n"


def headers_of(token: str) -> dict[str, str]:
    """Headers of a robot's request."""
    kind = {"Content-Type": MEDIA_TYPE, AGENT_HEADER: 32 * "a", CORRECTION_HEADER: "-1"}
    return {**kind, "Authorization": f"Bearer {token}"}


def packets_url(port: int, robot: str) -> str:
    """Where packets of a robot go."""
    return f"http://{HOST}:{port}/api/v1/robots/{robot}/packets"


def packets(robot: str, epoch: int, first: int, bodies: tuple[Body, ...]) -> bytes:
    """A batch, whose packets are numbered from ``first``."""
    return write_batch(encode(Packet(robot, epoch, first + k, 0.1 * (first + k), one)) for k, one in enumerate(bodies))


def keyscan(robot: str, number: int) -> Keyscan:
    """A keyscan in a round room."""
    return Keyscan(KeyscanId(robot, number), 0.1 * number, dequantise(np.full(LASER.beam_count, 1000, np.uint16)))


def motion(robot: str, i: int) -> Constraint:
    """Odometry from keyscan i to the next one."""
    information = frozen(np.diag((1e4, 1e4, 1e5)))
    return Constraint(robot, i, i + 1, ConstraintKind.ODOMETRY, frozen((0.3, 0.0, 0.0)), information)


WAYS: dict[str, tuple[int, Callable[[int, str, int], Coroutine[None, None, None]]]] = {
    "unfinished bodies": (UNFINISHED, never_finish),
    "refused packets": (1, flood(refused)),
    "costly packets": (1, flood(costly)),
    "reads": (CONNECTIONS, read_state),
    "mixed": (CONNECTIONS, mixed),
}


if __name__ == "__main__":
    main()
