"""A server with runs of every fate, and a browser that is used by finger or by keyboard."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import stride
from playwright.sync_api import Browser, BrowserContext, Locator, Page, Route, expect, sync_playwright

TRAINER = os.environ["STRIDE_TRAINER"]
PATIENCE_S = 90.0
"""Limit for a view to show something."""
expect.set_options(timeout=PATIENCE_S * 1000)

TRAINING = """
    network: {width: 16, layers: 3, heads: 2, feed_forward: 32}
    batch: {global: 4, slices: 2}
    warmup: 2
"""


FID = "kind: evaluate.latent_fid, sampler: {steps: 2, guidance: 3}, repeats: 1, components: 4"


def pipeline(name: str, lr: str = "1e-3", steps: int = 12, more: str = "", ends: str = "") -> str:
    return (
        f"name: {name}\nseed: 1\ndataset: {{format: synthetic, clips: 32, val: 0.1, test: 0.2}}\nstages:\n"
        f"  vae:\n    kind: train.vae\n    latent: {{tokens: 2, dim: 8}}{TRAINING}    lr: {lr}\n    steps: {steps}\n{more}{ends}"
    )


def model(name: str, lr: str, sweep: str = "") -> str:
    return (
        f"  latents: {{kind: encode.latents, vae: vae}}\n  mld:\n    kind: train.mld{TRAINING}    steps: 8\n    lr: {lr}\n"
        + (sweep or f"  fid: {{{FID}, model: mld}}\n  release: {{kind: register, model: {name}, from: [mld], promote: {{to: staging}}}}\n")
    )


SWEEP = f"    sweep: {{metric: latent_fid, trials: 2, rungs: {{first: 4}}, space: {{lr: {{choice: [1e-3, 1e-2]}}}}, evaluate: {{{FID}}}}}\n"


@dataclass
class World:
    folder: Path
    url: str = ""
    token: str = field(default_factory=lambda: secrets.token_hex(32))
    reader: str = field(default_factory=lambda: secrets.token_hex(32))
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    runs: dict[str, stride.Run] = field(default_factory=dict)

    def __post_init__(self) -> None:
        tokens = self.folder / "tokens"
        tokens.touch(mode=0o600)
        tokens.write_text(f"maker read,submit,worker,promote,admin {self.token}\nlooker read {self.reader}\n")
        (self.folder / "viewers").touch(mode=0o600)
        (self.folder / "viewers").write_text(f"viewer read {secrets.token_hex(32)}\n")
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.stream_at = f"127.0.0.1:{free.getsockname()[1]}"
        self.serve("127.0.0.1:0")
        self.server = stride.connect(self.url, token=self.token)

    def serve(self, bind: str) -> None:
        """Starts a server and waits for it to listen."""
        log = self.folder / "serve.log"
        stream = ["--stream", f"ws://{self.stream_at}", "--stream-token-file", "viewers"]
        self.start("serve", ["serve", "--store", str(self.folder / "store"), "--bind", bind, "--token-file", "tokens", *stream])
        until = time.monotonic() + 120
        while not (found := re.search(r"http://127\.0\.0\.1:\d+", log.read_text())):
            assert time.monotonic() < until and self.processes["serve"].poll() is None, log.read_text()
            time.sleep(0.1)
        self.url = found.group()

    def end(self, name: str) -> None:
        self.processes[name].terminate()
        self.processes[name].wait(60)

    def start(self, name: str, arguments: list[str]) -> None:
        with (self.folder / f"{name}.log").open("w") as out:
            self.processes[name] = subprocess.Popen([TRAINER, *arguments], stdout=out, stderr=subprocess.STDOUT, cwd=self.folder)

    def join(self, name: str) -> None:
        self.start(name, ["worker", "join", self.url, "--name", name, "--token", self.token])

    def stream(self, model: str) -> None:
        """Starts the stream that the page offers, and waits for it to listen."""
        listens = ["--listen", self.stream_at, "--listen-token-file", "viewers", "--streams", "2"]
        self.start("stream", ["generate", "--stream", "--model", model, "--server", self.url, "--token", self.token, *listens])
        until = time.monotonic() + 120
        while "/v1/stream" not in (said := (self.folder / "stream.log").read_text()):
            assert time.monotonic() < until and self.processes["stream"].poll() is None, said
            time.sleep(0.1)

    def kill(self, name: str) -> None:
        self.processes[name].send_signal(signal.SIGKILL)

    def submit(self, name: str, text: str) -> stride.Run:
        path = self.folder / f"{name}.yaml"
        path.write_text(text)
        self.runs[name] = self.server.submit(path, trainer=TRAINER)
        return self.runs[name]

    def until(self, name: str, state: str) -> None:
        until = time.monotonic() + 4 * PATIENCE_S
        while (now := self.runs[name].state) != state:
            assert time.monotonic() < until, f"{name} is {now}; expected {state}"
            time.sleep(0.2)

    def stop(self) -> None:
        for process in reversed(self.processes.values()):
            process.terminate()
        for process in self.processes.values():
            process.wait(60)


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    it = World(tmp_path_factory.mktemp("world"))
    try:
        it.join("a")
        it.submit("walks", pipeline("walks", ends=model("walks", "1e-3"))).wait()
        it.submit("again", pipeline("walks", ends=model("walks", "2e-3"))).wait()
        it.submit("swept", pipeline("swept", ends=model("swept", "1e-3", SWEEP))).wait()
        it.submit("waiting", pipeline("waiting", steps=13, more="    requires: [gpu=h100]\n"))
        it.submit("broken", pipeline("broken", lr="1000", steps=500)).wait()
        assert it.runs["broken"].state == "failed"
        assert {it.runs[name].state for name in ("walks", "again", "swept")} == {"finished"}
        yield it
    finally:
        it.stop()


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    program = os.environ.get("STRIDE_BROWSER") or shutil.which("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-dev-shm-usage"])
        yield browser
        browser.close()


@dataclass(frozen=True)
class Way:
    """A way to use the page."""

    touch: bool
    dark: bool

    def __str__(self) -> str:
        return f"{'touch-360' if self.touch else 'keyboard-1280'}-{'dark' if self.dark else 'light'}"

    @property
    def size(self) -> Any:
        return {"width": 360, "height": 640} if self.touch else {"width": 1280, "height": 800}


class Hand:
    """Presses what is on a page, and counts."""

    def __init__(self, page: Page, way: Way, world: World) -> None:
        self.page, self.way, self.world = page, way, world
        self.begin()

    def begin(self) -> None:
        self.presses, self.keys, self.took = 0, 0, ""

    def open(self, path: str) -> None:
        self.begun = time.monotonic()
        self.page.goto(self.world.url + path)
        self.page.wait_for_selector("main h1:not([class=skeleton])")
        until(self.page, "!document.querySelector('.skeleton')")
        self.begin()

    def within(self, presses: int, seconds: float | None = None, since: float | None = None) -> None:
        """Ends a story: it took no more presses, and no more time, than a person has patience for."""
        took = time.monotonic() - (since or self.begun)
        word = "tap" if self.way.touch else "press"
        many = f"{self.presses} {word}" + ("" if self.presses == 1 else "s" if self.way.touch else "es")
        self.took = f"{many}{f' of {self.keys} keys' if self.keys > self.presses else ''}, {took:.1f} s"
        assert self.presses <= presses, f"{self.presses} presses; expected at most {presses}"
        assert seconds is None or took <= seconds, f"{took:.2f} s; expected at most {seconds}"

    def reach(self, target: Locator) -> None:
        """Has the keyboard's focus on it, by Tab alone."""
        target.wait_for()
        for _ in range(120):
            if target.evaluate("(e) => e === document.activeElement"):
                outline = target.evaluate("(e) => getComputedStyle(e).outlineStyle + getComputedStyle(e).boxShadow")
                assert outline != "nonenone", "the focus is seen"
                return
            self.page.keyboard.press("Tab")
            self.keys += 1
        raise AssertionError(f"Tab does not reach {target}")

    def press(self, target: Locator) -> None:
        self.presses += 1
        if not self.way.touch:
            self.reach(target)
            self.page.keyboard.press("Enter")
            self.keys += 1
            return
        target.wait_for()
        # The bar at the lower edge lies over what has only just come into view.
        target.evaluate("(e) => e.scrollIntoView({ block: 'center' })")
        box = target.bounding_box()
        assert box is not None and box["height"] >= 24 and box["width"] >= 24, f"a finger finds {target}: {box}"
        self.page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def write(self, target: Locator, text: str) -> None:
        if self.way.touch:
            box = target.bounding_box()
            assert box is not None
            self.page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        else:
            self.reach(target)
        self.page.keyboard.type(text)

    def in_sight(self, target: Locator) -> bool:
        """True if all of it is on the screen without scrolling, and nothing lies over its middle."""
        target.wait_for()
        return bool(
            target.evaluate(
                "(e) => { const r = e.getBoundingClientRect(); const top = document.elementFromPoint((r.left + r.right) / 2, (r.top + r.bottom) / 2);"
                " return scrollY === 0 && r.top >= 0 && r.bottom <= innerHeight && top !== null && (e.contains(top) || top.contains(e)); }"
            )
        )

    def keep(self, name: str) -> None:
        wide = self.page.evaluate("Math.max(document.documentElement.scrollWidth, document.querySelector('main').scrollWidth)")
        assert wide <= self.way.size["width"], f"{name} is {wide} wide"
        if folder := os.environ.get("STRIDE_SCREENSHOTS"):
            self.page.screenshot(path=Path(folder) / f"{name}-{self.way}.png")


def until(page: Page, expression: str) -> None:
    """Waits for an expression to hold. The page's policy refuses the texts that Playwright's own wait would evaluate in it."""
    since = time.monotonic()
    while not page.evaluate(expression):
        assert time.monotonic() - since < PATIENCE_S, expression
        page.wait_for_timeout(50)


def from_folder(route: Route) -> None:
    """Answers with a file of STRIDE_PAGE, where there is one."""
    name = re.sub(r"^.*?/page/[^/]+/", "", route.request.url)
    path = Path(os.environ["STRIDE_PAGE"]) / name
    if path.is_file():
        route.fulfill(path=path, headers={"content-type": {".js": "text/javascript", ".css": "text/css"}.get(path.suffix, "image/svg+xml")})
    else:
        route.continue_()


def document_from_folder(route: Route) -> None:
    """Answers with the document of STRIDE_PAGE, which names the files' folder of the server's build."""
    if route.request.resource_type != "document":
        return route.fallback()
    answer = route.fetch()
    folder = re.search(r"/page/([0-9a-f]+)/", answer.text())
    text = (Path(os.environ["STRIDE_PAGE"]) / "index.html").read_text()
    route.fulfill(response=answer, body=text.replace("PRELOADS", "").replace("FOLDER", folder.group(1) if folder else "FOLDER"))


def enter(chromium: Browser, world: World, way: Way, token: str | None = None) -> BrowserContext:
    """A browser that is signed in."""
    scheme: Any = "dark" if way.dark else "light"
    context = chromium.new_context(viewport=way.size, has_touch=way.touch, is_mobile=way.touch, color_scheme=scheme)
    context.set_default_timeout(PATIENCE_S * 1000)
    if "STRIDE_PAGE" in os.environ:
        context.route("**/*", document_from_folder)
        context.route("**/page/**", from_folder)
    page = context.new_page()
    page.goto(world.url)
    page.fill("#token", token or world.token)
    page.keyboard.press("Enter")
    page.wait_for_selector("nav.places")
    page.close()
    return context


WAYS = [Way(touch, dark) for touch in (True, False) for dark in (False, True)]


@pytest.fixture(params=WAYS, ids=str, scope="session")
def hand(request: pytest.FixtureRequest, chromium: Browser, world: World) -> Iterator[Hand]:
    context = enter(chromium, world, request.param)
    page = context.new_page()
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    yield Hand(page, request.param, world)
    context.close()
    assert not wrong, wrong


STORIES: dict[str, dict[str, str]] = {}
"""Presses and time of each story, by way."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    report = yield
    hand = getattr(item, "funcargs", {}).get("hand")
    if report.when == "call" and hand is not None:
        row = STORIES.setdefault(item.name.partition("[")[0].removeprefix("test_").replace("_", " "), {})
        row[str(hand.way)] = hand.took or "shown" if report.passed else "MISSED"
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if not STORIES:
        return
    wide = max(map(len, STORIES))
    terminalreporter.section("stories")
    terminalreporter.line("  ".join(["story".ljust(wide), *(str(way).ljust(27) for way in WAYS)]))
    for story, row in STORIES.items():
        terminalreporter.line("  ".join([story.ljust(wide), *(row.get(str(way), "not run").ljust(27) for way in WAYS)]))
