"""One robot's token attacks a service: how long requests of other robots take, and when their packets take effect.

    python benchmarks/attacks.py [--robots 20] [--seconds 40] [--ways NAME ...]

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
"""

import asyncio
import multiprocessing
import random
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

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
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for way in chosen.ways:
            rows.append((way, chosen.robots, *measured(Path(place) / way.replace(" ", "-"), way, chosen)))
            print(*rows[-1], flush=True)
    report.table("Requests and packets of other robots", COLUMNS, rows)
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
