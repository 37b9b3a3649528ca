"""The client against a server."""

from __future__ import annotations

import html
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import stride

from .conftest import TRAINER

HERE = Path(__file__).parents[1]

MODEL = """\
  latents: {kind: encode.latents, vae: vae}
  mld:
    kind: train.mld
    network: {width: 16, layers: 3, heads: 2, feed_forward: 32}
    steps: 4
    batch: {global: 4, slices: 1}
    lr: 1e-3
    warmup: 2
  fid: {kind: evaluate.latent_fid, model: mld, sampler: {steps: 2, guidance: 3}, repeats: 1, components: 4}
  release: {kind: register, model: tiny, from: [mld], promote: {to: prod}}
"""


@pytest.fixture(scope="session")
def finished(server: stride.Server, pipeline: Path) -> stride.Run:
    run = server.submit(pipeline, key="once")
    assert server.submit(pipeline, key="once").name == run.name
    kinds = [event.kind for event in run.follow()]
    assert kinds[0] == "submitted" and kinds[-1] == "ended", kinds
    assert "checkpoint" in kinds
    assert run.state == "finished", run.view()
    return run


def test_models_are_those_of_the_document() -> None:
    assert subprocess.run([sys.executable, "generate.py", "--check"], cwd=HERE, check=False).returncode == 0


def test_runs_are_listed(server: stride.Server, finished: stride.Run) -> None:
    rows = list(server.runs(state="finished", pipeline="tiny", q="TINY"))
    assert [row.run for row in rows] == [finished.name]
    assert (rows[0].done, rows[0].stages) == (2, 2)
    assert not list(server.runs(state="failed,cancelled"))
    assert list(server.runs(limit=1))[0].run == finished.name


def test_values_are_whole_and_exact(finished: stride.Run, server: stride.Server) -> None:
    loss = finished.metrics("loss")
    assert loss.steps == [1, 2, 3, 4, 5, 6]
    series = loss.to_pandas()
    assert series.index.tolist() == [1, 2, 3, 4, 5, 6] and series.tolist() == loss.values
    shown = server._json("GET", f"/v1/runs/{finished.name}/metrics", params={"stage": "vae", "key": "loss"})
    assert [point["value"] for point in shown["vae"]["loss"]["points"]] == loss.values
    with pytest.raises(stride.StrideError, match="none") as error:
        finished.metrics("none")
    assert error.value.code == "not-found"


def test_logs_are_read(finished: stride.Run) -> None:
    assert any(line.text for line in finished.logs(stage="dataset"))


def test_stages_say_why_they_ran_and_what_memory_they_took(finished: stride.Run) -> None:
    assert finished.why() == {"dataset": "new", "vae": "new"}
    settings = finished.settings()
    assert settings.previous is None and settings.stages[1].settings["steps"] == 6
    memory = finished.view().stages[1].peak_memory
    assert memory is not None and memory > 1 << 20


def test_errors_have_code_and_hint(server: stride.Server) -> None:
    with pytest.raises(stride.StrideError) as error:
        server.run("none").view()
    assert (error.value.code, error.value.status) == ("not-found", 404)
    with pytest.raises(stride.StrideError) as error:
        server.submit({"name": "x"}, key="once")
    assert error.value.code in ("conflict", "invalid")
    with pytest.raises(stride.StrideError) as error:
        list(server.runs(state="broken"))
    assert error.value.code == "invalid" and "broken" in error.value.message
    with pytest.raises(stride.StrideError) as error:
        server.model("none").versions()
    assert error.value.code == "not-found" and error.value.hint
    with pytest.raises(stride.StrideError) as error:
        server.model("none").promote("best", to="prod", reason="a test")
    assert error.value.code == "not-found"
    with pytest.raises(stride.StrideError) as error:
        stride.connect(server.url, token="nothing of the kind")
    assert (error.value.code, error.value.status) == ("unauthorized", 401)
    with pytest.raises(stride.StrideError) as error:
        stride.connect("http://127.0.0.1:9", token="x")
    assert error.value.code == "away"
    assert not server.models()


def test_a_run_is_cancelled(server: stride.Server, finished: stride.Run, pipeline: Path) -> None:
    run = server.submit(pipeline, until="dataset", key="another")
    run.wait()
    assert run.why()["dataset"] == f"cached from {finished.name}"
    with pytest.raises(stride.StrideError) as error:
        run.resume()
    assert error.value.code == "conflict"


def test_tensorboard_reads_what_is_exported(finished: stride.Run, server: stride.Server, store: Path) -> None:
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    out = store.parent / "events"
    token = (store / "token").read_text().strip()
    command = [TRAINER, "metrics", finished.name, "--tensorboard", str(out), "--server", server.url, "--token", token]
    subprocess.run(command, check=True)
    events = event_accumulator.EventAccumulator(str(out / finished.name / "vae"), size_guidance={"scalars": 0})
    events.Reload()
    loss = finished.metrics("loss")
    scalars = events.Scalars("loss")
    assert [scalar.step for scalar in scalars] == loss.steps
    assert [scalar.value for scalar in scalars] == pytest.approx(loss.values, rel=1e-6)
    assert all(abs(scalar.wall_time - time.time()) < 3600 for scalar in scalars)


def test_a_version_draws_motions(server: stride.Server, pipeline: Path) -> None:
    numpy = pytest.importorskip("numpy")
    text = pipeline.read_text()
    model = pipeline.with_name("model.yaml")
    model.write_text(text + MODEL)
    assert server.submit(model).wait().state == "finished"
    version = server.model("tiny@prod")
    motions = version.generate("a person walks", n=4, seconds=2.0, seed=3)
    assert (motions.dtype, motions.shape) == (numpy.float32, (4, 40, 22, 3))
    assert numpy.isfinite(motions).all()
    shown = motions._repr_html_()
    assert shown is not None and shown.startswith("<iframe ") and 'sandbox="allow-scripts"' in shown
    page = html.unescape(shown.split('srcdoc="')[1].rsplit('"', 1)[0])
    assert page.startswith("<!DOCTYPE html>") and "a person walks" in page and "default-src 'none'" in page
    assert server.url not in shown, "a saved notebook needs no server"
    parts: list[Any] = [motions[0], motions * 2.0]
    assert [part._repr_html_() for part in parts] == [None, None]
    assert numpy.array_equal(version.generate("a person walks", seconds=2.0, seed=5), motions[2:3])
    with pytest.raises(stride.StrideError, match="60") as error:
        version.generate("a person walks", seconds=61.0)
    assert error.value.code == "invalid"
    with pytest.raises(stride.StrideError, match="seconds") as error:
        version.generate("a person walks", seconds=59.0)
    assert error.value.code == "failed"


def test_a_missing_package_is_named_with_its_remedy(server: stride.Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numpy", None)
    with pytest.raises(stride.StrideError, match=r"numpy.*stride-client\[pandas\]"):
        server.model("tiny@prod").generate("a person walks")
