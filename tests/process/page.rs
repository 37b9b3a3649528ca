//! The page over real runs, as a new user meets it: signed in with a token, from a desk and from a phone.
//! `STRIDE_SCREENSHOTS=FOLDER` keeps README's pictures.

use std::path::Path;

use browser::{Browser, Window};
use cluster_tests::Bench;
use cluster_tests::cluster::{Cluster, TOKEN};
use serde_json::json;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const DESK: Window = Window { width: 1280, height: 800, mobile: false };
const PHONE: Window = Window { width: 390, height: 844, mobile: true };

/// Waits until a view is drawn, checks that it fits its window, and keeps its picture.
fn keep(browser: &mut Browser, name: &str, window: Window) {
    browser.until("document.querySelector('main h1') && !document.querySelector('.skeleton')");
    let wide = browser.evaluate("document.documentElement.scrollWidth").as_u64().expect("a number");
    assert!(wide <= window.width as u64, "{name} is {wide} wide of {}", window.width);
    let wrong = browser.inaccessible();
    assert!(wrong.is_empty(), "{name}: {wrong:#?}");
    if let Some(folder) = std::env::var_os("STRIDE_SCREENSHOTS") {
        std::fs::write(Path::new(&folder).join(name), browser.screenshot()).expect("a folder for pictures");
    }
}

#[test]
fn a_run_and_the_next_one_are_seen_on_the_page() {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return;
    };
    let config = Bench::config("smoke.yaml");
    let mut cluster = Cluster::start(TRAINER);
    ["a", "b"].into_iter().for_each(|name| cluster.join(name));
    let steps = ["--set", "stages.vae.steps=60", "--set", "stages.pcm.steps=40"];
    let keeps = ["--set", "stages.mld.checkpoint.keep={latest: 4, ended: 4}"];
    let steps = [&steps[..], &keeps].concat();
    let first = cluster.submit(Path::new(&config), &steps);
    cluster.wait_end(&first);
    let faster = [&steps[..], &["--set", "stages.pcm.lr=1e-3"]].concat();
    let second = cluster.submit(Path::new(&config), &faster);
    cluster.wait_end(&second);

    let (url, folder) = (cluster.url(), tempfile::tempdir().expect("a folder"));
    let mut browser = Browser::start(&program, folder.path());
    browser.open(&url, DESK);
    browser.until("document.querySelector('#token')");
    browser.write(TOKEN);
    browser.press("Enter");
    browser.until(&format!("document.querySelector('main')?.textContent.includes('{second}')"));
    // Before the sign-in one call is refused, as it must be.
    let before = browser.complaints().len();

    // Only what depends on the changed setting ran again, and the page names the setting.
    browser.go(&format!("{url}/runs/{second}"));
    browser.until("[...document.querySelectorAll('.because')].some((e) => e.textContent.includes('lr 5e-4 -> 1e-3'))");
    browser.until("document.querySelectorAll('.u-wrap canvas').length > 0");
    let beyond = "[...document.querySelectorAll('a.node')].filter((node) => { const box = node.querySelector('.box').getBBox(); \
                  return [...node.querySelectorAll('text')].some((text) => text.getBBox().x + text.getBBox().width > box.x + box.width); \
                  }).length";
    assert_eq!(browser.evaluate(beyond), json!(0), "a text leaves its box");
    keep(&mut browser, "run.png", DESK);
    browser.go(&format!("{url}/compare?run={first}&run={second}"));
    browser.until("document.querySelector('table.beside') && document.querySelector('.u-wrap canvas')");
    let rows =
        "[...document.querySelectorAll('section[aria-labelledby=settings] tbody tr')].map((row) => row.textContent)";
    assert_eq!(browser.evaluate(rows), json!(["pcm.lr5e-41e-3"]), "one setting differs");
    keep(&mut browser, "compare.png", DESK);
    browser.go(&format!("{url}/workers"));
    browser.until("document.querySelectorAll('.lanes .lane-bar').length > 5");
    keep(&mut browser, "workers.png", DESK);
    browser.resize(PHONE);
    browser.go(&format!("{url}/models/smoke"));
    browser.until("document.querySelector('main')?.textContent.includes('staging')");
    keep(&mut browser, "model-phone.png", PHONE);

    // From the model to a motion in two presses; then both versions beside each other by a link.
    browser.resize(DESK);
    browser.go(&format!("{url}/models/smoke"));
    let drawing = "[...document.querySelectorAll('a.button')].find((link) => link.textContent === 'Draw')";
    browser.until(drawing);
    browser.evaluate(&format!("{drawing}.click()"));
    browser.until("document.querySelector('.playground button.main')");
    browser.evaluate("document.querySelector('.playground button.main').focus()");
    browser.press("Enter");
    browser.until(
        "document.querySelector('canvas.figure') && document.querySelector('.measures').textContent.includes('jerk')",
    );
    browser.go(&format!("{url}/draw?s=a+person+walks+in+a+circle&model=smoke:1&model=smoke:2&seed=4&seconds=4"));
    browser.until("document.querySelector('.playground button.main')");
    browser.evaluate("document.querySelector('.playground button.main').click()");
    browser.until(
        "document.querySelectorAll('canvas.figure').length === 2 && document.querySelectorAll('.files a').length === 6",
    );
    let saved = "fetch(document.querySelector('.files a[download$=glb]').href).then((answer) => answer.text()).then((text) => text.slice(0, 4))";
    assert_eq!(browser.evaluate(saved), json!("glTF"));
    keep(&mut browser, "draw.png", DESK);
    browser.resize(PHONE);
    keep(&mut browser, "draw-phone.png", PHONE);

    // Each checkpoint that is kept draws the same sentence without being asked for, once it is near the screen.
    browser.resize(DESK);
    browser.go(&format!("{url}/runs/{first}/mld"));
    browser.until("document.querySelector('section[aria-labelledby=kept]')");
    browser.evaluate("document.querySelector('section[aria-labelledby=kept]').scrollIntoView()");
    browser.until("document.querySelectorAll('svg.still').length === 4");
    let memory = "[...document.querySelectorAll('.fact')].some((fact) => /^Memory[0-9.]+ [MG]iB$/.test(fact.textContent.trim()))";
    assert_eq!(browser.evaluate(memory), json!(true), "the most memory that it had");
    browser.evaluate("document.querySelector('section[aria-labelledby=kept]').scrollIntoView()");
    keep(&mut browser, "checkpoints.png", DESK);
    browser.resize(PHONE);
    keep(&mut browser, "checkpoints-phone.png", PHONE);
    // A second visit to the view shows the same draw, and makes no new run.
    let draws =
        "fetch('/v1/runs?pipeline=draw&limit=200').then((answer) => answer.json()).then(({ items }) => items.length)";
    let before_again = browser.evaluate(draws);
    browser.go(&format!("{url}/runs/{first}/mld"));
    browser.until("document.querySelector('section[aria-labelledby=kept]')");
    browser.evaluate("document.querySelector('section[aria-labelledby=kept]').scrollIntoView()");
    browser.until("document.querySelectorAll('svg.still').length === 4");
    assert_eq!(browser.evaluate(draws), before_again);
    let complaints = browser.complaints();
    assert_eq!(complaints.len(), before, "{complaints:#?}");
}
