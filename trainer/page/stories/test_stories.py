"""Tasks of people on the page, and the presses that they take. The link that opens a view is the first press."""

from __future__ import annotations

import re
import statistics
import time
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from conftest import WAYS, Hand, Way, World, enter, model, pipeline, until

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
    hand.within(presses=1)


def test_why_nothing_runs_is_said_at_once(hand: Hand) -> None:
    hand.open("/")
    card = hand.page.locator(".want", has_text=hand.world.runs["waiting"].name)
    expect(card).to_contain_text("gpu=h100")
    expect(card).to_contain_text("trainer worker join")
    expect(card).to_contain_text("--label gpu=h100")
    hand.within(presses=0)
    hand.keep("now")


def test_a_run_is_compared_with_the_one_before(hand: Hand) -> None:
    hand.open(f"/runs/{hand.world.runs['again'].name}")
    hand.press(hand.page.get_by_role("link", name="Compare with"))
    row = hand.page.locator("section[aria-labelledby=settings] tbody tr")
    expect(row).to_have_count(1)
    expect(row).to_contain_text("mld.lr")
    hand.within(presses=1)
    hand.keep("compare")


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
    hand.within(presses=2)


def test_a_motion_is_drawn(hand: Hand) -> None:
    hand.open("/models/walks")
    hand.press(hand.page.get_by_role("link", name="Draw", exact=True).last)
    draw = hand.page.get_by_role("button", name="Draw", exact=True)
    # Another seed for each form, so that no motion is from the store.
    hand.page.get_by_label("Seed", exact=True).fill(str(100 + WAYS.index(hand.way)))
    begun = time.monotonic()
    hand.press(draw)
    hand.page.wait_for_selector("canvas.figure")
    until(hand.page, "(() => { const r = document.querySelector('canvas.figure').getBoundingClientRect(); return r.top >= 0 && r.bottom <= innerHeight; })()")
    hand.within(presses=2, seconds=2, since=begun)
    hand.keep("draw")


def test_a_version_leads_to_its_dataset(hand: Hand) -> None:
    hand.open("/models/walks")
    hand.press(hand.page.get_by_role("button", name="Lineage").first)
    dataset = hand.page.locator(".lineage li", has_text="dataset").get_by_role("link").first
    dataset.wait_for()
    hand.keep("lineage")
    hand.press(dataset)
    expect(hand.page.locator("h1")).to_have_text("dataset")
    hand.within(presses=2)


def test_a_sweep_names_its_winner(hand: Hand) -> None:
    hand.open("/runs")
    hand.press(hand.page.get_by_role("link", name=hand.world.runs["swept"].name))
    expect(hand.page.locator(".winner")).to_contain_text("best")
    hand.within(presses=1)
    hand.keep("sweep")


def test_a_gate_that_is_not_met_wants_a_person(hand: Hand) -> None:
    name = f"gated-{hand.way}"
    ends = model("gated", "1e-3").replace("promote: {to: staging}", "promote: {to: staging, require: [latent_fid < 0]}")
    if name not in hand.world.runs:
        hand.world.submit(name, pipeline("gated", ends=ends)).wait()
    hand.open("/")
    card = hand.page.locator(".want.bad", has_text=hand.world.runs[name].name)
    expect(card).to_contain_text("cannot be promoted to")
    expect(card).to_contain_text("move the alias by hand")
    hand.within(presses=0)
    hand.keep("gate")


def test_an_empty_store_says_how_to_begin(hand: Hand, chromium: Browser, tmp_path: Path) -> None:
    empty = World(tmp_path)
    try:
        context = enter(chromium, empty, hand.way)
        page = context.new_page()
        page.goto(empty.url)
        for command in ("trainer submit configs/quickstart.yaml --server", "trainer worker join"):
            expect(page.locator(".empty .command", has_text=command)).to_be_visible()
        context.close()
    finally:
        empty.stop()


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
    hand.within(presses=0)
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
    # Playwright calls what an expression gives, if that is a function.
    page.evaluate(f"void (window.sees = {SEES})")
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


def test_a_killed_worker_shows_without_reload(live: World, hand: Hand) -> None:
    name = f"killed-{hand.way}"
    live.join(name)
    hand.open("/workers")
    row: Any = hand.page.locator("table.workers tr", has=hand.page.get_by_role("rowheader", name=name, exact=True))
    expect(row).to_contain_text(re.compile("idle|working"))
    live.kill(name)
    begun = time.monotonic()
    expect(row).not_to_contain_text(re.compile("idle|working"))
    hand.within(presses=0, seconds=2, since=begun)
    hand.keep("killed")


def test_a_run_is_watched_from_its_submission_to_a_promotion(live: World, hand: Hand) -> None:
    hand.open("/")
    lr = f"{3 + WAYS.index(hand.way)}e-3"
    run = live.submit(f"watched-{hand.way}", pipeline("walks", ends=model("walks", lr)))
    card = hand.page.locator(".running", has_text=run.name)
    hand.press(card.get_by_role("link", name=run.name, exact=True))
    expect(hand.page.locator(".head .badge")).to_contain_text("finished")
    hand.keep("watched")
    hand.press(hand.page.get_by_role("link", name="walks", exact=True))
    hand.press(hand.page.get_by_role("button", name="Promote", exact=True).first)
    hand.write(hand.page.locator("#reason"), "as it was watched")
    hand.press(hand.page.locator("dialog").get_by_role("button", name="Promote", exact=True))
    expect(hand.page.locator(".moves li").first).to_contain_text("as it was watched")
    hand.within(presses=4)


def test_a_run_fails_while_it_is_watched(live: World, hand: Hand) -> None:
    run = live.submit(f"fails-{hand.way}", pipeline("fails", lr=f"{999 - WAYS.index(hand.way)}", steps=500))
    hand.open(f"/runs/{run.name}")
    expect(hand.page.locator(".cause .why")).to_contain_text("diverged")
    assert hand.in_sight(hand.page.locator(".cause").get_by_role("button", name="Resume"))
    hand.within(presses=0)


def test_a_run_is_cancelled(live: World, hand: Hand) -> None:
    run = live.submit(f"cancelled-{hand.way}", pipeline("cancelled", steps=1_000_000 + WAYS.index(hand.way)))
    live.until(f"cancelled-{hand.way}", "running")
    hand.open(f"/runs/{run.name}")
    hand.page.once("dialog", lambda question: question.accept())
    hand.press(hand.page.get_by_role("button", name="Cancel", exact=True))
    expect(hand.page.locator(".head .badge")).to_contain_text("cancelled")
    hand.within(presses=1)
    hand.keep("cancelled")


def test_a_server_that_restarts_is_waited_for(live: World, hand: Hand) -> None:
    hand.open(f"/runs/{live.runs['live'].name}")
    live.end("serve")
    expect(hand.page.locator(".banner")).to_contain_text("does not answer")
    hand.keep("away")
    live.serve(live.url.removeprefix("http://"))
    expect(hand.page.locator(".banner")).to_have_count(0)
    live.runs["live"].pause()
    expect(hand.page.locator(".head .badge")).to_contain_text("paused")
    live.runs["live"].resume()
    expect(hand.page.locator(".head .badge")).to_contain_text("running")
    hand.within(presses=0)


HOSTILE = "<img src=x onerror=\"window.hostile=1\"></script><script>window.hostile=1</script>\u202e'&amp;"
ESCAPE = "\u001b[31m"


def test_hostile_words_stay_words(hand: Hand) -> None:
    hand.open("/draw")
    sentence = hand.page.locator("#sentence")
    # An escape of terminals is refused, and the refusal is words, too.
    sentence.fill(HOSTILE + ESCAPE)
    hand.press(hand.page.get_by_role("button", name="Draw", exact=True))
    expect(hand.page.locator("main .wrong").first).to_contain_text("control character")
    sentence.fill(HOSTILE)
    hand.press(hand.page.get_by_role("button", name="Draw", exact=True))
    hand.page.wait_for_selector("canvas.figure")
    expect(hand.page.locator("figcaption b")).to_contain_text("<img src=x")
    hand.world.server.model("walks").promote(1, to="hostile", reason=HOSTILE)
    hand.page.goto(f"{hand.world.url}/models/walks")
    expect(hand.page.locator(".moves li", has_text="<img src=x").first).to_be_visible()
    assert hand.page.evaluate("[window.hostile ?? 0, document.querySelectorAll('#app script, #app [onerror]').length]") == [0, 0]


PLACES = ["/", "/runs", "/models", "/models/walks", "/draw", "/data", "/workers", "/store"]


def test_one_who_reads_sees_no_button_of_others(hand: Hand, chromium: Browser) -> None:
    context = enter(chromium, hand.world, hand.way, hand.world.reader)
    page = context.new_page()
    reads = Hand(page, hand.way, hand.world)
    for place in [*PLACES, *(f"/runs/{run.name}" for run in hand.world.runs.values())]:
        reads.open(place)
        seen = page.locator("main").get_by_role("button").all_inner_texts() + page.locator("main a.button").all_inner_texts()
        wrong = [text for text in seen if re.search("Resume|Pause|Cancel|Promote|Roll|Check|can go|Draw", text)]
        assert not wrong, f"{place}: {wrong}"
    context.close()
