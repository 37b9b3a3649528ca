"""The viewer of motions in the page: bodies, a part in a loop, two motions over each other, and the stream."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

import characters
from conftest import Hand, Way, World, enter, until

DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
ORANGE = """() => { const canvas = document.querySelector('canvas.figure'); const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let many = 0; for (let at = 0; at < data.length; at += 4) many += data[at] > 1.25 * data[at + 1] && data[at + 1] > 1.25 * data[at + 2] && data[at + 3] > 200 ? 1 : 0;
  return many / (canvas.width * canvas.height); }"""


@pytest.fixture(params=[Way(touch=False, dark=False), Way(touch=True, dark=True)], ids=str, scope="module")
def drawn(request: pytest.FixtureRequest, chromium: Browser, world: World) -> Iterator[Hand]:
    """Two models' motions for one sentence along a path."""
    context = enter(chromium, world, request.param)
    page = context.new_page()
    hand = Hand(page, request.param, world)
    hand.open("/draw?s=a+person+walks&model=walks%3A1&model=walks%3A2&seed=7&seconds=3")
    hand.press(page.get_by_role("button", name="Draw", exact=True))
    expect(page.locator("canvas.figure")).to_have_count(2)
    yield hand
    context.close()


def stopped_at(page: Page, frame: int) -> None:
    page.get_by_label("Time", exact=True).evaluate("(e, value) => { e.value = value; e.dispatchEvent(new Event('input')); }", str(frame))
    page.evaluate(DRAWN)


def test_a_body_is_capsules_or_bones(drawn: Hand) -> None:
    page = drawn.page
    stopped_at(page, 10)
    body = page.locator("select.body")
    expect(body).to_have_value("capsules")
    picture = page.locator("canvas.figure").first.screenshot()
    drawn.keep("capsules")
    body.select_option("bones")
    page.evaluate(DRAWN)
    assert page.locator("canvas.figure").first.screenshot() != picture
    drawn.keep("bones")
    body.select_option("capsules")
    page.evaluate(DRAWN)
    assert page.locator("canvas.figure").first.screenshot() == picture


def test_a_part_is_played_again_and_again(drawn: Hand) -> None:
    page = drawn.page
    bar = page.locator(".viewer-bar")
    stopped_at(page, 20)
    drawn.press(bar.get_by_role("button", name="Loop from here"))
    stopped_at(page, 30)
    drawn.press(bar.get_by_role("button", name="to here"))
    drawn.keep("loop")
    bar.get_by_role("button", name="Play").click()
    seen = {int(page.get_by_label("Time", exact=True).input_value()) for _ in range(60) if page.wait_for_timeout(50) is None}
    assert 20 <= min(seen) and max(seen) <= 31 and len(seen) > 4, seen
    bar.get_by_role("button", name="Stop").click()
    drawn.press(bar.get_by_role("button", name="All of it"))


def test_two_motions_are_seen_over_each_other(drawn: Hand) -> None:
    page = drawn.page
    stopped_at(page, 40)
    picture = page.locator("canvas.figure").first.screenshot()
    page.get_by_label("Over each other").check()
    page.evaluate(DRAWN)
    assert page.locator("canvas.figure").first.screenshot() != picture
    drawn.keep("over")
    page.get_by_label("Over each other").uncheck()


def test_feet_on_the_ground_and_sliding_are_under_each_figure(drawn: Hand) -> None:
    page = drawn.page
    expect(page.locator("canvas.strip")).to_have_count(2)
    expect(page.locator(".measures").first).to_contain_text("feet slide in")
    shades = "(e) => new Set(new Uint32Array(e.getContext('2d').getImageData(0, 0, e.width, e.height).data.buffer)).size"
    assert page.locator("canvas.strip").first.evaluate(shades) >= 3, "ground, air and the place in time"


def test_a_character_of_ones_own_is_drawn_and_stays_here(drawn: Hand) -> None:
    page = drawn.page
    stopped_at(page, 30)
    before = page.evaluate(ORANGE)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(f"{request.method} {request.url}"))
    file = {"name": "me.glb", "mimeType": "model/gltf-binary", "buffer": characters.glb()}
    page.set_input_files("input.file", files=[file])
    expect(page.locator("select.body")).to_have_value("character")
    # A canvas that is out of sight is drawn once it comes into sight.
    page.locator("canvas.figure").first.scroll_into_view_if_needed()
    page.wait_for_function(f"(least) => ({ORANGE})() > least", arg=before + 0.01, timeout=5000)
    drawn.keep("character")
    assert all(one.startswith("GET ") and one.endswith("/character.js") for one in asked), asked
    # A file that cannot be used is refused with a reason, and the character stays.
    lame = characters.glb("").replace(b'"LeftLeg"', b'"LeftLag"')
    for wrong, why in ((b"no such thing", "no GLB file"), (characters.glb()[:5000], "damaged"), (lame, "left_knee")):
        page.set_input_files("input.file", files=[{**file, "name": "<img src=x>.glb", "buffer": wrong}])
        expect(page.locator(".viewer-bar .wrong")).to_contain_text(why)
    expect(page.locator("select.body")).to_have_value("character")
    page.locator("select.body").select_option("capsules")


def test_a_sentence_takes_over_in_a_stream(drawn: Hand) -> None:
    world, page = drawn.world, drawn.page
    if "stream" not in world.processes:
        world.stream("walks:1")
    drawn.open("/draw?s=a+person+walks&model=walks%3A1")
    live = page.locator("section[aria-labelledby=live]")
    said = live.get_by_role("status")
    drawn.press(live.get_by_role("button", name="Start"))
    expect(said).to_contain_text("a person walks · took over after")
    until(page, "document.querySelector('section[aria-labelledby=live] canvas.figure')")
    live.get_by_label("Next sentence").fill("a person jumps")
    drawn.press(live.get_by_role("button", name="Say it"))
    expect(said).to_contain_text("a person jumps · took over after")
    print(f"{drawn.way}: {said.inner_text()}")
    page.wait_for_timeout(1000)
    drawn.keep("stream")
    drawn.press(live.get_by_role("button", name="Stop"))
    expect(live.get_by_role("button", name="Start")).to_be_visible()
