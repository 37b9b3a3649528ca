"""Samples per second of trainings, milliseconds of a sample, and peak memory, beside PyTorch. See compare.sh.

Each row alternates between the programs for several rounds and takes medians. A stage of Stride starts in a copy of a
store that has its inputs. A step's time is the median that the stage's log names, as PyTorch's is the median of the
program's own rounds: start and checkpoints do not count on either side. With two workers PyTorch has the better of one
process with two threads and two processes with gloo.

Memory is the largest resident set of a process.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("STRIDE_SHARED", ROOT.parent / "shared")).resolve()
BENCH = SHARED / "bench" / "pytorch" / "bench.py"
KINDS = ROOT / "trainer" / "benches" / "torch_kinds.py"
TRAINER = Path(os.environ["STRIDE_TRAINER"]).resolve()


@dataclass
class Training:
    """A stage, and the case of a PyTorch program with the same network and step."""

    name: str
    stage: str
    case: str
    batch: int
    """Steps a second of one worker, for the length of a measurement."""
    pace: float
    settings: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    program: Path = BENCH


@dataclass
class Size:
    config: str
    """Settings that make the stages before short; they are inputs here."""
    short: list[str]
    """The last stages of what all measured stages need."""
    needs: list[str]
    trainings: list[Training]
    samplings: list[tuple[str, str, int, str]] = field(default_factory=list)


SHORT = ["stages.vae.steps=60", "stages.vae.warmup=5", "stages.mld.steps=60", "stages.mld.warmup=5"]
WINDOWS = ["stages.vae.windows.until=1", "stages.vae.loss.joint_from=0.999"]
CLIPS = ["stages.vae.windows.until=0", "stages.vae.loss.joint_from=0"]
QUICKSTART = Size(
    "configs/quickstart.yaml",
    SHORT,
    ["mld"],
    [
        Training("VAE, windows", "vae", "vae_windows_quickstart", 16, 30, WINDOWS),
        Training("VAE, clips with joints and feet", "vae", "vae_lengths_quickstart", 8, 30, CLIPS, {"PTBENCH_FEET": "3"}),
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


def kind(name: str, stage: str, case: str, batch: int, pace: float, *settings: str) -> Training:
    return Training(name, stage, case, batch, pace, list(settings), program=KINDS)


OTHERS = Size(
    "trainer/benches/kinds.yaml",
    [],
    ["lcm", "discord", "flat_tokens", "tokens", "text"],
    [
        kind("control", "control", "control_small", 16, 10),
        kind("evaluator, movements", "evaluator", "movements_small", 32, 60, "stages.evaluator.movement.until={all_but_one}"),
        kind("evaluator, matching", "evaluator", "matching_small", 64, 5, "stages.evaluator.movement.until={one}"),
        kind("MDM", "mdm", "mdm_small", 8, 18),
        kind("StableMoFusion", "stablemofusion", "stablemofusion_small", 8, 14),
        kind("tokenizer of MoMask", "tokenizer", "tokenizer_small", 32, 12),
        kind("MoMask, both networks", "momask", "momask_small", 32, 10),
        kind("T2M-GPT", "t2mgpt", "t2mgpt_small", 32, 12),
        kind("MMM", "mmm", "mmm_small", 32, 14),
        kind("DisCoRD's flow", "discord", "flow_small", 16, 18),
        kind("its student of two steps", "jumps", "flow_student_small", 16, 8),
    ],
)


@dataclass
class Published:
    """A stage of a published recipe with batches of eight in one slice."""

    name: str
    config: str
    stage: str
    case: str
    program: Path = KINDS
    settings: list[str] = field(default_factory=list)


PUBLISHED = [
    Published("VAE, clips with joints", "configs/motionpcm.yaml", "vae", "vae_lengths", BENCH, ["stages.vae.loss.joint_from=0"]),
    Published("MLD teacher", "configs/motionpcm.yaml", "mld", "denoiser", BENCH),
    Published("LCM", "configs/motionlcm-v2.yaml", "lcm", "lcm", BENCH),
    Published("PCM with discriminator", "configs/motionpcm.yaml", "pcm1", "pcm", BENCH),
    Published("control", "configs/motionlcm-control-temporal.yaml", "control", "control"),
    Published("evaluator, movements", "configs/momask-discord.yaml", "evaluator", "movements", KINDS, ["stages.evaluator.movement.until={all_but_one}"]),
    Published("evaluator, matching", "configs/momask-discord.yaml", "evaluator", "matching", KINDS, ["stages.evaluator.movement.until={one}"]),
    Published("MDM", "configs/free-mdm.yaml", "mdm", "mdm"),
    Published("StableMoFusion", "configs/free-stablemofusion.yaml", "stablemofusion", "stablemofusion"),
    Published("tokenizer of MoMask", "configs/momask-discord.yaml", "tokenizer", "tokenizer"),
    Published("MoMask, both networks", "configs/momask-discord.yaml", "momask", "momask"),
    Published("T2M-GPT", "configs/t2mgpt-discord.yaml", "t2mgpt", "t2mgpt"),
    Published("MMM", "configs/mmm-discord.yaml", "mmm", "mmm"),
    Published("DisCoRD's flow", "configs/momask-discord.yaml", "discord", "flow"),
]
PUBLISHED_BATCH = 8


@dataclass
class Ended:
    """A command that has ended."""

    status: int
    output: str
    errors: str
    """The largest resident set of its processes in GB."""
    memory: float


def ended(command: list[str], **more: str) -> Ended:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(command, stdout=out, stderr=err, env={**os.environ, **more}, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
    return Ended(status, texts[0], texts[1], usage.ru_maxrss / 1e6)


def measured(command: list[str], **more: str) -> tuple[str, float]:
    """The output of a command that succeeds, and its memory."""
    end = ended(command, **more)
    if end.status != 0:
        sys.exit(f"{' '.join(command)}\n{end.output[-2000:]}\n{end.errors[-2000:]}")
    return end.output, end.memory


def run(command: list[str], **more: str) -> str:
    return measured(command, **more)[0]


def stride(config: str, store: Path, workers: int, until: str, settings: list[str]) -> tuple[dict[str, object], float]:
    command = [str(TRAINER), "run", config, "--store", str(store), "--workers", str(workers), "--until", until, "-o", "json"]
    for setting in settings:
        command += ["--set", setting]
    text, memory = measured(command)
    return next(stage for stage in json.loads(text)["stages"] if stage["name"] == until), memory


def with_steps(settings: list[str], stage: str, steps: int) -> list[str]:
    """Settings in which `stage` makes `steps` steps; `{one}` in a setting is the share of one of them."""
    own = (f"stages.{stage}.steps=", f"stages.{stage}.warmup=")
    shares = {"{one}": 1 / steps, "{all_but_one}": 1 - 1 / steps}
    kept = [setting for setting in settings if not setting.startswith(own)]
    for name, share in shares.items():
        kept = [setting.replace(name, f"{share:.6f}") for setting in kept]
    return [*kept, f"{own[0]}{steps}", f"{own[1]}{min(5, steps - 1)}"]


def must_have_run(stage: dict[str, object], what: str) -> None:
    if stage["state"] != "ran":
        sys.exit(f"{what}: the stage is {stage['state']}; expected it to run")


def logged(store: Path, stage: str) -> tuple[float, str, str]:
    """Median seconds of a step of the last run, the share of its matrix products in percent, and their rate in billions of
    operations a second, as the stage's log has them."""
    lines = run([str(TRAINER), "logs", "@last", "--store", str(store), "--stage", stage])
    steps = re.findall(r", ([0-9.]+) s a step", lines)
    products = re.findall(r"matrix products took ([0-9]+) % of its computation, at ([0-9]+) billion", lines)
    if not steps or not products:
        sys.exit(f"{stage}: its log has no time of a step or of products; expected both in its last lines")
    return float(steps[-1]), *products[-1]


def trained(size: Size, base: Path, training: Training, workers: int, seconds: float) -> float:
    """Samples per second of a stage, whose inputs are in `base`."""
    steps = max(20, round(training.pace * seconds * (1.5 if workers > 1 else 1)))
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        shutil.copytree(base, store)
        settings = with_steps([*size.short, *training.settings], training.stage, steps)
        stage, _ = stride(size.config, store, workers, training.stage, settings)
        must_have_run(stage, training.name)
        return training.batch / logged(store, training.stage)[0]


def apart(size: Size, base: Path, training: Training, seconds: float) -> float:
    """Samples per second of two runs of one worker each, at the same time: what the machine gives at most."""
    with ThreadPoolExecutor(2) as both:
        runs = [both.submit(trained, size, base, training, 1, seconds) for _ in range(2)]
        return sum(run.result() for run in runs)


def torch(program: Path, case: str, seconds: float, *options: str, **more: str) -> tuple[dict, float]:
    command = [sys.executable, str(program), case, "--seconds", str(seconds), *options]
    end = ended(command, **more)
    # Two processes sometimes abort after the result, when they take their group apart.
    lines = [line for line in end.output.splitlines() if line.startswith("{")]
    if not lines:
        sys.exit(f"{' '.join(command)}\n{end.errors[-2000:]}")
    return json.loads(lines[-1]), end.memory


def rates(training: Training, seconds: float, kernels: str, options: list[str]) -> float:
    options = [*options, "--mkl", kernels, *(["--batch", str(training.batch)] if "denoiser" in training.case else [])]
    return torch(training.program, training.case, seconds, *options, **training.environment)[0]["samples_per_s"]


def check(name: str, config: str, stage: str, settings: list[str], found: dict) -> None:
    """Ends the program if the two networks differ in their number of parameters."""
    command = [str(TRAINER), "plan", config, "-o", "json"]
    # The few updates of a plan need both phases of an evaluator.
    for setting in (setting for setting in settings if "movement.until" not in setting):
        command += ["--set", setting]
    # A plan counts the stages that it reached in its time.
    own = None
    for _ in range(5):
        own = own or next(row["parameters"] for row in json.loads(run(command))["stages"] if row["stage"] == stage)
    theirs = sum(found["params"].values())
    # The decoder of movements is not a part of the evaluator.
    if own != theirs and "movements" not in name:
        sys.exit(f"{name}: {own} parameters here, {theirs} in PyTorch; expected the same networks")


def processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}"


def table(heads: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def trainings(size: Size, base: Path, seconds: float, rounds: int) -> list[list[str]]:
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
    return rows


def samplings(size: Size, base: Path, seconds: float) -> str:
    rows = []
    stride(size.config, base, 2, "pcm", with_steps(size.short, "pcm", 20))
    for name, stage, steps, case in size.samplings:
        command = [str(TRAINER), "time", "--stage", stage, "--store", str(base), "--steps", str(steps), "--guidance", "3", "--frames", "120", "-o", "json"]
        own = json.loads(run(command, RAYON_NUM_THREADS="1"))["rows"][0]["median_s"] * 1e3
        theirs = [torch(BENCH, case, seconds, "--threads", "1", "--mkl", kernels)[0]["median_ms"] for kernels in ("fast", "stock")]
        rows.append([name, f"{own:.2f}", *(f"{value:.2f}" for value in theirs), f"{theirs[0] / own:.2f}"])
        print(rows[-1], flush=True)
    return table(["milliseconds, one thread", "Stride", "tuned", "stock", "times faster than tuned"], rows)


def small(asked: argparse.Namespace) -> str:
    """Trainings of every kind and samplers, at the quickstart's size."""
    rows, sampled = [], ""
    for training in OTHERS.trainings:
        settings = with_steps([*OTHERS.short, *training.settings], training.stage, 20)
        check(training.name, OTHERS.config, training.stage, settings, torch(KINDS, training.case, 0.1)[0])
    for size in (QUICKSTART, OTHERS):
        with tempfile.TemporaryDirectory() as folder:
            base = Path(folder) / "base"
            for until in size.needs:
                stride(size.config, base, 2, until, size.short)
            rows += trainings(size, base, asked.seconds, asked.rounds)
            if size.samplings:
                sampled = samplings(size, base, asked.seconds)
    heads = ["samples per second", "Stride 1", "tuned 1", "stock 1", "Stride 2", "tuned 2", "stock 2", "of tuned 1", "of tuned 2", "scaling"]
    return f"{table(heads, rows)}\n\n{sampled}"


def recipe(published: Published) -> list[str]:
    """Settings that train a recipe on procedural clips, one slice of eight clips an update."""
    lines = [line for line in (ROOT / published.config).read_text().splitlines() if not line.strip().startswith("#")]
    data = "dataset" if any(line.startswith("dataset:") for line in lines) else "stages.dataset"
    made = "format: synthetic" if data == "dataset" else "kind: data.synthetic"
    settings = ["text={encoder: hashed}", f"{data}={{{made}, clips: 40, val: 0.1, test: 0.2}}"]
    name = ""
    for line in lines:
        if line.startswith("  ") and not line.startswith("   ") and ":" in line:
            name = line.strip().split(":")[0]
        if "kind: import.evaluator" in line:
            batch = f"batch: {{global: {PUBLISHED_BATCH}, slices: 1}}, movement: {{batch: {PUBLISHED_BATCH}}}"
            settings.append(f"stages.{name}={{kind: train.evaluator, steps: 2, warmup: 0, {batch}}}")
        if "text_relu: true" in line:
            settings.append(f"stages.{name}.text_relu=false")
        if "kind: train." in line or "kind: distill." in line:
            settings += [f"stages.{name}.steps=2", f"stages.{name}.warmup=0", f"stages.{name}.batch={{global: {PUBLISHED_BATCH}, slices: 1}}"]
            settings += [f"stages.{name}.movement.batch={PUBLISHED_BATCH}"] if "train.evaluator" in line else []
            settings += [f"stages.{name}.windows.batch={PUBLISHED_BATCH}"] if "train.vae" in line else []
    # A setting of the row comes last, because one above replaces whole stages.
    return [*settings, *published.settings]


def published(rounds: int) -> Iterator[str]:
    """One worker at published widths: updates and memory. Each table has one more row."""
    few, many = 2, 9
    rows = []
    for case in PUBLISHED:
        settings = recipe(case)
        batch = ("--batch", str(PUBLISHED_BATCH))
        own, theirs, memory = [], [], [0.0, 0.0]
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as folder:
                store = Path(folder)
                # The first run makes the inputs, whose peaks do not count.
                for steps in (few, many):
                    stage, peak = stride(case.config, store, 1, case.stage, with_steps(settings, case.stage, steps))
                must_have_run(stage, case.name)
                step, *products = logged(store, case.stage)
                own.append(step)
                memory[0] = max(memory[0], peak)
            line, peak = torch(case.program, case.case, 5, "--threads", "1", *batch)
            if case.program == KINDS:
                check(case.name, case.config, case.stage, with_steps(settings, case.stage, few), line)
            theirs.append(line["step_ms"] / 1e3)
            memory[1] = max(memory[1], peak)
        mine, other = statistics.median(own), statistics.median(theirs)
        rows.append([case.name, f"{mine:.2f}", f"{other:.2f}", f"{other / mine:.2f}", f"{memory[0]:.1f}", f"{memory[1]:.1f}", *products])
        print(rows[-1], flush=True)
        yield table(["published widths, 8 examples", "Stride, s", "tuned, s", "times faster", "Stride, GB", "PyTorch, GB", "products, %", "their rate"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trainings and samplers beside PyTorch.")
    parser.add_argument("--sizes", choices=("quickstart", "published", "all"), default="all")
    parser.add_argument("--seconds", type=float, default=10, help="length of one measurement at the quickstart's size")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", help="measure only rows whose name contains this")
    parser.add_argument("--write", type=Path, help="write the tables to this file")
    asked = parser.parse_args()
    if asked.only:
        for size in (QUICKSTART, OTHERS):
            size.trainings = [training for training in size.trainings if asked.only in training.name]
            size.samplings = [row for row in size.samplings if asked.only in row[0]]
        PUBLISHED[:] = [case for case in PUBLISHED if asked.only in case.name]
    before = os.getloadavg()[0]
    version = run([str(TRAINER), "--version"]).splitlines()[0]
    import torch as framework

    head = (
        f"# Performance\n\n`trainer/benches/compare.sh` made this page: {version}, PyTorch {framework.__version__}, {processor()}, {time.strftime('%Y-%m-%d')}. "
        f"The load before was {before:.1f}.\n\n"
    )

    def page(*parts: str) -> str:
        return head + "\n\n".join(parts) + "\n"

    def save(*parts: str) -> None:
        """Writes what is known so far, since all of it takes hours."""
        if asked.write:
            asked.write.write_text(page(*parts))

    parts = []
    if asked.sizes != "published":
        parts.append(
            f"## The quickstart's size\n\nBy the wall, from the median time of a step in {asked.rounds} x {asked.seconds:.0f} s; the programs alternate. "
            "Start and checkpoints do not count on either side. "
            '"Tuned" is PyTorch with the fastest kernels of MKL and settings of glibc, "stock" as pip installs it. '
            "Beside two workers, PyTorch has the better of two threads and two processes (gloo). "
            '"Scaling" compares two workers with two runs of one worker at the same time.\n\n' + small(asked)
        )
        save(*parts)
    if asked.sizes != "quickstart":
        what = (
            "## Published widths\n\nOne worker and one thread, an update of eight examples in one slice. "
            "Memory is the largest resident set of a process. The share of Stride's matrix products is of computation, their rate in "
            "billions of operations a second.\n\n"
        )
        rows = ""
        for rows in published(asked.rounds):
            save(*parts, what + rows)
        parts.append(what + rows)
    print(page(*parts))


if __name__ == "__main__":
    main()
