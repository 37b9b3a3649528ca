"""Models of the server's answers, made by `generate.py` from `docs/openapi.json`. Do not edit."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class Answer(BaseModel):
    """Fields that a later server adds are kept."""

    model_config = ConfigDict(extra="allow", frozen=True)


class Drawing(Answer):
    """The answer to [`Draw`]."""

    run: str
    """The run that draws. It has ended when all motions are stored."""
    stages: list[str]
    """Its drawing stages, in the order of the models or checkpoints. The artifact `report` of each has the file `motions.json`, and for motion `NN` the files `motion-NN.npy`, `motion-NN.bvh` and `motion-NN.glb`."""


class GateResult(Answer):
    """Result of a gate."""

    bound: float | None = None
    """The bound it was compared with."""
    gate: str
    """The gate as written."""
    holds: bool
    """True if the gate holds."""
    message: str
    """Description of the result, with the distance from the bound."""
    value: float | None = None
    """The candidate's value."""


class HistoryRow(Answer):
    """An event as stored."""

    actor: str | None = None
    """The token that asked for it."""
    at_ms: int
    """In milliseconds since 1970."""
    attempt: int | None = None
    id: int
    """Grows from row to row."""
    kind: Literal['submitted', 'paused', 'resumed', 'ended', 'joined', 'returned', 'lost', 'left', 'granted', 'regrouped', 'adopted', 'released', 'retried', 'stalled', 'checkpoint', 'finished', 'failed', 'promoted', 'rolled-back']
    model: str | None = None
    run: str | None = None
    stage: str | None = None
    step: int | None = None
    task: str | None = None
    why: str | None = None
    """Reason that the actor gave."""
    worker: str | None = None


class LogRow(Answer):
    """A stored log line."""

    at_ms: int
    """Time of storing, in milliseconds since 1970."""
    attempt: int
    id: int
    """Increasing number; a reader continues after the last one it has seen."""
    line: int
    """Line number within attempt and worker."""
    task: str
    text: str
    worker: str
    """The worker that wrote it."""


class Owner(Answer):
    """The token that submitted a run, as it was then."""

    admin: bool | None = None
    """True if it may control objects of all owners."""
    name: str
    """The token's name; empty for a run of a store that knew no owners."""
    project: str | None = None
    """The token's project."""
    promotes: bool | None = None
    """True if its pipelines may move aliases."""


class Progress(Answer):
    """Progress of a task."""

    done: int
    """Number of steps, clips or shards done."""
    metrics: dict[str, float | None]
    """Newest values, for a progress line."""
    total: int
    """Total number of steps, clips or shards."""
    unit: str
    """Unit of the numbers: `steps`, `clips`, `captions`."""


class Promotion(Answer):
    """One move of an alias."""

    action: Literal['promote', 'rollback']
    """Kind of the move."""
    actor: str
    """Name of the caller."""
    alias: str
    at_ms: int
    """Time of the move, in milliseconds since 1970."""
    from_: int | None = Field(default=None, alias="from")
    """Version before the move, if the alias existed."""
    gates: list[GateResult]
    """Results of the gates."""
    id: int
    """Number of the log entry."""
    model: str
    reason: str
    """Reason given by the caller."""
    to: int
    """Version after the move."""


class RunSettings(Answer):
    """The answer to `GET /v1/runs/{run}/settings`."""

    missing: list[str] | None = None
    """Stages of the previous run that this one does not have."""
    previous: str | None = None
    """The newest earlier run of a pipeline with the same name."""
    run: str
    seed: int
    source: str
    """The pipeline's file as the user wrote it."""
    stages: list[SettingsOfStage]
    """Stages of the pipeline in topological order, without a sweep's trials."""


class RunSummary(Answer):
    """A run in a list: `GET /v1/runs`."""

    changed_ms: int
    """Time of the newest change of its state, in milliseconds since 1970."""
    created_ms: int
    """Time of the submission, in milliseconds since 1970."""
    done: int
    """Number of finished stages."""
    interrupted: bool | None = None
    """It is paused because the process that worked on it ended, not because a user paused it."""
    note: str | None = None
    """The beginning of [`RunView::note`]."""
    owner: str | None = None
    """Name of the token that submitted it, if it is known."""
    pipeline: str
    """The pipeline's name."""
    priority: int | None = None
    """Order among the runs of its group: the highest is served first."""
    project: str | None = None
    """The token's project."""
    queued: bool | None = None
    """It waits until fewer runs of its group are at work."""
    run: str
    stages: int
    """Number of stages that were asked for, without those of sweeps."""
    state: Literal['running', 'paused', 'finished', 'failed', 'cancelled']
    wall_s: float
    """Seconds of work on these stages."""
    wants_workers: int | None = None
    """Idle workers that it lacks, if that is what it waits for."""


class RunView(Answer):
    """A run as clients see it: `GET /v1/runs/{run}`."""

    interrupted: bool | None = None
    """It is paused because the process that worked on it ended, not because a user paused it."""
    note: str | None = None
    """Its standing in a sentence: the reason of a failure or of waiting, or the result."""
    owner: Owner | None = None
    """The token that submitted it."""
    pipeline: str
    """The pipeline's name."""
    priority: int | None = None
    """Order among the runs of its group: the highest is served first."""
    queued: bool | None = None
    """It waits until fewer runs of its group are at work."""
    run: str
    stages: list[StageView]
    """Stages in topological order, then the stages made by sweeps."""
    state: Literal['running', 'paused', 'finished', 'failed', 'cancelled']
    storage: StorageProblem | None = None
    """The storage problem that blocks the run."""
    sweeps: list[SweepView] | None = None
    """Sweeps that have started."""
    times: Times | None = None


class SettingChange(Answer):
    """A setting that differs."""

    from_: Any = Field(alias="from")
    """The value in the previous run; `null` if it has none."""
    path: str
    """Path in the stage's settings, such as `network.width`."""
    to: Any
    """The value now; `null` if there is none."""


class SettingsOfStage(Answer):
    """Settings of one stage."""

    code: int
    """Code version of the kind."""
    from_: str | None = Field(default=None, alias="from")
    """Earlier run that computed the result, unless the caller may not see it."""
    key: str | None = None
    """Key of the stage, once its inputs are known."""
    settings: Any
    """Kind and settings, with all defaults."""
    stage: str
    why: StageReason | None = None
    """Why it was computed, beside the previous run."""


class StageReason(Answer):
    """The reason why a stage was computed."""

    changes: list[SettingChange] | None = None
    """Settings that differ from those of the previous run."""
    inputs: list[str] | None = None
    """Stages that it reads and that differ from those of the previous run."""
    kind: Literal['new', 'changed', 'code', 'seed', 'input', 'same', 'unknown']
    text: str
    """The reason in a few words, such as `lr 2e-4 -> 1e-4`; empty if there is none yet."""


class StageView(Answer):
    """A stage as clients see it."""

    attempt: int
    """Number of the current attempt."""
    copy_of: str | None = None
    """The stage of the pipeline's file that it is a copy of, if the file wants several by `seeds` or folds."""
    instruction_set: str | None = None
    """Instruction set of the workers that computed it, or compute it now; not part of any key."""
    key: str | None = None
    """Key of the stage, once its inputs are known."""
    kind: str
    """Stage kind, such as `train.vae`."""
    message: str | None = None
    """Reason of a failure, or of waiting."""
    metrics: dict[str, float | None]
    """Final values, or the newest ones while it runs."""
    name: str
    needs: list[str] | None = None
    """Stages that it reads."""
    of: str | None = None
    """Swept stage that it belongs to, if a sweep made it."""
    outputs: dict[str, str]
    """Outputs by name."""
    peak_memory: int | None = None
    """Peak resident memory of one of its workers' processes during its newest attempt, in bytes; not part of any key."""
    progress: Progress
    state: Literal['waiting', 'ready', 'running', 'ran', 'cached', 'resumed', 'failed', 'skipped']
    times: Times | None = None
    wall_s: float
    """Seconds of work so far, over all attempts of this run; not part of any key."""
    wants_workers: int | None = None
    """Idle workers that it lacks, if that is what it waits for."""
    workers: list[str]
    """Workers with an assignment of it now."""


class StorageProblem(Answer):
    """Why a store does not take or give what it should."""

    since_ms: int
    """Since when, in milliseconds since 1970."""
    what: str
    """Description of the problem."""


class SweepView(Answer):
    """A sweep as clients see it."""

    best: int | None = None
    """Best trial at the whole budget so far."""
    full: int
    """Number of steps if every trial had the whole budget."""
    metric: str
    """Metric that ranks the trials."""
    mode: Literal['min', 'max']
    """Direction of the metric."""
    over: bool
    """True if no work is in progress or will follow."""
    planned: int
    """Number of steps if no trial fails."""
    rungs: list[int]
    """Steps at which trials are compared; the last is the whole budget."""
    search: Literal['grid', 'random', 'asha']
    """Search method of the sweep."""
    spent: int
    """Number of steps trained so far, for this sweep or an earlier one."""
    stage: str
    """The swept stage."""
    trials: list[TrialView]
    """All trials in the order of their numbers."""


class Times(Answer):
    """Times of a run or a stage by the server's clock, in milliseconds since 1970."""

    created_ms: int | None = None
    """Time of the submission; a stage has none."""
    ended_ms: int | None = None
    """End of the newest attempt at all of it."""
    started_ms: int | None = None
    """Start of the first work."""


class TrialView(Answer):
    """A trial as clients see it."""

    message: str | None = None
    """Reason of a failure."""
    results: list[float | None]
    """Metric after each rung with a result; `None` for a failure."""
    state: Literal['waiting', 'running', 'paused', 'stopped', 'finished', 'failed']
    steps: int
    """Number of steps trained."""
    trial: int
    """Number of the trial, from 0."""
    values: dict[str, Any]
    """Values of the searched settings by path."""


class Version(Answer):
    """A registered artifact. Only its metrics can be extended."""

    aliases: list[str]
    """Aliases that point at this version."""
    artifact: str
    """Digest of a manifest of kind `model`."""
    created_ms: int
    """Time of registration, in milliseconds since 1970."""
    metrics: dict[str, float | None]
    """Metrics by name."""
    model: str
    source: Any
    """Origin: run, stage, stage key."""
    version: int
    """Number of the version, from 1."""
