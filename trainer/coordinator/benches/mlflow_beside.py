"""Stride and MLflow with SQLite side by side, each as a server of its own with one client; run by `mlflow.sh`.

Each measurement is made of both in turns, so that other load of the machine meets both; medians are printed. Runs, batches and keys are
alike. Stride's values come by the calls that workers make, MLflow's by `log_batch`. A worker is a program in Rust, so its messages are
made before the time is taken, as are MLflow's lists of values. Those that only make the curve longer are put into MLflow's database. Stride's versions are rows that are put into its database before the server starts, since a version is
otherwise the result of a training; `cargo bench -p registry --bench versions` registers versions.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import platform
import re
import socket
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

POINTS = int(os.environ.get("POINTS", "200000"))
CURVE = int(os.environ.get("CURVE", "1000000"))
RUNS = int(os.environ.get("RUNS", "1000"))
VERSIONS = int(os.environ.get("VERSIONS", "200"))
ROUNDS = int(os.environ.get("ROUNDS", "5"))
BATCH = 1000
"""Values of one call; MLflow takes no more."""
BUCKETS = 800
LISTED = 50
PAGE = 500
"""Runs of Stride's largest page."""
SECRET = "the-secret-of-a-worker-of-the-bench"

PIPELINE = "name: beside\nseed: 1\ndataset: {format: synthetic}\nstages: {vae: {kind: train.vae}}\n"


def value(step: int) -> float:
    return 1.0 / (1 + step) + (step * 2654435761 % 1000) / 1e6


def cpu() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(os.sched_getaffinity(0))} x {names[0] if names else platform.processor()}"


class Stride:
    """The server of `examples/serve.rs` with one run under way, whose worker is this process."""

    def __init__(self, folder: Path) -> None:
        self.store = folder / "stride"
        self.pipeline = folder / "beside.yaml"
        self.pipeline.write_text(PIPELINE)
        self.start()
        self.stop()
        self.add_versions()
        self.body = {"pipeline": self.start(), "source": PIPELINE, "until": None}
        self.run = self.submit("first")
        join: dict = {"protocol": 0, "worker": "bench", "pid": 1, "backend": "flex", "instruction_set": "any", "peer_address": "a:1"}
        join["code_versions"] = {}
        answer = self.call("POST", "/v1/workers", join, SECRET, check=False)
        # Refusals name the versions that are expected, those of kinds a few at a time.
        for _ in range(20):
            if not answer.is_error:
                break
            said = answer.json()["detail"] + (answer.json().get("hint") or "")
            if kinds := re.findall(r"`([\w.]+)` \d+ instead of (\d+)", said):
                join["code_versions"] |= {kind: int(version) for kind, version in kinds}
            else:
                join["protocol"] = int(re.findall(r"\d+", said)[-1])
            answer = self.call("POST", "/v1/workers", join, SECRET, check=False)
        self.incarnation = answer.json()["incarnation"]
        while not (found := self.poll()["assignments"]):
            time.sleep(0.1)
        self.grant, self.secret = found[0]["grant"], found[0]["secret"]
        self.ended = threading.Event()
        threading.Thread(target=self.live, daemon=True).start()

    def live(self) -> None:
        """Polls, so that the lease lasts."""
        while not self.ended.wait(3):
            self.poll()

    def start(self) -> Any:
        """Starts the server and returns the pipeline as JSON."""
        command = [os.environ["STRIDE_SERVE"], str(self.store), str(self.pipeline)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        pipeline, url, token = (self.process.stdout.readline().strip() for _ in range(3))
        if not token:
            raise SystemExit("the server did not start")
        self.http = httpx.Client(base_url=url, headers={"authorization": f"Bearer {token}"}, timeout=300)
        return json.loads(pipeline)

    def stop(self) -> None:
        self.http.close()
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(60)

    def add_versions(self) -> None:
        with sqlite3.connect(self.store / "stride.db") as database:
            database.execute("INSERT INTO models (model, metric, mode, at_ms) VALUES ('beside', 'fid', 'min', 1)")
            database.execute("INSERT INTO model_owners VALUES ('beside', ?)", (json.dumps({"name": "bench"}),))
            rows = [
                ("beside", number, f"sha256:{number:064x}", json.dumps({"fid": value(number)}), json.dumps({"run": "r", "stage": "s"}), number)
                for number in range(1, VERSIONS + 1)
            ]
            database.executemany("INSERT INTO versions VALUES (?, ?, ?, ?, ?, ?)", rows)

    def call(self, method: str, path: str, body: object = None, secret: str | None = None, check: bool = True) -> httpx.Response:
        headers = {"x-stride-secret": secret} if secret else {}
        answer = self.http.request(method, path, json=body, headers=headers)
        if check and answer.is_error:
            raise SystemExit(f"{path}: {answer.status_code} {answer.text}")
        return answer

    def submit(self, key: str) -> str:
        return str(self.call("POST", "/v1/runs", {**self.body, "idempotency_key": key}).json()["run"])

    def poll(self) -> Any:
        doing = []
        if grant := getattr(self, "grant", None):
            doing = [{"grant": grant, "progress": {"done": 0, "total": 1, "unit": "steps", "metrics": {}}, "holds": None, "waits_for": None, "lost": []}]
        body = {"incarnation": self.incarnation, "doing": doing, "ready": [], "version": 0}
        return self.call("POST", "/v1/workers/bench/poll", body, SECRET).json()

    def add_run(self, number: int) -> None:
        self.call("POST", f"/v1/runs/{self.submit(str(number))}/cancel")

    def prepared(self, first: int, count: int) -> list[bytes]:
        batches = []
        for begin in range(first, first + count, BATCH):
            rows = [{"step": step, "key": "loss", "value": value(step)} for step in range(begin, begin + BATCH)]
            batches.append(json.dumps({"grant": self.grant, "rows": rows}).encode())
        return batches

    def write(self, batches: list[bytes]) -> None:
        headers = {"x-stride-secret": self.secret, "content-type": "application/json"}
        for batch in batches:
            answer = self.http.post("/v1/metrics", content=batch, headers=headers)
            if answer.is_error:
                raise SystemExit(f"/v1/metrics: {answer.status_code} {answer.text}")

    def whole(self) -> int:
        path = f"/v1/runs/{self.run}/metrics?key=loss&limit=1000000"
        answer = self.http.get(path, headers={"accept": "application/octet-stream"})
        length = int.from_bytes(answer.content[:4], "little")
        return sum(series["rows"] for series in json.loads(answer.content[4 : 4 + length]))

    def curve(self) -> int:
        answer = self.call("GET", f"/v1/metrics?run={self.run}&key=loss&buckets={BUCKETS}")
        return len(answer.content)

    def runs(self) -> int:
        return len(self.call("GET", f"/v1/runs?limit={LISTED}").json()["items"])

    def all_runs(self) -> int:
        """Lists as many runs as were added, in the largest pages."""
        listed, after = 0, ""
        while listed < RUNS:
            page = self.call("GET", f"/v1/runs?limit={min(PAGE, RUNS - listed)}{after}").json()
            listed += len(page["items"])
            after = f"&after={page['next']}"
        return listed

    def versions(self) -> int:
        return len(self.call("POST", "/v1/registry", {"command": "show", "reference": "beside"}).json()["data"]["versions"])


class MLflow:
    """`mlflow server` on SQLite, with its own client."""

    def __init__(self, folder: Path) -> None:
        os.environ.update(MLFLOW_DISABLE_TELEMETRY="true", DO_NOT_TRACK="true", GIT_PYTHON_REFRESH="quiet")
        import mlflow
        from mlflow.entities import Metric

        logging.getLogger("mlflow").setLevel(logging.ERROR)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.metric, self.version, self.url = Metric, mlflow.__version__, f"http://127.0.0.1:{port}"
        self.database = folder / "mlflow.db"
        store = f"sqlite:///{self.database}"
        command = [sys.executable, "-m", "mlflow", "server", "--backend-store-uri", store, "--port", str(port)]
        command += ["--default-artifact-root", str(folder / "artifacts"), "--host", "127.0.0.1"]
        with (folder / "mlflow.log").open("w") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=folder)
        self.http = httpx.Client(base_url=self.url, timeout=300)
        until = time.monotonic() + 240
        while True:
            try:
                if self.http.get("/health").is_success:
                    break
            except httpx.HTTPError:
                pass
            if time.monotonic() > until:
                raise SystemExit((folder / "mlflow.log").read_text())
            time.sleep(0.3)
        self.client = mlflow.MlflowClient(self.url, self.url)
        self.experiment = self.client.create_experiment("beside")
        self.run = self.client.create_run(self.experiment).info.run_id
        self.client.create_registered_model("beside")

    def stop(self) -> None:
        self.http.close()
        self.process.terminate()
        self.process.wait(60)

    def add_run(self, number: int) -> None:
        run = self.client.create_run(self.experiment, run_name=f"run-{number}").info.run_id
        # It prints the address of each run.
        with contextlib.redirect_stdout(io.StringIO()):
            self.client.set_terminated(run, "KILLED")

    def add_version(self, number: int) -> None:
        self.client.create_model_version("beside", f"s3://nowhere/{number}")

    def prepared(self, first: int, count: int) -> list[list[Any]]:
        begins = range(first, first + count, BATCH)
        return [[self.metric("loss", value(step), 1000 + step, step) for step in range(begin, begin + BATCH)] for begin in begins]

    def write(self, batches: list[list[Any]]) -> None:
        for rows in batches:
            self.client.log_batch(self.run, metrics=rows)

    def lengthen(self, first: int, count: int) -> None:
        """Puts values into the database, for their way through the server takes minutes."""
        add = "INSERT INTO metrics (key, value, timestamp, run_uuid, step, is_nan) VALUES ('loss', ?, ?, ?, ?, 0)"
        with sqlite3.connect(self.database, timeout=60) as database:
            database.executemany(add, ((value(step), 1000 + step, self.run, step) for step in range(first, first + count)))

    def whole(self) -> int:
        return len(self.client.get_metric_history(self.run, "loss"))

    def curve(self) -> int:
        query = {"run_ids": self.run, "metric_key": "loss", "max_results": str(BUCKETS)}
        return len(self.http.get("/ajax-api/2.0/mlflow/metrics/get-history-bulk-interval", params=query).raise_for_status().content)

    def runs(self) -> int:
        return self.listed(LISTED)

    def all_runs(self) -> int:
        return self.listed(RUNS)

    def listed(self, count: int) -> int:
        return len(self.client.search_runs([self.experiment], max_results=count, order_by=["start_time DESC"]))

    def versions(self) -> int:
        return len(self.client.search_model_versions("name = 'beside'", max_results=VERSIONS))


def timed(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours, theirs = Stride(folder), MLflow(folder)
        try:
            measure(ours, theirs)
        finally:
            ours.ended.set()
            ours.stop()
            theirs.stop()


def measure(ours: Stride, theirs: MLflow) -> None:
    print(f"Stride and MLflow {theirs.version} on SQLite, Python {platform.python_version()}, {cpu()}", flush=True)
    print(f"{POINTS:,} values written, {RUNS:,} runs, {VERSIONS:,} versions; medians of {ROUNDS} in turns", flush=True)
    print(f"{'':34}{'Stride':>12}{'MLflow':>12}{'ratio':>8}", flush=True)
    part = POINTS // ROUNDS // BATCH * BATCH
    total = part * ROUNDS
    writes = []
    for turn in range(ROUNDS):
        mine, other = ours.prepared(turn * part, part), theirs.prepared(turn * part, part)
        writes.append((timed(lambda: ours.write(mine)), timed(lambda: theirs.write(other))))
    seconds = [statistics.median(side) for side in zip(*writes)]
    print(f"{'values stored a second':34}{part / seconds[0]:12,.0f}{part / seconds[1]:12,.0f}{seconds[1] / seconds[0]:8.1f}", flush=True)
    compare(f"each value of {total:,}, ms", ours.whole, theirs.whole, same=total)
    if CURVE > total:
        ours.write(ours.prepared(total, CURVE - total))
        theirs.lengthen(total, CURVE - total)
    compare(f"curve of {max(CURVE, total):,} in {BUCKETS} parts, ms", ours.curve, theirs.curve)
    for number in range(RUNS):
        ours.add_run(number)
        theirs.add_run(number)
    compare(f"{LISTED} of {RUNS:,} runs, ms", ours.runs, theirs.runs, same=LISTED)
    compare(f"all {RUNS:,} runs, ms", ours.all_runs, theirs.all_runs, same=RUNS)
    added = VERSIONS / timed(lambda: [theirs.add_version(number) for number in range(VERSIONS)])
    print(f"{'versions registered a second':34}{'':12}{added:12,.0f}", flush=True)
    compare(f"{VERSIONS} versions of a model, ms", ours.versions, theirs.versions, same=VERSIONS)


def compare(title: str, mine: Callable[[], int], other: Callable[[], int], same: int | None = None) -> None:
    """Prints the median times of two calls. Where `same` is given, both return it."""
    if same is not None:
        assert (mine(), other()) == (same, same), title
    pairs = [(timed(mine), timed(other)) for _ in range(ROUNDS)]
    ours, theirs = (1000 * statistics.median(side) for side in zip(*pairs))
    print(f"{title:34}{ours:12.1f}{theirs:12.1f}{theirs / ours:8.1f}", flush=True)


if __name__ == "__main__":
    main()
