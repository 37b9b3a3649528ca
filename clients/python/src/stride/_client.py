"""The client: a server, its runs and its models."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import subprocess
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, cast

import httpx

from ._errors import StrideError
from ._models import Drawing, HistoryRow, LogRow, Promotion, RunSettings, RunSummary, RunView, Version

if TYPE_CHECKING:
    import pandas

    from ._motions import Motions

PACKED = "application/octet-stream"
"""The form of values that keeps each bit of them."""

TRIES = 20
"""Number of tries to reach a busy server."""

WAIT_S = 20
"""Seconds for which a call for events may wait."""

PAGE = 1_000_000
"""Number of values of one call."""


def connect(url: str | None = None, *, token: str | None = None, timeout: float = 60.0) -> Server:
    """Connects to a server.

    Args:
        url: Address of the server; ``STRIDE_SERVER`` by default. Those of a server and its stand-bys are separated by
            commas.
        token: Token to show; by default that of ``STRIDE_TOKEN``, or of the file ``STRIDE_TOKEN_FILE``.
        timeout: Seconds after which a call fails.

    Raises:
        StrideError: There is no address, or the server does not take the token.
    """
    url = url or os.environ.get("STRIDE_SERVER")
    if not url:
        raise StrideError("invalid", "there is no address of a server", "give `url`, or set STRIDE_SERVER")
    if token is None:
        token = os.environ.get("STRIDE_TOKEN")
    if token is None and (path := os.environ.get("STRIDE_TOKEN_FILE")):
        token = Path(path).read_text(encoding="utf-8").strip()
    server = Server(url, token, timeout)
    server._json("GET", "/v1/session")
    return server


class Server:
    """A connection to a server. It may be used by several threads."""

    def __init__(self, url: str, token: str | None, timeout: float) -> None:
        headers = {"authorization": f"Bearer {token}"} if token else {}
        self._urls = [part.strip().rstrip("/") for part in url.split(",")]
        self._http = httpx.Client(headers=headers, timeout=timeout)

    def __enter__(self) -> Server:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Server({self.url!r})"

    @property
    def url(self) -> str:
        """The address that answered last."""
        return self._urls[0]

    def _leave(self, url: str) -> None:
        """Turns to the next address, unless another thread has done so."""
        if url == self._urls[0]:
            self._urls = [*self._urls[1:], url]

    def close(self) -> None:
        """Closes the connection."""
        self._http.close()

    def _call(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str | int] | None = None,
        body: object = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        others = len(self._urls) - 1
        for _ in range(TRIES):
            url = self.url
            try:
                answer = self._http.request(method, url + path, params=params, json=body, headers=headers)
            except httpx.HTTPError as error:
                self._leave(url)
                # Nothing was sent, so the next address may be asked the same.
                if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout) and others > 0:
                    others -= 1
                    continue
                urls = ", ".join(self._urls)
                raise StrideError("away", f"cannot reach {urls}: {error}", "start it with `trainer serve`") from error
            if answer.status_code == 503:
                self._leave(url)
            if answer.status_code != 429:
                break
            time.sleep(min(5.0, float(answer.headers.get("retry-after", "1"))))
        if answer.is_success:
            return answer
        try:
            problem = answer.json()
            code, detail, hint = str(problem["code"]), str(problem["detail"]), problem.get("hint")
        except (ValueError, KeyError, TypeError):
            code, detail, hint = "internal", f"{self.url} answered {answer.status_code}: {answer.text[:200]}", None
        raise StrideError(code, detail, hint, answer.status_code)

    def _json(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str | int] | None = None,
        body: object = None,
        headers: Mapping[str, str] | None = None,
    ) -> Any:
        return self._call(method, path, params=params, body=body, headers=headers).json()

    def _registry(self, command: Mapping[str, object]) -> dict[str, Any]:
        answer = self._json("POST", "/v1/registry", body=command)
        if error := answer.get("error"):
            raise StrideError(error["code"], error["message"], error.get("hint"), 200)
        return cast("dict[str, Any]", answer["data"])

    def submit(
        self,
        pipeline: str | os.PathLike[str] | Mapping[str, object],
        *,
        until: str | None = None,
        key: str | None = None,
        trainer: str | None = None,
    ) -> Run:
        """Submits a pipeline; a submission that is sent twice makes one run.

        Args:
            pipeline: A YAML file, which the program ``trainer`` on this machine reads, or a pipeline as
                ``trainer config show -o json`` prints it.
            until: Last stage to run.
            key: The same key stands for the same submission, also from another process.
            trainer: The program; by default that of ``STRIDE_TRAINER`` or of the search path.
        """
        if isinstance(pipeline, Mapping):
            resolved: object = dict(pipeline)
            source = json.dumps(resolved)
        else:
            source = Path(pipeline).read_text(encoding="utf-8")
            resolved = _resolved(Path(pipeline), trainer)
        body = {"pipeline": resolved, "source": source, "until": until}
        headers = {"idempotency-key": key or str(uuid.uuid4())}
        answer = self._json("POST", "/v1/runs", body=body, headers=headers)
        return self.run(str(answer["run"]))

    def run(self, name: str) -> Run:
        """A run by its whole name."""
        return Run(self, name)

    def runs(
        self,
        *,
        state: str | None = None,
        pipeline: str | None = None,
        owner: str | None = None,
        q: str | None = None,
        sort: str = "newest",
        limit: int | None = None,
    ) -> Iterator[RunSummary]:
        """Runs in short, page by page as they are asked for.

        Args:
            state: States, separated by commas.
            pipeline: Name of the pipeline.
            owner: Name of a token, or ``@`` and a project.
            q: Words of the name, the pipeline, the owner or the note.
            sort: ``newest``, ``oldest`` or ``changed`` first.
            limit: Largest number of runs.
        """
        asked: dict[str, str | int] = {"sort": sort, "limit": min(limit or 200, 200)}
        wanted = {"state": state, "pipeline": pipeline, "owner": owner, "q": q}
        asked.update({name: value for name, value in wanted.items() if value is not None})
        left = limit
        while left is None or left > 0:
            part = self._json("GET", "/v1/runs", params=asked)
            for item in part["items"][: left if left is not None else None]:
                yield RunSummary.model_validate(item)
            left = None if left is None else left - len(part["items"])
            if (after := part.get("next")) is None:
                return
            asked["after"] = after

    def models(self) -> list[Model]:
        """All models of the registry that the token sees."""
        return [Model(self, str(model["model"])) for model in self._registry({"command": "list"})["models"]]

    def model(self, reference: str) -> Model:
        """A model by its name, such as ``m``, or one of its versions: ``m@prod``, ``m@best`` or ``m:3``."""
        return Model(self, reference)

    def _blob(self, digest: str) -> bytes:
        return self._call("GET", f"/v1/blobs/{digest}").content


def _resolved(path: Path, trainer: str | None) -> object:
    program = trainer or os.environ.get("STRIDE_TRAINER") or shutil.which("trainer")
    if program is None:
        hint = "install it, or give `trainer` or STRIDE_TRAINER its place"
        raise StrideError("invalid", "there is no program `trainer` to read the file with", hint)
    command = [program, "config", "show", str(path), "-o", "json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise StrideError("invalid", done.stderr.strip() or f"`{path}` does not read")
    return json.loads(done.stdout)


class Run:
    """A run of a pipeline."""

    def __init__(self, server: Server, name: str) -> None:
        self._server = server
        self.name = name
        self._path = f"/v1/runs/{name}"

    def __repr__(self) -> str:
        return f"Run({self.name!r})"

    def view(self) -> RunView:
        """How the run stands now, with all its stages."""
        return RunView.model_validate(self._server._json("GET", self._path))

    def settings(self) -> RunSettings:
        """The settings of the run's stages, beside those of the pipeline's previous run."""
        return RunSettings.model_validate(self._server._json("GET", f"{self._path}/settings"))

    def why(self) -> dict[str, str]:
        """Why each stage was computed, such as ``lr 2e-4 -> 1e-4`` or ``cached from walks-1``."""
        stages = self.settings().stages
        return {stage.stage: stage.why.text for stage in stages if stage.why is not None and stage.why.text}

    @property
    def state(self) -> str:
        """``running``, ``paused``, ``finished``, ``failed`` or ``cancelled``."""
        return str(self.view().state)

    def pause(self) -> RunView:
        """Pauses the run; its workers save and stop."""
        return self._control("pause")

    def resume(self) -> RunView:
        """Continues the run."""
        return self._control("resume")

    def cancel(self) -> RunView:
        """Ends the run."""
        return self._control("cancel")

    def _control(self, action: str) -> RunView:
        return RunView.model_validate(self._server._json("POST", f"{self._path}/{action}"))

    def follow(self, *, after: int = 0) -> Iterator[HistoryRow]:
        """The events of the run, the past ones first, until it has ended.

        Args:
            after: Number of the last event that is known already.
        """
        while True:
            asked: dict[str, str | int] = {"run": self.name, "after": after, "wait": WAIT_S}
            rows = [HistoryRow.model_validate(row) for row in self._server._json("GET", "/v1/history", params=asked)]
            for row in rows:
                after = row.id
                yield row
            if any(row.kind == "ended" for row in rows[-1:]) or (not rows and self._is_over()):
                return

    def _is_over(self) -> bool:
        return self.state in ("finished", "failed", "cancelled")

    def wait(self) -> RunView:
        """Waits for the end of the run."""
        for _ in self.follow():
            pass
        return self.view()

    def logs(self, *, stage: str | None = None, after: int = 0) -> Iterator[LogRow]:
        """Log lines, stored after a line."""
        while True:
            asked: dict[str, str | int] = {"after": after, **({"stage": stage} if stage else {})}
            rows = self._server._json("GET", f"{self._path}/logs", params=asked)
            if not rows:
                return
            for row in rows:
                line = LogRow.model_validate(row)
                after = line.id
                yield line

    def metrics(self, key: str, *, stage: str | None = None) -> Metrics:
        """Every value that a stage recorded under a name.

        Args:
            key: Name of the value, such as ``loss``.
            stage: The stage; needed if several have recorded such values.
        """
        parts: dict[str, tuple[list[memoryview[int]], list[memoryview[float]]]] = {}
        asked: dict[str, str | int] = {"key": key, "limit": PAGE, **({"stage": stage} if stage else {})}
        while True:
            answer = self._server._call("GET", f"{self._path}/metrics", params=asked, headers={"accept": PACKED})
            page = _unpacked(answer.content)
            for name, (steps, values) in page.items():
                known = parts.setdefault(name, ([], []))
                known[0].append(steps)
                known[1].append(values)
            if stage is None:
                if len(parts) > 1:
                    names = ", ".join(sorted(parts))
                    raise StrideError("invalid", f"stages {names} have recorded `{key}`", "name one: `stage=`")
                stage = next(iter(parts), None)
            if stage is None or stage not in page or len(page[stage][0]) < PAGE:
                break
            asked.update({"stage": stage, "after": page[stage][0][-1]})
        if stage is None or stage not in parts:
            raise StrideError("not-found", f"run `{self.name}` has recorded no `{key}`", status=404)
        columns = parts[stage]
        return Metrics(self.name, stage, key, *(b"".join(column) for column in columns))


def _missing(error: ImportError) -> StrideError:
    """The error for a package that only some calls need."""
    return StrideError("invalid", f"this call needs `{error.name}`", "`pip install 'stride-client[pandas]'` installs it")


def _unpacked(answer: bytes) -> dict[str, tuple[memoryview[int], memoryview[float]]]:
    (length,) = struct.unpack_from("<I", answer)
    at = 4 + length
    found = {}
    for series in json.loads(answer[4:at]):
        end = at + 8 * series["rows"]
        steps, values = memoryview(answer[at:end]), memoryview(answer[end : end + 8 * series["rows"]])
        found[series["stage"]] = (steps.cast("Q"), values.cast("d"))
        at = end + 8 * series["rows"]
    return found


@dataclass(frozen=True, repr=False)
class Metrics:
    """Every value of one name that a stage recorded, in the order of steps."""

    run: str
    stage: str
    key: str
    _steps: bytes
    _values: bytes

    def __len__(self) -> int:
        return len(self._steps) // 8

    def __repr__(self) -> str:
        return f"Metrics({self.run!r}, {self.stage!r}, {self.key!r}, {len(self)} values)"

    @property
    def steps(self) -> list[int]:
        """The steps."""
        return list(memoryview(self._steps).cast("Q"))

    @property
    def values(self) -> list[float]:
        """The values as they were recorded; what was not finite is NaN."""
        return list(memoryview(self._values).cast("d"))

    def to_pandas(self) -> pandas.Series[Any]:
        """The values as a series by step; needs pandas."""
        try:
            import numpy
            import pandas
        except ImportError as error:
            raise _missing(error) from error
        index = pandas.Index(numpy.frombuffer(self._steps, dtype="<u8").astype("int64"), name="step")
        return pandas.Series(numpy.frombuffer(self._values, dtype="<f8"), index=index, name=self.key)


class Model:
    """A model of the registry."""

    def __init__(self, server: Server, name: str) -> None:
        self._server = server
        self.name = name

    def __repr__(self) -> str:
        return f"Model({self.name!r})"

    def generate(
        self,
        sentence: str,
        *,
        n: int = 1,
        seed: int = 0,
        seconds: float | None = None,
        guidance: float | None = None,
        steps: int | None = None,
        path: Sequence[tuple[float, float, float, float]] = (),
    ) -> Motions:
        """Draws motions with this version: joint positions in metres, ``[n, frames, joints, 3]``. Needs numpy.

        A worker of the server draws them, and the call waits for it. Motions that were drawn before come from the store. A notebook plays
        them.

        Args:
            sentence: Text of the motion.
            n: Number of motions, with consecutive seeds; at most 16.
            seed: Seed of the first motion.
            seconds: Length; by default the model's choice.
            guidance: Guidance scale; by default that of the model's evaluation.
            steps: Number of network evaluations; by default that of the model's evaluation.
            path: Positions that the pelvis passes, as seconds and x, y, z in metres, for a model with a control part.

        Raises:
            StrideError: The server refuses the draw, or it failed.
        """
        try:
            import numpy
        except ImportError as error:
            raise _missing(error) from error

        from ._motions import motions

        asked = {"seconds": seconds, "guidance": guidance, "steps": steps}
        body: dict[str, object] = {"models": [self.name], "sentences": [sentence], "count": n, "seed": seed, "path": list(path)}
        body.update({name: value for name, value in asked.items() if value is not None})
        headers = {"idempotency-key": str(uuid.uuid4())}
        drawing = Drawing.model_validate(self._server._json("POST", "/v1/draws", body=body, headers=headers))
        run = self._server.run(drawing.run).wait()
        stage = next(stage for stage in run.stages if stage.name == drawing.stages[0])
        if run.state != "finished":
            raise StrideError("failed", stage.message or f"the draw was {run.state}", f"see run `{drawing.run}`")
        files = json.loads(self._server._blob(stage.outputs["report"]))["files"]
        drawn = [self._server._blob(files[f"motion-{number:02}.npy"]["digest"]) for number in range(n)]
        page = str(files["motions.html"]["digest"])
        return motions([numpy.load(io.BytesIO(motion)) for motion in drawn], lambda: self._server._blob(page).decode())

    def versions(self) -> list[Version]:
        """All versions, the oldest first."""
        shown = self._server._registry({"command": "show", "reference": self.name})
        return [Version.model_validate(version) for version in shown["versions"]]

    def version(self, which: str | int) -> Version:
        """One version: its number, an alias, or ``best``."""
        reference = f"{self.name}:{which}" if isinstance(which, int) else f"{self.name}@{which}"
        shown = self._server._registry({"command": "show", "reference": reference})
        return Version.model_validate(shown["version"])

    def history(self, alias: str | None = None) -> list[Promotion]:
        """The moves of the model's aliases, or of one, the oldest first."""
        shown = self._server._registry({"command": "history", "model": self.name, "alias": alias})
        return [Promotion.model_validate(move) for move in shown["history"]]

    def promote(
        self,
        which: str | int,
        *,
        to: str,
        reason: str,
        require: list[str] | None = None,
        expect: int | str | None = None,
    ) -> Promotion:
        """Moves an alias to a version.

        Args:
            which: Number of the version, an alias of it, or ``best``.
            to: The alias.
            reason: Reason for the log.
            require: Gates that must hold, such as ``fid < 0.5``.
            expect: The alias moves only if it is at this version now; ``none`` if it must not exist.
        """
        command = {
            "command": "promote",
            "reference": f"{self.name}:{which}" if isinstance(which, int) else f"{self.name}@{which}",
            "to": to,
            "expect": None if expect is None else str(expect),
            "require": require or [],
            "reason": reason,
        }
        return Promotion.model_validate(self._server._registry(command)["promotion"])

    def roll_back(self, alias: str, *, reason: str, to: int | None = None) -> Promotion:
        """Moves an alias back: to a version, or to the one before the last promotion."""
        command = {"command": "rollback", "model": self.name, "alias": alias, "to": to, "expect": None, "reason": reason}
        return Promotion.model_validate(self._server._registry(command)["promotion"])
