//! The clips of a dataset in a real browser. No worker computes here: the dataset is stored beforehand.

use std::collections::BTreeMap;

use access::Server;
use browser::{Browser, Window};
use coordinator::Config;
use protocol::artifact::FileEntry;
use protocol::message::RunView;
use protocol::{ArtifactKind, Digest, Manifest};
use registry::{Holder, Store, Write};
use reqwest::Method;
use serde_json::json;

use super::http::tokens;
use super::in_browser::{DESK, HOSTILE, PHONE, is_harmless, keep, look, submit};
use crate::shell::TestResult;

pub(super) fn artifact(store: &Store, kind: ArtifactKind, files: &[(&str, Vec<u8>)]) -> TestResult<Digest> {
    let mut manifest = Manifest::new(kind, json!({}));
    for (name, bytes) in files {
        let entry = FileEntry { bytes: bytes.len() as u64, digest: store.blobs().put(bytes)?, chunks: Vec::new() };
        manifest.files.insert((*name).to_owned(), entry);
    }
    Ok(store.blobs().put(&manifest.to_bytes())?)
}

/// Stores a value for the only stage of a run that waits, under its key.
pub(super) async fn compute(
    server: &Server,
    store: &Store,
    run: &str,
    stage: &str,
    output: (&str, Digest),
) -> TestResult {
    let view: RunView = server.request(Method::GET, &format!("/v1/runs/{run}")).send().await?.json().await?;
    let stage = view.stages.iter().find(|known| known.name.as_str() == stage).ok_or("a stage")?;
    store
        .write(vec![Write::StageResult {
            grant: None,
            key: stage.key.ok_or("its key is known")?,
            run: run.into(),
            stage: stage.name.clone(),
            kind: stage.kind.clone(),
            outputs: BTreeMap::from([(output.0.to_owned(), output.1)]),
            metrics: BTreeMap::from([("skating".to_owned(), 0.07)]),
            inputs: BTreeMap::new(),
            wall_s: 0.5,
        }])
        .await?;
    let answer = server.request(Method::POST, &format!("/v1/runs/{run}/cancel")).send().await?;
    assert!(answer.status().is_success());
    Ok(())
}

/// A dataset of one clip of HumanML3D that stands.
fn dataset(store: &Store) -> TestResult<Digest> {
    let frames = 40;
    let index = json!({
        "version": 1, "format": "humanml3d", "mean": [], "std": [],
        "clips": [{"id": HOSTILE, "frames": frames, "shard": 0}],
        "captions": [{"text": HOSTILE, "tokens": [], "from_s": 0, "to_s": 0}, {"text": "a person stands", "tokens": [], "from_s": 0, "to_s": 0}],
        "entries": [
            {"id": "one", "clip": 0, "start": 0, "len": frames, "captions": [1], "split": "train"},
            {"id": "part", "clip": 0, "start": 8, "len": 16, "captions": [0], "split": "test"},
        ],
    });
    let rows = vec![0_u8; frames * 263 * 4];
    let head =
        json!({"c0000000": {"dtype": "F32", "shape": [frames, 263], "data_offsets": [0, rows.len()]}}).to_string();
    let shard = [&(head.len() as u64).to_le_bytes()[..], head.as_bytes(), &rows].concat();
    let files = [("dataset.json", index.to_string().into_bytes()), ("clips-0000.safetensors", shard)];
    artifact(store, ArtifactKind::Dataset, &files)
}

pub(super) fn themes(browser: &mut Browser, name: &str) {
    for (window, dark) in [(PHONE, false), (PHONE, true), (DESK, true), (DESK, false)] {
        let Window { width, .. } = window;
        browser.resize(window);
        browser.prefer_dark(dark);
        look(browser, name, window);
        keep(browser, &format!("{name}-{width}-{}.png", if dark { "dark" } else { "light" }));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_browser_finds_and_plays_clips() -> TestResult {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return Ok(());
    };
    let dir = tempfile::tempdir()?;
    let config = Config { tokens: tokens(), alone: false, park: false, ..Config::embedded() };
    let store = Store::open(&dir.path().join("store"), Holder::this_process("a test")).await?;
    let handle = coordinator::Coordinator::start(store.clone(), config).await?;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    let clips = dataset(&store)?;
    let first = submit(&server, "data", "1e-4").await?;
    compute(&server, &store, first.as_str(), "dataset", ("dataset", clips)).await?;
    submit(&server, "data", "1e-4").await?;
    drop(store);

    let mut browser = Browser::start(&program, dir.path());
    let (url, link) = (handle.url(), handle.page_link());
    tokio::task::spawn_blocking(move || -> TestResult {
        browser.open(&link, DESK);
        browser.until("document.querySelector('main h1')");
        browser.go(&format!("{url}/data"));
        browser.until(&format!("document.querySelector('a[href=\"/data/{}\"]')", clips.to_string().replace(':', "%3A")));
        look(&mut browser, "datasets", DESK);
        browser.evaluate("document.querySelector('tbody a').click()");
        browser.until("document.querySelectorAll('.clips li').length === 2");
        browser.evaluate("document.querySelector('input[type=search]').focus()");
        browser.write("stands");
        browser.until("document.querySelectorAll('.clips li').length === 1");
        browser.evaluate("document.querySelector('.clips button').click()");
        browser.until("document.querySelector('canvas.figure') && document.querySelector('.clips .playing')");
        browser.until("document.querySelector('.viewer figcaption').textContent.includes('a person stands')");
        themes(&mut browser, "clips");
        browser.evaluate("[...document.querySelectorAll('.clip-filters button')].find((button) => button.textContent === 'test').click()");
        browser.until("document.querySelectorAll('.clips li').length === 0");
        is_harmless(&mut browser, &url);
        Ok(())
    })
    .await??;
    handle.shutdown().await;
    Ok(())
}
