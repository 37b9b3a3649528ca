"""A server of its own for the tests: `trainer serve` on a new store, and one worker."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import stride

TRAINER = os.environ.get("STRIDE_TRAINER", str(Path(__file__).parents[3] / "target" / "debug" / "trainer"))

PIPELINE = """\
name: tiny
seed: 1
dataset: {format: synthetic, clips: 32, val: 0.1, test: 0.2}
stages:
  vae:
    kind: train.vae
    latent: {tokens: 2, dim: 8}
    network: {width: 16, layers: 3, heads: 2, feed_forward: 32}
    steps: 6
    batch: {global: 4, slices: 1}
    lr: 1e-3
    warmup: 2
    checkpoint: {every: 3}
"""


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="session")
def server(store: Path) -> Iterator[stride.Server]:
    os.environ["STRIDE_TRAINER"] = TRAINER
    log = store.parent / "serve.log"
    processes = []
    with log.open("w") as out:
        command = [TRAINER, "serve", "--store", str(store), "--bind", "127.0.0.1:0"]
        processes.append(subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT))
    try:
        url = address(log, processes[0])
        token = (store / "token").read_text().strip()
        with log.open("a") as out:
            command = [TRAINER, "worker", "join", url, "--token-file", str(store / "token")]
            processes.append(subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=store.parent))
        with stride.connect(url, token=token) as server:
            yield server
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(60)


def address(log: Path, process: subprocess.Popen[bytes]) -> str:
    """The address that a server has printed."""
    until = time.monotonic() + 60
    while time.monotonic() < until and process.poll() is None:
        if found := re.search(r"https?://127\.0\.0\.1:\d+", log.read_text()):
            return found.group()
        time.sleep(0.1)
    raise AssertionError(f"the server does not listen: {log.read_text()}")


@pytest.fixture(scope="session")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pipeline") / "tiny.yaml"
    path.write_text(PIPELINE)
    return path
