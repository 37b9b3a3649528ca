"""Tasks of people on the page, and the presses that they take. The link that opens a view is the first press."""

from __future__ import annotations

import statistics
import time
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from conftest import Hand, Way, World, enter, pipeline, until

DESK = Way(touch=False, dark=False)


def test_a_failed_run_tells_its_cause_and_resumes(hand: Hand) -> None:
    hand.world.until("broken", "failed")
    hand.open(f"/runs/{hand.world.runs['broken'].name}")
    cause = hand.page.locator(".cause .why")
    resume = hand.page.locator(".cause").get_by_role("button", name="Resume")
    assert hand.in_sight(cause) and hand.in_sight(resume)
    expect(cause).to_contain_text("diverged")
    hand.keep("failed")
    hand.press(resume)
    expect(hand.page.locator(".said")).to_have_text("It goes on.")
    assert hand.presses == 1


def test_why_nothing_runs_is_said_at_once(hand: Hand) -> None:
    hand.open("/")
    card = hand.page.locator(".want", has_text=hand.world.runs["waiting"].name)
    expect(card).to_contain_text("gpu=h100")
    expect(card).to_contain_text("trainer worker join")
    expect(card).to_contain_text("--label gpu=h100")
    hand.keep("now")


def test_a_run_is_compared_with_the_one_before(hand: Hand) -> None:
    hand.open(f"/runs/{hand.world.runs['again'].name}")
    hand.press(hand.page.get_by_role("link", name="Compare with"))
    row = hand.page.locator("section[aria-labelledby=settings] tbody tr")
    expect(row).to_have_count(1)
    expect(row).to_contain_text("mld.lr")
    hand.keep("compare")
    assert hand.presses == 1


def test_a_version_is_promoted_with_a_reason(hand: Hand) -> None:
    hand.world.server.model("walks").promote(1, to="prod", reason=f"before {hand.way}")
    hand.open("/models/walks")
    hand.press(hand.page.get_by_role("button", name="Promote", exact=True).first)
    expect(hand.page.locator("#promote-title")).to_be_visible()
    why = f"tried {hand.way}"
    hand.write(hand.page.locator("#reason"), why)
    hand.keep("promote")
    hand.press(hand.page.locator("dialog").get_by_role("button", name="Promote", exact=True))
    expect(hand.page.locator(".moves li").first).to_contain_text(why)
    assert hand.presses == 2


def test_a_motion_is_drawn(hand: Hand) -> None:
    hand.open("/models/walks")
    hand.press(hand.page.get_by_role("link", name="Draw", exact=True).last)
    draw = hand.page.get_by_role("button", name="Draw", exact=True)
    begun = time.monotonic()
    hand.press(draw)
    hand.page.wait_for_selector("canvas.figure")
    until(hand.page, "(() => { const r = document.querySelector('canvas.figure').getBoundingClientRect(); return r.top >= 0 && r.bottom <= innerHeight; })()")
    print(f"{hand.way}: drawn after {time.monotonic() - begun:.2f} s")
    hand.keep("draw")
    assert hand.presses == 2


def test_a_version_leads_to_its_dataset(hand: Hand) -> None:
    hand.open("/models/walks")
    hand.press(hand.page.get_by_role("button", name="Lineage").first)
    dataset = hand.page.locator(".lineage li", has_text="dataset").get_by_role("link").first
    dataset.wait_for()
    hand.keep("lineage")
    hand.press(dataset)
    expect(hand.page.locator("h1")).to_have_text("dataset")
    assert hand.presses == 2


def test_a_sweep_names_its_winner(hand: Hand) -> None:
    hand.open("/runs")
    hand.press(hand.page.get_by_role("link", name=hand.world.runs["swept"].name))
    expect(hand.page.locator(".winner")).to_contain_text("best")
    hand.keep("sweep")
    assert hand.presses == 1


@pytest.fixture(scope="module")
def live(world: World) -> World:
    """A training under way, of two workers."""
    world.join("b")
    world.submit("live", pipeline("live", steps=1_000_000, more="    workers: {min: 1, max: 2}\n"))
    deadline = time.monotonic() + 240
    while not any(len(stage.workers) == 2 and stage.progress.done > 5 for stage in world.runs["live"].view().stages):
        assert time.monotonic() < deadline, world.runs["live"].view()
        time.sleep(0.2)
    # For what else the stories ask.
    world.join("c")
    return world


def test_time_left_is_in_sight(live: World, hand: Hand) -> None:
    hand.open("/")
    expect(hand.page.locator(".running", has_text=live.runs["live"].name).locator(".left")).to_contain_text("left")
    hand.keep("running")


SEES = """(text) => new Promise((done) => {
  const look = () => { if (document.querySelector('.head .badge')?.textContent.includes(text)) { watch.disconnect(); done(Date.now()); } };
  const watch = new MutationObserver(look);
  watch.observe(document.body, { childList: true, subtree: true, characterData: true });
  look();
})"""


def test_an_event_is_on_the_page_at_once(live: World, chromium: Browser) -> None:
    context = enter(chromium, live, DESK)
    page = context.new_page()
    page.goto(f"{live.url}/runs/{live.runs['live'].name}")
    page.wait_for_selector(".head .badge")
    page.evaluate("window.sees = " + SEES)
    late = []
    for turn in range(20):
        text = "paused" if turn % 2 == 0 else "running"
        page.evaluate("(text) => { window.seen = window.sees(text); }", text)
        live.runs["live"].pause() if turn % 2 == 0 else live.runs["live"].resume()
        answered = time.time() * 1000
        late.append(max(0.0, page.evaluate("window.seen") - answered))
        time.sleep(0.31)
    context.close()
    late.sort()
    print(f"events are on the page after {statistics.median(late):.0f} ms (median), {late[18]:.0f} ms (p95)")
    assert statistics.median(late) <= 300 and late[18] <= 1000, late


def test_ten_tabs_share_one_stream(live: World, chromium: Browser) -> None:
    context = enter(chromium, live, DESK)
    opened: list[Page] = []
    streams: list[str] = []
    context.on("request", lambda request: streams.append(request.url) if "/v1/events" in request.url else None)
    for _ in range(10):
        page = context.new_page()
        page.goto(f"{live.url}/runs/{live.runs['live'].name}")
        page.wait_for_selector(".head .badge")
        opened.append(page)
    assert len(streams) == 1, streams
    # The tab that reads the stream is closed, and another one takes over.
    opened.pop(0).close()
    deadline = time.monotonic() + 30
    while len(streams) < 2 and time.monotonic() < deadline:
        opened[0].wait_for_timeout(100)
    assert len(streams) == 2, streams
    live.runs["live"].pause()
    for page in opened:
        until(page, "document.querySelector('.head .badge').textContent.includes('paused')")
    live.runs["live"].resume()
    context.close()


def test_watching_for_long_takes_no_more_memory(live: World, chromium: Browser) -> None:
    context = enter(chromium, live, DESK)
    page = context.new_page()
    page.clock.install()
    page.goto(f"{live.url}/runs/{live.runs['live'].name}")
    page.wait_for_selector(".head .badge")
    devtools = context.new_cdp_session(page)

    def heap() -> float:
        devtools.send("HeapProfiler.collectGarbage")
        return float(devtools.send("Runtime.getHeapUsage")["usedSize"]) / 1e6

    used: list[float] = []
    for _ in range(4):
        for _ in range(60):
            with page.expect_response(lambda answer: answer.url.endswith(live.runs["live"].name)):
                page.clock.fast_forward(1100)
        used.append(heap())
    context.close()
    print("heap after each minute of watching, MB: " + ", ".join(f"{mb:.1f}" for mb in used))
    assert max(used) <= 80 and used[-1] - used[1] <= 3, used


def test_a_killed_worker_shows_without_reload(live: World, chromium: Browser) -> None:
    context = enter(chromium, live, DESK)
    page = context.new_page()
    page.goto(f"{live.url}/workers")
    row: Any = page.locator("table.workers tr", has=page.get_by_role("rowheader", name="b", exact=True))
    expect(row).to_contain_text("working")
    live.kill("b")
    begun = time.monotonic()
    expect(row).not_to_contain_text("working")
    took = time.monotonic() - begun
    print(f"a killed worker shows after {took:.2f} s")
    assert took <= 5, took
    context.close()
