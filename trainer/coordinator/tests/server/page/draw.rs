//! The playground in a real browser. No worker computes here: results are stored beforehand.

use std::collections::BTreeMap;

use access::Server;
use browser::Browser;
use coordinator::Config;
use coordinator::shell::Drawing;
use protocol::artifact::FileEntry;
use protocol::{ArtifactKind, Manifest, Owner};
use registry::{Holder, Store, Write};
use reqwest::Method;
use serde_json::{Value, json};

use super::clips::{artifact, compute, themes};
use super::http::tokens;
use super::in_browser::{DESK, HOSTILE, is_harmless, keep};
use crate::shell::TestResult;

/// Two joints that stand still for two seconds, in the viewer's form.
fn motions() -> Value {
    let motion = json!({
        "body": 0, "fps": 20, "frames": 41, "step": 1e-4, "origin": [0, 0, 0], "waypoints": [],
        "joints": "AAAA".repeat(41 * 4), "measures": {"skating": 0.125, "jerk": 21.25},
    });
    json!({"bodies": [{"parents": [0, 0], "sides": "ml", "head": null}], "motions": [motion], "captions": [HOSTILE]})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_draws_with_several_models() -> TestResult {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return Ok(());
    };
    let dir = tempfile::tempdir()?;
    let config = Config { tokens: tokens(), alone: false, park: false, ..Config::embedded() };
    let store = Store::open(&dir.path().join("store"), Holder::this_process("a test")).await?;
    let handle = coordinator::Coordinator::start(store.clone(), config).await?;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let meta = json!({"generator": "latent-diffusion", "format": "humanml3d", "parts": {}});
    for (version, metric) in [(1, 2.0), (2, 1.0)] {
        let mut manifest = Manifest::new(ArtifactKind::Model, meta.clone());
        manifest
            .files
            .insert("x".into(), FileEntry { bytes: 1, digest: store.blobs().put(&[version])?, chunks: Vec::new() });
        let artifact = store.blobs().put(&manifest.to_bytes())?;
        let own = Write::ModelOwner { model: "walks".into(), owner: Owner::local("root") };
        let metrics = BTreeMap::from([("fid".to_owned(), metric)]);
        let source = json!({"metric": "fid", "mode": "min"});
        store.write(vec![own, Write::Version { model: "walks".into(), artifact, metrics, source }]).await?;
    }
    let promote = json!({"command": "promote", "reference": "walks:1", "to": "prod", "expect": null, "require": [], "reason": "first"});
    server.request(Method::POST, "/v1/registry").json(&promote).send().await?.error_for_status()?;
    let report = artifact(
        &store,
        ArtifactKind::Report,
        &[
            ("motions.json", motions().to_string().into_bytes()),
            ("motion-00.bvh", b"HIERARCHY".to_vec()),
            ("motions.html", b"<!DOCTYPE html><script>window.hostile=1</script>".to_vec()),
        ],
    )?;
    for model in ["walks:1", "walks:2"] {
        let asked = json!({"models": [model], "sentences": ["a person waves"], "seed": 3});
        let answer = server.request(Method::POST, "/v1/draws").json(&asked).send().await?;
        let Drawing { run, stages } = answer.error_for_status()?.json().await?;
        compute(&server, &store, run.as_str(), stages[0].as_str(), ("report", report)).await?;
    }
    drop(store);

    let mut browser = Browser::start(&program, dir.path());
    let (url, link) = (handle.url(), handle.page_link());
    tokio::task::spawn_blocking(move || -> TestResult {
        browser.open(&link, DESK);
        browser.until("document.querySelector('main h1')");

        // From a model to its motion in two presses.
        browser.go(&format!("{url}/models/walks"));
        browser.until("[...document.querySelectorAll('a.button')].some((a) => a.textContent === 'Draw')");
        browser.evaluate("[...document.querySelectorAll('a.button')].find((a) => a.textContent === 'Draw').click()");
        browser.until("document.querySelector('.playground textarea')");
        browser.evaluate("document.querySelector('#sentence').focus(); document.querySelector('#sentence').select()");
        browser.write("a person waves");
        // A link fills the form; only a press draws.
        browser.go(&format!("{url}/draw?s=a+person+waves&model=walks:2&model=walks:1&seed=3"));
        browser.until("document.querySelector('.playground button.main')");
        assert_eq!(browser.evaluate("document.querySelector('#sentence').value"), json!("a person waves"));
        assert_eq!(browser.evaluate("document.querySelector('.playground button.main').textContent"), json!("Draw"));
        assert_eq!(browser.evaluate("document.querySelector('main p[role=status], main canvas.figure, main .want') === null"), json!(true));
        browser.evaluate("document.querySelector('.playground button.main').focus()");
        browser.press("Enter");
        browser.until("document.querySelectorAll('canvas.figure').length === 2 && document.querySelectorAll('canvas.strip').length === 2");
        browser.until("document.querySelector('main').textContent.includes('Drawn before')");
        assert_eq!(browser.evaluate("document.querySelectorAll('.measures')[0].textContent"), json!("feet slide in 12.5 % of the steps · jerk 21.3 m/s³"));
        let links = "[...document.querySelectorAll('main a[download]')].map((link) => link.download)";
        let named = ["walks-2-a-person-waves-3.bvh", "walks-1-a-person-waves-3.bvh", "walks-2-motions-3.html", "walks-1-motions-3.html"];
        assert_eq!(browser.evaluate(links), json!(named));
        let saved = "fetch(document.querySelector('.files a').href).then((answer) => answer.text())";
        assert_eq!(browser.evaluate(saved), json!("HIERARCHY"));
        themes(&mut browser, "draw");

        // By keyboard: stop, a frame on, a loop of a part, all of it, one motion over the other.
        browser.evaluate("document.querySelector('.viewer-bar .play').focus(); if (document.querySelector('.viewer-bar .play').textContent === 'Stop') document.querySelector('.viewer-bar .play').click()");
        browser.press("Home");
        browser.until("document.querySelector('.clock').textContent.startsWith('0.00 of 2.00 s')");
        for _ in 0..10 {
            browser.press("ArrowRight");
        }
        browser.until("document.querySelector('.clock').textContent.endsWith('frame 10')");
        assert_eq!(browser.evaluate("document.querySelector('.viewer-bar .all').hidden"), json!(true));
        browser.press("i");
        browser.until("!document.querySelector('.viewer-bar .all').hidden");
        browser.press("End");
        browser.press("ArrowLeft");
        browser.press("o");
        browser.evaluate("document.querySelector('.viewer-bar .play').click()");
        let clock = "Number(document.querySelector('.clock').textContent.split(' ')[0])";
        browser.until(&format!("{clock} >= 0.5 && {clock} < 1.9"));
        browser.press("u");
        browser.until("document.querySelector('.viewer-bar .all').hidden");
        browser.evaluate("document.querySelector('.viewer-bar .over').click()");

        // The address is the draw, and a sentence of a link stays a word of the command.
        assert_eq!(browser.evaluate("location.search"), json!("?s=a+person+waves&model=walks%3A2&model=walks%3A1&seed=3"));
        let command = "document.querySelector('section[aria-labelledby=take] .command code').textContent";
        assert_eq!(browser.evaluate(command), json!("trainer generate 'a person waves' --model 'walks:2' --seed 3 -o motion.bvh"));

        // A path by keyboard, and another by mouse in its place. It is in the address of the draw.
        browser.evaluate("document.querySelector('details.way').open = true; document.querySelector('.floor').focus()");
        for key in ["ArrowUp", "ArrowUp", "ArrowLeft"] {
            browser.press(key);
        }
        let says = |path: &str| format!("document.querySelector('.floor').getAttribute('aria-label').includes('{path}.')");
        browser.until(&says("a path of 1.5 m"));
        browser.press("Backspace");
        browser.until(&says("a path of 1.0 m"));
        themes(&mut browser, "path");
        browser.evaluate("document.querySelector('.floor').scrollIntoView({block: 'center'})");
        let [left, top, right, bottom] = browser.places(".floor")[0];
        // From above: six metres wide, and the figure starts a metre above the lower edge.
        let at = |x: f64, z: f64| [left + (3.0 - x) / 6.0 * (right - left), top + (5.0 - z) / 6.0 * (bottom - top)];
        let events = [("mousePressed", at(0.0, 0.5)), ("mouseMoved", at(0.0, 1.0)), ("mouseMoved", at(-1.0, 1.0)), ("mouseReleased", at(-1.0, 1.0))];
        for (kind, [x, y]) in events {
            let event = json!({"type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1});
            browser.call("Input.dispatchMouseEvent", &event);
        }
        browser.until(&says("a path of 2.0 m"));
        keep(&mut browser, "path-drawn.png");
        browser.evaluate("document.querySelector('.playground button.main').focus()");
        browser.press("Enter");
        browser.until("new URLSearchParams(location.search).get('path')?.split(' ').length === 3");

        // A draw without a worker waits for one, and the page says how one joins.
        browser.go(&format!("{url}/draw?s=a+new+sentence&model=walks:1"));
        browser.until("document.querySelector('.playground button.main')");
        browser.evaluate("document.querySelector('.playground button.main').click()");
        browser.until("document.querySelector('.want .command')?.textContent.includes('trainer worker join')");

        is_harmless(&mut browser, &url);
        Ok(())
    })
    .await??;
    handle.shutdown().await;
    Ok(())
}
