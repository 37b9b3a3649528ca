//! Runs beside each other, in a real browser: what changed since the last run, several in one chart, sweeps and time lines.

use access::Server;
use browser::Browser;
use coordinator::Config;
use coordinator::shell::RunSettings;
use registry::{Holder, Store};
use serde_json::{Value, json};

use super::http::tokens;
use super::in_browser::{DESK, HOSTILE, PHONE, fill, is_harmless, keep, look, submit};
use crate::shell::TestResult;

/// A sweep as the server describes it.
fn sweep() -> Value {
    let trial = |trial: u32, lr: f64, state: &str, results: &[f64]| json!({"trial": trial, "values": {"lr": lr, (HOSTILE): HOSTILE}, "state": state, "steps": 100, "results": results});
    json!({
        "stage": "vae", "search": "halving", "metric": "loss", "mode": "min", "rungs": [100, 300], "over": true,
        "spent": 700, "planned": 900, "full": 900, "best": 2,
        "trials": [trial(0, 1e-2, "stopped", &[3.0]), trial(1, 1e-3, "finished", &[2.0, 1.5]), trial(2, 1e-4, "finished", &[2.5, 0.5])],
    })
}

/// Loads a module of the page and runs `then` with it.
fn with_module(browser: &mut Browser, name: &str, then: &str) -> Value {
    let folder = page::folder();
    browser.evaluate(&format!("import('/page/{folder}/{name}').then({then})"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_compares_runs_sweeps_and_times() -> TestResult {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return Ok(());
    };
    let dir = tempfile::tempdir()?;
    let config = Config { tokens: tokens(), alone: false, park: false, ..Config::embedded() };
    let store = Store::open(&dir.path().join("store"), Holder::this_process("a test")).await?;
    let handle = coordinator::Coordinator::start(store.clone(), config).await?;
    let [failed, _] = fill(&handle, &store).await?;
    drop(store);
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let again = submit(&server, "hostile", "2e-4").await?;

    let answer = server.request(reqwest::Method::GET, &format!("/v1/runs/{again}/settings")).send().await?;
    let settings: RunSettings = answer.json().await?;
    assert_eq!(settings.previous.as_ref(), Some(&failed), "runs of other pipelines stand between them");
    let names: Vec<&str> = settings.stages.iter().map(|stage| stage.stage.as_str()).collect();
    assert_eq!(names, ["dataset", "vae"]);
    assert_eq!(settings.stages[1].settings["lr"], json!(2e-4));
    assert!(settings.source.contains("lr: 2e-4"), "{}", settings.source);

    let mut browser = Browser::start(&program, dir.path());
    let url = handle.url();
    let link = handle.page_link();
    tokio::task::spawn_blocking(move || -> TestResult {
        browser.open(&link, DESK);
        browser.until("document.querySelector('main h1')");

        // The difference to the last run of the pipeline, and from there both beside each other.
        browser.go(&format!("{url}/runs/{again}"));
        look(&mut browser, "run", DESK);
        browser.until("document.querySelector('td.fresh')");
        assert_eq!(browser.evaluate("document.querySelector('td.old').textContent + ' ' + document.querySelector('td.fresh').textContent"), json!("1e-4 2e-4"));
        assert_eq!(browser.evaluate("document.querySelectorAll('td.fresh').length"), json!(1), "only what differs");
        browser.until("[...document.querySelectorAll('.because')].some((e) => e.textContent.includes('lr 1e-4 -> 2e-4'))");
        browser.evaluate("[...document.querySelectorAll('a.button')].find((a) => a.textContent.startsWith('Compare with')).click()");
        browser.until("location.pathname === '/compare' && document.querySelectorAll('.beside-runs li').length === 2");

        // Or two that are ticked among all runs.
        browser.resize(PHONE);
        browser.go(&format!("{url}/runs"));
        look(&mut browser, "runs", PHONE);
        for run in [&failed, &again] {
            browser.evaluate(&format!("[...document.querySelectorAll('td.tick label')].find((l) => l.textContent.includes('{run}')).click()"));
        }
        browser.until("document.querySelector('.tray button.main:not([disabled])')");
        browser.evaluate("document.querySelector('.tray button.main').click()");
        browser.until("document.querySelector('table.beside') && document.querySelector('.u-wrap canvas')");
        for (window, dark) in [(PHONE, true), (PHONE, false), (DESK, true), (DESK, false)] {
            browser.resize(window);
            browser.prefer_dark(dark);
            look(&mut browser, "compare", window);
            let theme = if dark { "dark" } else { "light" };
            keep(&mut browser, &format!("compare-{}-{theme}.png", window.width));
        }
        let rows = "[...document.querySelectorAll('section[aria-labelledby=settings] tbody tr')].map((row) => row.textContent)";
        assert_eq!(browser.evaluate(rows), json!(["vae.lr1e-42e-4"]), "one setting differs");
        browser.evaluate("document.querySelectorAll('.beside-runs button')[1].click()");
        browser.until("document.querySelectorAll('.beside-runs li').length === 1 && new URLSearchParams(location.search).getAll('run').length === 1");

        // A sweep: the best is named; a range of an axis is marked by keyboard, and the others step back.
        let draw = format!(
            "async ({{ sweepView }}) => {{ const {{ html, render }} = await import('/page/{}/vendor/lit-html.js'); \
             const place = document.querySelector('main').appendChild(document.createElement('section')); place.id = 'sweep-test'; \
             const context = {{ draw: () => render(sweepView({{ run: 'r', stages: [] }}, {}, context), place) }}; context.draw(); \
             return document.querySelector('.winner').textContent; }}",
            page::folder(),
            sweep()
        );
        let says = with_module(&mut browser, "sweep.js", &draw);
        assert!(says.as_str().is_some_and(|says| says.contains("Trial 2 is best: loss 0.5")), "{says}");
        assert_eq!(browser.evaluate("[...document.querySelectorAll('#sweep-test .fell')].map((e) => e.textContent)"), json!(["1 stopped"]));
        browser.evaluate("document.querySelector('#sweep-test .grip[aria-label^=\"lr,\"]').focus()");
        for _ in 0..4 {
            browser.press("ArrowUp");
        }
        browser.until("document.querySelector('#sweep-test caption').textContent.includes('2 of 3')");
        browser.press("Escape");
        browser.until("document.querySelector('#sweep-test caption').textContent.startsWith('3 trials')");

        // Two hours of work a day apart: the day between them takes little room.
        let squeezed = "({ squeeze }) => { const hour = 3600e3; const { place, gaps } = squeeze([{ from: 0, to: hour }, { from: 25 * hour, to: 26 * hour }], [0, 26 * hour]); \
                        return [gaps.length, place(hour) > 0.4, place(25 * hour) < 0.6, place(0), place(26 * hour) > 0.99]; }";
        assert_eq!(with_module(&mut browser, "lanes.js", squeezed), json!([1, true, true, 0, true]));
        // A worker that is lost holds its task no more; one that is taken in does.
        let lanes = "({ lanesOf }) => lanesOf([['joined', 'a'], ['granted', 'a'], ['granted', 'b'], ['lost', 'b'], ['regrouped', null], ['adopted', 'c'], ['finished', null]] \
                     .map(([kind, worker], id) => ({ id, at_ms: id * 1000, kind, worker: worker ?? undefined, run: 'r', stage: 's' })), 9000) \
                     .map((lane) => [lane.name, lane.bars.map(({ from, to }) => [from / 1000, to / 1000]), lane.marks.map((mark) => mark.sign).join('')])";
        assert_eq!(
            with_module(&mut browser, "views/workers.js", lanes),
            json!([["a", [[1, 6]], "▸↻"], ["b", [[2, 3]], "✕"], ["c", [[5, 6]], "+"]])
        );
        browser.go(&format!("{url}/workers"));
        look(&mut browser, "workers", DESK);
        browser.until("document.querySelector('.lanes .lane-bar') && document.querySelector('.events')");
        keep(&mut browser, "lanes-1280.png");
        is_harmless(&mut browser, &url);
        Ok(())
    })
    .await??;
    handle.shutdown().await;
    Ok(())
}
