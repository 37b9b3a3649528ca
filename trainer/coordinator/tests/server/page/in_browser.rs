//! The page in a real browser, over a server whose every text is hostile. Needs Chromium; says that it skips where there is none.
//! `STRIDE_SCREENSHOTS=FOLDER` keeps what it shows.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use access::{Scope, Server};
use browser::{Browser, Window};
use coordinator::{Config, Handle};
use protocol::message::{
    Assignment, DesiredAssignments, FailureClass, Joined, LogBatch, MetricBatch, MetricRow, Poll, ReportOutcome,
    Submit, TaskOutcome,
};
use protocol::proof::SECRET_HEADER;
use protocol::{ArtifactKind, Manifest, Owner, RunId};
use registry::{Store, Write};
use reqwest::Method;
use serde::Serialize;
use serde_json::{Value, json};

use super::http::{start, token, tokens};
use crate::shell::{SECRET, TestResult, offer};

/// Runs if it is ever taken for markup, and turns a terminal or a line around.
pub(super) const HOSTILE: &str =
    "<img src=x onerror=\"window.hostile=1\"></script><script>window.hostile=1</script>\u{202e}\u{1b}[31m'\"&amp;";
pub(super) const PHONE: Window = Window { width: 360, height: 640, mobile: true };
pub(super) const DESK: Window = Window { width: 1280, height: 800, mobile: false };

fn pipeline(name: &str, lr: &str) -> String {
    format!("name: {name}\nseed: 1\ndataset: {{format: synthetic}}\nstages: {{vae: {{kind: train.vae, lr: {lr}}}}}\n")
}

pub(super) async fn call<T: Serialize>(
    server: &Server,
    secret: &str,
    method: Method,
    path: &str,
    body: &T,
) -> TestResult<Value> {
    let request = server.request(method, path).header(SECRET_HEADER, secret);
    let answer = request.json(body).send().await?;
    let status = answer.status();
    let text = answer.text().await?;
    assert!(status.is_success(), "{path}: {status} {text}");
    Ok(serde_json::from_str(&text).unwrap_or_default())
}

pub(super) async fn submit(server: &Server, name: &str, lr: &str) -> TestResult<RunId> {
    let text = pipeline(name, lr);
    let pipeline = pipeline::read("p.yaml", &text, &[]).map_err(|mistakes| mistakes.to_string())?;
    let source = format!("{text}# {HOSTILE}\n");
    let submit = Submit { pipeline: serde_json::to_value(pipeline)?, source, idempotency_key: None, until: None };
    let answer = call(server, SECRET, Method::POST, "/v1/runs", &submit).await?;
    Ok(answer["run"].as_str().ok_or("a run")?.into())
}

/// A run that a worker works on until it fails, with hostile texts wherever a worker may put one; and a run that waits.
pub(super) async fn fill(handle: &Handle, store: &Store) -> TestResult<[RunId; 2]> {
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let failed = submit(&server, "hostile", "1e-4").await?;
    let join = protocol::message::Join { instruction_set: HOSTILE.into(), ..offer() };
    let joined = call(&server, SECRET, Method::POST, "/v1/workers", &join).await?;
    let joined: Joined = serde_json::from_value(joined)?;
    let poll = Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: 0, leaving: false };
    let Assignment { grant, secret, .. } = loop {
        let answer = call(&server, SECRET, Method::POST, "/v1/workers/a/poll", &poll).await?;
        let desired: DesiredAssignments = serde_json::from_value(answer)?;
        if let Some(assignment) = desired.assignments.into_iter().next() {
            break assignment;
        }
    };
    let lines = (0..40).map(|line| format!("line {line} {HOSTILE}")).collect();
    let logs = LogBatch { grant: grant.clone(), first: 0, lines };
    call(&server, &secret, Method::POST, "/v1/logs", &logs).await?;
    let keys = ["loss", HOSTILE];
    let rows = (1..200_u32).flat_map(|step| {
        keys.map(|key| MetricRow { step: step.into(), key: key.to_owned(), value: 1.0 / f64::from(step) })
    });
    let rows = rows.collect();
    call(&server, &secret, Method::POST, "/v1/metrics", &MetricBatch { grant: grant.clone(), rows }).await?;
    let outcome =
        TaskOutcome::Failed { class: FailureClass::Input, message: format!("the data says {HOSTILE}\nand {HOSTILE}") };
    call(&server, &secret, Method::POST, "/v1/outcomes", &ReportOutcome::new(grant, outcome)).await?;
    let gone = json!({"incarnation": joined.incarnation});
    call(&server, SECRET, Method::POST, "/v1/workers/a/gone", &gone).await?;

    for version in 1..=3 {
        let manifest = Manifest::new(ArtifactKind::Model, json!({"version": version}));
        let artifact = store.blobs().put(&manifest.to_bytes())?;
        let metrics = BTreeMap::from([("fid".to_owned(), 1.0 / f64::from(version)), (HOSTILE.to_owned(), 2.0)]);
        let source = json!({"run": failed, "stage": "release", "metric": "fid", "mode": "min"});
        let owner = Write::ModelOwner { model: "walks".into(), owner: Owner::local("root") };
        store.write(vec![owner, Write::Version { model: "walks".into(), artifact, metrics, source }]).await?;
    }
    let promote = json!({
        "command": "promote", "reference": "walks:1", "to": "prod", "expect": null, "require": ["fid <= 1"], "reason": HOSTILE,
    });
    call(&server, SECRET, Method::POST, "/v1/registry", &promote).await?;
    Ok([failed, submit(&server, "waiting", "1e-4").await?])
}

/// Nothing of what others wrote became markup or ran, nothing came from elsewhere, and the browser has nothing to complain of.
pub(super) fn is_harmless(browser: &mut Browser, url: &str) {
    assert_eq!(browser.evaluate("window.hostile ?? null"), Value::Null, "a text ran");
    let markup = "document.querySelectorAll('#app script, #app [onerror], #app img[src=x]').length";
    assert_eq!(browser.evaluate(markup), json!(0), "a text became markup");
    let elsewhere: Vec<&str> = browser
        .requested()
        .into_iter()
        .filter(|asked| !asked.starts_with(url) && !asked.starts_with("blob:"))
        .collect();
    assert!(elsewhere.is_empty(), "{elsewhere:?}");
    let complaints = browser.complaints();
    assert!(complaints.is_empty(), "the browser complains: {complaints:?}");
}

pub(super) fn keep(browser: &mut Browser, name: &str) {
    if let Some(folder) = std::env::var_os("STRIDE_SCREENSHOTS") {
        std::fs::write(std::path::Path::new(&folder).join(name), browser.screenshot()).unwrap();
    }
}

/// Waits for a view, and looks whether it fits the window and can be read without eyes.
pub(super) fn look(browser: &mut Browser, name: &str, window: Window) {
    browser.until("document.querySelector('main h1') && !document.querySelector('.skeleton')");
    let wide =
        browser.evaluate("Math.max(document.documentElement.scrollWidth, document.querySelector('main').scrollWidth)");
    assert!(wide.as_u64().unwrap() <= window.width as u64, "{name} is {wide} wide of {}", window.width);
    let unnamed = "[...document.querySelectorAll('button, a, input, select, summary')].filter((e) => e.offsetParent && \
                   !(e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.length || e.querySelector('img[alt]'))).length";
    assert_eq!(browser.evaluate(unnamed), json!(0), "{name} has something without a name");
    for (what, count) in [("main", 1), ("nav", 1), ("header", 1), ("h1", 1)] {
        assert_eq!(
            browser.evaluate(&format!("document.querySelectorAll('#app {what}').length")),
            json!(count),
            "{name}: {what}"
        );
    }
    let wrong = browser.inaccessible();
    assert!(wrong.is_empty(), "{name}, {} wide: {wrong:#?}", window.width);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_shows_hostile_texts_as_texts_and_every_view_on_a_phone() -> TestResult {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return Ok(());
    };
    if browser::axe().is_none() {
        fixtures::skip(browser::AXE_MISSING);
    }
    let dir = tempfile::tempdir()?;
    let store_dir = dir.path().join("store");
    let config = Config { tokens: tokens(), alone: false, park: false, ..Config::embedded() };
    let store = Store::open(&store_dir, registry::Holder::this_process("a test")).await?;
    let handle = coordinator::Coordinator::start(store.clone(), config).await?;
    let runs = fill(&handle, &store).await?;
    drop(store);
    let mut browser = Browser::start(&program, dir.path());
    tokio::task::spawn_blocking(move || -> TestResult {
        let url = handle.url();
        browser.open(&handle.page_link(), PHONE);
        look(&mut browser, "now", PHONE);
        assert!(browser.evaluate("location.href").as_str().is_some_and(|at| !at.contains("key")), "the key is gone");
        assert_eq!(browser.evaluate("document.cookie"), json!(""), "no script reads the session");
        browser.until("document.body.innerText.includes('waits for 1 worker')");
        browser.until("document.body.innerText.includes('<img src=x')");
        keep(&mut browser, "now-phone.png");

        // From a link to a failed run: the cause is in sight, and Resume is there to be pressed.
        let [failed, waiting] = &runs;
        browser.go(&format!("{url}/runs/{failed}"));
        look(&mut browser, "run", PHONE);
        browser.until("document.querySelector('.cause button.main')");
        let (resume, bar) = (browser.places(".cause button.main"), browser.places("nav.places"));
        assert!(resume[0][3] <= bar[0][1] && resume[0][0] >= 0.0 && resume[0][3] - resume[0][1] >= 44.0, "{resume:?}");
        browser.until("document.querySelectorAll('.cause .line').length > 5");
        keep(&mut browser, "failed-phone.png");

        let mut seen = 0;
        for window in [DESK, PHONE] {
            browser.resize(window);
            for (name, path, text) in [
                ("now", "/".to_owned(), "Wants you"),
                ("runs", "/runs".to_owned(), "the data says"),
                ("run", format!("/runs/{failed}"), "the data says"),
                ("waiting", format!("/runs/{waiting}"), "trainer worker join"),
                ("stage", format!("/runs/{failed}/dataset"), "line 39"),
                ("models", "/models".to_owned(), "walks"),
                ("model", "/models/walks".to_owned(), "version"),
                ("workers", "/workers".to_owned(), "trainer worker join"),
                ("store", "/store".to_owned(), "Who did what"),
            ] {
                for dark in [false, true] {
                    browser.prefer_dark(dark);
                    browser.go(&format!("{url}{path}"));
                    look(&mut browser, name, window);
                    browser.until(&format!("document.querySelector('#app').textContent.includes('{text}')"));
                    let theme = if dark { "dark" } else { "light" };
                    keep(&mut browser, &format!("{name}-{}-{theme}.png", window.width));
                    seen += 1;
                }
            }
        }
        is_harmless(&mut browser, &url);
        println!("{seen} views seen");

        // The curve of the stage is drawn, under whatever name.
        browser.resize(DESK);
        browser.go(&format!("{url}/runs/{failed}/dataset"));
        browser.until("document.querySelectorAll('.u-wrap canvas').length === 2");

        // By keyboard: a filter, a run, and its Resume.
        browser.go(&format!("{url}/"));
        look(&mut browser, "now", DESK);
        browser.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', {key: '/', bubbles: true}))");
        browser.until("location.pathname === '/runs' && document.querySelector('input[type=search]')");
        browser.evaluate("document.querySelector('input[type=search]').focus()");
        browser.write("hostile data says");
        browser.until(&format!("document.querySelectorAll('tbody tr').length === 1 && document.body.innerText.includes('{failed}')"));
        browser.evaluate("document.querySelector('tbody a').focus()");
        browser.press("Enter");
        browser.until(&format!("location.pathname === '/runs/{failed}' && document.querySelector('.cause button.main')"));
        browser.evaluate("document.querySelector('.cause button.main').focus()");
        browser.press("Enter");
        browser.until("document.querySelector('.head .badge').textContent.includes('running')");

        // A promotion: a reason is needed, and it is in the log of moves.
        browser.go(&format!("{url}/models/walks"));
        browser.until("[...document.querySelectorAll('button')].some((button) => button.textContent === 'Promote')");
        browser.evaluate("[...document.querySelectorAll('button')].find((button) => button.textContent === 'Promote').click()");
        browser.until("document.querySelector('dialog').open");
        browser.evaluate("document.querySelector('#alias').focus(); document.querySelector('#alias').select()");
        browser.write("prod");
        browser.evaluate("document.querySelector('dialog form').requestSubmit()");
        assert_eq!(browser.evaluate("document.querySelector('dialog').open"), json!(true), "without a reason nothing moves");
        browser.evaluate("document.querySelector('#reason').focus()");
        browser.write("fewer sliding feet");
        browser.press("Enter");
        browser.until("!document.querySelector('dialog').open && document.querySelector('.moves').textContent.includes('fewer sliding feet')");

        // One who only reads has no button that it may not press.
        browser.evaluate("document.querySelector('details.menu').open = true; document.querySelector('.sheet button').click()");
        browser.until("document.querySelector('#token')");
        browser.write("a-token-that-nobody-has");
        browser.press("Enter");
        browser.until("document.querySelector('[role=alert]')");
        browser.evaluate("document.querySelector('#token').value = ''");
        browser.write(&token(Scope::Read));
        browser.press("Enter");
        for (path, text) in [("/", "waiting"), ("/models/walks", "fewer"), (&format!("/runs/{failed}"), "Pipeline"), ("/draw", "needs a token"), ("/store", "scope")] {
            browser.until("document.querySelector('main h1')");
            browser.evaluate(&format!("history.pushState(null, '', '{path}'); dispatchEvent(new PopStateEvent('popstate'))"));
            browser.until(&format!("document.querySelector('main')?.textContent.includes('{text}')"));
            let pressed = "[...document.querySelectorAll('main button')].map((e) => e.textContent.trim()).filter((text) => \
                           /Resume|Pause|Cancel|Promote|Roll|Check|can go|Draw/.test(text)).join()";
            assert_eq!(browser.evaluate(pressed), json!(""), "{path}");
        }

        // The server goes under the open page, which says so, and goes on.
        let port = handle.address().port();
        let again = tokio::runtime::Handle::current();
        again.block_on(handle.shutdown());
        browser.until("document.querySelector('.banner')?.textContent.includes('does not answer')");
        let config = Config { listen: SocketAddr::from(([127, 0, 0, 1], port)), tokens: tokens(), ..Config::embedded() };
        let handle = again.block_on(start(&store_dir, config));
        browser.until("!document.querySelector('.banner') && document.querySelector('.live').textContent.includes('live')");
        assert_eq!(browser.evaluate("document.querySelector('.who').textContent.includes('the-read')"), json!(true));
        again.block_on(handle.shutdown());
        Ok(())
    })
    .await?
}
