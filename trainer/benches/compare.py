"""Samples per second of trainings, and milliseconds of a sample, beside PyTorch. See compare.sh.

Each row alternates between the programs for several rounds and takes medians. A stage of Stride starts in a copy of a
store that has its inputs; its time is the stage's own by the wall, checkpoints and start included. With two workers
PyTorch has the better of one process with two threads and two processes with gloo.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("STRIDE_SHARED", ROOT.parent / "shared")).resolve()
TORCH = SHARED / "bench" / "pytorch" / "bench.py"
TRAINER = Path(os.environ["STRIDE_TRAINER"]).resolve()


@dataclass
class Training:
    """A stage, and the case of the PyTorch program with the same network and step."""

    name: str
    stage: str
    case: str
    batch: int
    """Steps a second of one worker, for the length of a measurement."""
    pace: float
    settings: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)


@dataclass
class Size:
    config: str
    """Steps of the stages before, which are inputs here."""
    short: list[str]
    trainings: list[Training]
    samplings: list[tuple[str, str, int, str]]


SHORT = ["stages.vae.steps=60", "stages.vae.warmup=5", "stages.mld.steps=60", "stages.mld.warmup=5"]
QUICKSTART = Size(
    "configs/quickstart.yaml",
    SHORT,
    [
        Training("VAE, windows", "vae", "vae_windows_quickstart", 16, 30, ["stages.vae.windows.until=1", "stages.vae.loss.joint_from=0.999"]),
        Training("VAE, clips with joints and feet", "vae", "vae_lengths_quickstart", 8, 30, ["stages.vae.windows.until=0", "stages.vae.loss.joint_from=0"], {"PTBENCH_FEET": "3"}),
        Training("MLD teacher", "mld", "denoiser_quickstart", 32, 36),
        Training("LCM", "lcm", "lcm_quickstart", 32, 16),
        Training("PCM with discriminator", "pcm", "pcm_quickstart", 32, 9),
    ],
    [
        ("teacher, 50 steps with guidance", "mld", 50, "sample50_quickstart"),
        ("teacher, 1 step with guidance", "mld", 1, "sample1_quickstart"),
        ("PCM student, 1 step", "pcm", 1, "sample1_student_quickstart"),
    ],
)
PUBLISHED = Size(
    "configs/motionpcm.yaml",
    SHORT,
    [
        Training("MLD teacher", "mld", "denoiser", 64, 1.5),
        Training("PCM with discriminator", "pcm", "pcm", 128, 0.2),
    ],
    [],
)
SIZES = {"quickstart": QUICKSTART, "published": PUBLISHED}


def run(command: list[str], **more: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **more}, cwd=ROOT)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return done.stdout


def stride(size: Size, store: Path, workers: int, until: str, settings: list[str]) -> dict[str, object]:
    command = [str(TRAINER), "run", size.config, "--store", str(store), "--workers", str(workers), "--until", until, "-o", "json"]
    for setting in settings:
        command += ["--set", setting]
    view = json.loads(run(command))
    return next(stage for stage in view["stages"] if stage["name"] == until)


def trained(size: Size, base: Path, training: Training, workers: int, seconds: float) -> float:
    """Samples per second of a stage, whose inputs are in `base`."""
    steps = max(20, round(training.pace * seconds * (1.5 if workers > 1 else 1)))
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        if training.stage == "vae":
            settings = [*training.settings, f"stages.vae.steps={steps}", "stages.vae.warmup=5"]
        else:
            shutil.copytree(base, store)
            key = f"stages.{training.stage}.steps="
            settings = [*(setting for setting in size.short if not setting.startswith(key)), f"{key}{steps}"]
        stage = stride(size, store, workers, training.stage, settings)
    if stage["state"] != "ran":
        sys.exit(f"{training.name}: the stage is {stage['state']}; expected it to run")
    return steps * training.batch / float(stage["wall_s"])


def apart(size: Size, base: Path, training: Training, seconds: float) -> float:
    """Samples per second of two runs of one worker each, at the same time: what the machine gives at most."""
    with ThreadPoolExecutor(2) as both:
        runs = [both.submit(trained, size, base, training, 1, seconds) for _ in range(2)]
        return sum(run.result() for run in runs)


def torch(case: str, seconds: float, *options: str, **more: str) -> dict[str, float]:
    command = [sys.executable, str(TORCH), case, "--seconds", str(seconds), *options]
    return json.loads(run(command, **more).strip().splitlines()[-1])


def rates(training: Training, seconds: float, kernels: str, options: list[str]) -> float:
    options = [*options, "--mkl", kernels, *(["--batch", str(training.batch)] if "denoiser" in training.case else [])]
    return torch(training.case, seconds, *options, **training.environment)["samples_per_s"]


def processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}"


def table(heads: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def trainings(size: Size, base: Path, seconds: float, rounds: int) -> str:
    rows = []
    for training in size.trainings:
        found: dict[str, list[float]] = {}
        for _ in range(rounds):
            for workers in (1, 2):
                found.setdefault(f"stride {workers}", []).append(trained(size, base, training, workers, seconds))
                ways = [["--threads", "1"]] if workers == 1 else [["--threads", "2"], ["--threads", "1", "--ddp", "2"]]
                for kernels in ("fast", "stock"):
                    best = max(rates(training, seconds, kernels, way) for way in ways)
                    found.setdefault(f"{kernels} {workers}", []).append(best)
            found.setdefault("apart", []).append(apart(size, base, training, seconds))
        at = {name: statistics.median(values) for name, values in found.items()}
        cells = [f"{at[name]:.0f}" for name in ("stride 1", "fast 1", "stock 1", "stride 2", "fast 2", "stock 2")]
        ratios = [at["stride 1"] / at["fast 1"], at["stride 2"] / at["fast 2"], at["stride 2"] / at["apart"]]
        rows.append([training.name, *cells, *(f"{ratio:.2f}" for ratio in ratios)])
        print(rows[-1], flush=True)
    heads = ["", "Stride 1", "tuned 1", "stock 1", "Stride 2", "tuned 2", "stock 2", "of tuned 1", "of tuned 2", "scaling"]
    return table(heads, rows)


def samplings(size: Size, base: Path, seconds: float) -> str:
    rows = []
    settings = [*size.short, "stages.pcm.steps=20", "stages.pcm.warmup=5"]
    stride(size, base, 2, "pcm", settings)
    for name, stage, steps, case in size.samplings:
        command = [str(TRAINER), "time", "--stage", stage, "--store", str(base), "--steps", str(steps), "--guidance", "3", "--frames", "120", "-o", "json"]
        own = json.loads(run(command, RAYON_NUM_THREADS="1"))["rows"][0]["median_s"] * 1e3
        theirs = [torch(case, seconds, "--threads", "1", "--mkl", kernels)["median_ms"] for kernels in ("fast", "stock")]
        rows.append([name, f"{own:.2f}", *(f"{value:.2f}" for value in theirs), f"{theirs[0] / own:.2f}"])
        print(rows[-1], flush=True)
    return table(["milliseconds, one thread", "Stride", "tuned", "stock", "times faster than tuned"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trainings and samplers beside PyTorch.")
    parser.add_argument("--sizes", choices=SIZES, default="quickstart")
    parser.add_argument("--seconds", type=float, default=10, help="length of one measurement")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--write", type=Path, help="write the tables to this file")
    asked = parser.parse_args()
    size = SIZES[asked.sizes]
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        stride(size, base, 2, "mld", size.short)
        text = trainings(size, base, asked.seconds, asked.rounds)
        if size.samplings:
            text += "\n\n" + samplings(size, base, asked.seconds)
    version = run([str(TRAINER), "--version"]).splitlines()[0]
    import torch as framework

    text = (
        f"# Performance\n\n`trainer/benches/compare.sh` made this page: {version}, PyTorch {framework.__version__}, {processor()}, {time.strftime('%Y-%m-%d')}. "
        f"The load before was {before:.1f}.\n\n"
        f"Samples per second of `{size.config}` by the wall, medians of {asked.rounds} rounds of {asked.seconds:.0f} s; the programs alternate. "
        '"Tuned" is PyTorch with the fastest kernels of MKL and settings of glibc, "stock" as pip installs it. '
        "With two workers PyTorch has the better of two threads and two processes (gloo). "
        '"Scaling" is the share of what two runs of one worker give together at the same time.\n\n'
        f"{text}\n"
    )
    print(text)
    if asked.write:
        asked.write.write_text(text)


if __name__ == "__main__":
    main()
