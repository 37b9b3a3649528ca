"""Share of a core that browsers cost a server while they watch a training: `STRIDE_SERVE=target/release/examples/serve python watchers.py`.

Needs httpx. Each client makes the calls that the page's first view makes (`trainer/page/static/views/now.js`) and reads the stream of
events. One worker trains as far as the server knows: it polls and sends twenty values a second.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import threading
import time
from pathlib import Path

import httpx

from mlflow_beside import Stride, cpu

CLIENTS = int(os.environ.get("CLIENTS", "50"))
SECONDS = int(os.environ.get("SECONDS_WATCHED", "30"))


def used(pid: int) -> float:
    """Seconds of processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def watch(stride: Stride, late: float) -> int:
    url, headers = str(stride.http.base_url), dict(stride.http.headers)
    calls = 0

    async def stream() -> None:
        async with client.stream("GET", "/v1/events") as answer:
            async for _ in answer.aiter_bytes():
                pass

    async with httpx.AsyncClient(base_url=url, headers=headers, timeout=60, limits=httpx.Limits(max_connections=6)) as client:
        await asyncio.sleep(late)
        events = asyncio.create_task(stream())
        for beat in range(SECONDS):
            next_beat = asyncio.get_running_loop().time() + 1
            paths = [f"/v1/runs/{stride.run}"]
            if beat % 5 == 0:
                paths += ["/v1/runs?limit=40", "/v1/workers", "/v1/health"]
                paths += [f"/v1/metrics?run={stride.run}&stage=dataset&buckets=80"]
            for path in paths:
                (await client.get(path)).raise_for_status()
            calls += len(paths)
            await asyncio.sleep(max(0.0, next_beat - asyncio.get_running_loop().time()))
        events.cancel()
    return calls


def train(stride: Stride, ends: threading.Event) -> None:
    step = 0
    while not ends.wait(1):
        rows = [{"step": at, "key": "loss", "value": 1 / (1 + at)} for at in range(step, step + 20)]
        stride.call("POST", "/v1/metrics", {"grant": stride.grant, "rows": rows}, stride.secret)
        step += 20


async def together(stride: Stride, clients: int) -> int:
    return sum(await asyncio.gather(*(watch(stride, number / clients) for number in range(clients))))


def measure(stride: Stride, clients: int) -> tuple[float, float, int]:
    begun, before, ends = time.monotonic(), used(stride.process.pid), threading.Event()
    worker = threading.Thread(target=train, args=(stride, ends))
    worker.start()
    calls = asyncio.run(together(stride, clients)) if clients else time.sleep(SECONDS) or 0
    spent, took = used(stride.process.pid) - before, time.monotonic() - begun
    ends.set()
    worker.join()
    return spent, took, calls


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        stride = Stride(Path(name))
        try:
            spent, took, _ = measure(stride, 0)
            alone = spent / took
            spent, took, calls = measure(stride, CLIENTS)
        finally:
            stride.ended.set()
            stride.stop()
        # On a busy machine the beats of clients take longer than a second; each beat counts as one.
        watched = alone + (spent - alone * took) / SECONDS
        print(f"{cpu()}: {100 * alone:.1f} % of a core without clients, {100 * watched:.1f} % with {CLIENTS}")
        print(f"{1000 * spent / calls:.2f} ms a call, {calls / SECONDS:.0f} calls a second; {SECONDS} beats took {took:.0f} s")


if __name__ == "__main__":
    main()
