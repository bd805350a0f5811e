"""Strangers hold connections: how long a live robot's requests take.

    python benchmarks/idle_connections.py [--connections 1000] [--robots 20] [--seconds 60]

`fcslam serve` runs on this machine with tokens and without TLS. Robots ask for their news once a second, as live robots
with nothing to send do, each with its token and over a connection of its own: first alone, then while another process
without a token holds connections and opens a new one for each that the service closes. A request that finds its
connection closed is sent again, as a robot does; its time counts from the first attempt.

Strangers
- idle: send nothing
- slow headers: send one byte of a header a second
- pipelined: send 150 requests for `/openapi.json` at once, and read the answers
- never read: the same, but read nothing
"""

import asyncio
import multiprocessing
import resource
import tempfile
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import common
import httpx
import numpy as np
from processes import cloud

from fcslam.robot.sender import SEND_INTERVAL_S
from fcslam.service.authentication import Role
from fcslam.service.credentials import TOKEN, folder_of, make_credentials
from fcslam.service.http.protocol import allow_many_connections
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, MEDIA_TYPE, write_batch

COLUMNS = {
    "strangers": "", "connections": ",d", "robots": "d", "requests": ",d", "failed": "d",
    "median, ms": ".1f", "99 %, ms": ".1f", "most, ms": ".1f",
}  # fmt: skip
SETTLE_S = 5.0
PIPELINE = 150 * b"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--connections", type=int, default=1000, help="of strangers")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each measurement")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        tokens = make_tokens(place, chosen.robots)
        _, port = stack.enter_context(cloud(place, "--credentials", place / "service"))
        for kind in ("none", "idle", "slow headers", "pipelined", "never read"):
            count = 0 if kind == "none" else chosen.connections
            strangers = multiprocessing.Process(target=hold, args=(port, count, kind), daemon=True)
            strangers.start()
            time.sleep(SETTLE_S)
            took_s, failed = asyncio.run(asked(port, tokens, chosen.seconds))
            strangers.kill()
            strangers.join()
            quantiles = 1e3 * np.quantile(took_s, (0.5, 0.99, 1.0))
            rows.append((kind, count, chosen.robots, len(took_s), failed, *quantiles.tolist()))
    report.table("Requests of robots", COLUMNS, rows)
    report.write()


def make_tokens(place: Path, robots: int) -> dict[str, str]:
    """The token of each robot; a folder `service` has what the service needs, without certificates."""
    names = [f"robot{number}" for number in range(robots)]
    make_credentials(place / "all", [], dict.fromkeys(names, Role.ROBOT), datetime.now(UTC))
    (place / "service").mkdir()
    (place / "all" / "tokens.yaml").rename(place / "service" / "tokens.yaml")
    return {name: (folder_of(place / "all", name, Role.ROBOT) / TOKEN).read_text().strip() for name in names}


def hold(port: int, count: int, kind: str) -> None:
    """Hold so many connections of strangers, for ever."""
    allow_many_connections()
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > count

    async def stranger() -> None:
        while True:
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                if kind in ("pipelined", "never read"):
                    writer.write(PIPELINE)
                if kind == "slow headers":
                    writer.write(b"GET /healthz HTTP/1.1\r\nA: ")
                while kind == "slow headers" and not reader.at_eof():
                    writer.write(b"a")
                    await writer.drain()
                    await asyncio.sleep(1.0)
                while kind == "never read" and not writer.is_closing():
                    await asyncio.sleep(1.0)
                await reader.read()
                writer.close()
            except OSError:
                await asyncio.sleep(0.1)

    async def all_of_them() -> None:
        await asyncio.gather(*(stranger() for _ in range(count)))

    asyncio.run(all_of_them())


async def asked(port: int, tokens: dict[str, str], seconds: float) -> tuple[list[float], int]:
    """Seconds of each request, and how many failed twice."""
    took_s: list[float] = []
    failures: list[str] = []
    end = time.perf_counter() + seconds

    async def robot(number: int, name: str, token: str) -> None:
        headers = {"Content-Type": MEDIA_TYPE, AGENT_HEADER: f"{number:032x}", CORRECTION_HEADER: "-1"}
        headers["Authorization"] = f"Bearer {token}"
        url = f"http://127.0.0.1:{port}/api/v1/robots/{name}/packets"
        async with httpx.AsyncClient(headers=headers, timeout=60.0, trust_env=False) as client:
            await asyncio.sleep(number / len(tokens) * SEND_INTERVAL_S)
            while time.perf_counter() < end:
                began = time.perf_counter()
                try:
                    try:
                        answer = await client.post(url, content=write_batch(()))
                    except httpx.TransportError:
                        answer = await client.post(url, content=write_batch(()))
                    answer.raise_for_status()
                except httpx.HTTPError as error:
                    failures.append(str(error))
                took_s.append(time.perf_counter() - began)
                await asyncio.sleep(max(0.0, began + SEND_INTERVAL_S - time.perf_counter()))

    await asyncio.gather(*(robot(number, *each) for number, each in enumerate(tokens.items())))
    return took_s, len(failures)


if __name__ == "__main__":
    main()
