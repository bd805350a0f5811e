"""Strangers hold connections: how long a live robot's requests take.

    python benchmarks/idle_connections.py [--connections 1000] [--robots 20] [--seconds 60]

`fcslam serve` runs on this machine without TLS. Robots ask for their news once a second, as live robots with nothing
to send do, each over a connection of its own: first alone, then while another process holds connections and opens a
new one for each that the service closes. A request that finds its connection closed is sent again, as a robot does; its
time counts from the first attempt.

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
from pathlib import Path

import common
import httpx
import numpy as np
from faults import cloud

from fcslam.robot.sender import SEND_INTERVAL_S
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
    with tempfile.TemporaryDirectory() as place, cloud(Path(place)) as (_, port):
        for kind in ("none", "idle", "slow headers", "pipelined", "never read"):
            count = 0 if kind == "none" else chosen.connections
            strangers = multiprocessing.Process(target=hold, args=(port, count, kind), daemon=True)
            strangers.start()
            time.sleep(SETTLE_S)
            took_s, failed = asyncio.run(asked(port, chosen.robots, chosen.seconds))
            strangers.kill()
            strangers.join()
            quantiles = 1e3 * np.quantile(took_s, (0.5, 0.99, 1.0))
            rows.append((kind, count, chosen.robots, len(took_s), failed, *quantiles.tolist()))
    report.table("Requests of robots", COLUMNS, rows)
    report.write()


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


async def asked(port: int, robots: int, seconds: float) -> tuple[list[float], int]:
    """Seconds of each request, and how many failed twice."""
    took_s: list[float] = []
    failures: list[str] = []
    end = time.perf_counter() + seconds

    async def robot(number: int) -> None:
        headers = {"Content-Type": MEDIA_TYPE, AGENT_HEADER: f"{number:032x}", CORRECTION_HEADER: "-1"}
        url = f"http://127.0.0.1:{port}/api/v1/robots/robot{number}/packets"
        async with httpx.AsyncClient(headers=headers, timeout=60.0, trust_env=False) as client:
            await asyncio.sleep(number / robots * SEND_INTERVAL_S)
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

    await asyncio.gather(*(robot(number) for number in range(robots)))
    return took_s, len(failures)


if __name__ == "__main__":
    main()
