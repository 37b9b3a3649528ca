//! A test hub on a loopback port, with small files of both kinds (named by their SHA-256 and served from another host;
//! or not), and the resulting cache.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::response::Response;
use hub::{Encoder, Hub, HubError, Name, Settings};
use protocol::Digest;

const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
const TOKEN: &str = "hf_ours";

/// Contents of the hub, and the requests it received.
#[derive(Default)]
struct World {
    files: BTreeMap<String, Vec<u8>>,
    /// Method, path, and the token of each request.
    asked: Vec<(String, String, Option<String>)>,
    /// The parts of files that were asked for.
    ranges: Vec<String>,
    /// A file that is served with other bytes than its name declares.
    damaged: Option<String>,
    /// Address of the host of large files.
    elsewhere: String,
    wants_token: bool,
}

type Shared = Arc<Mutex<World>>;

fn is_large(name: &str) -> bool {
    name.ends_with(".safetensors") || name.ends_with(".bin")
}

async fn answer(State(world): State<Shared>, request: Request) -> Response {
    let mut world = world.lock().expect("nobody panics with it");
    let path = request.uri().path().to_owned();
    let token = request.headers().get(header::AUTHORIZATION).map(|value| value.to_str().expect("text").to_owned());
    world.asked.push((request.method().to_string(), path.clone(), token.clone()));
    let status = |status: StatusCode| Response::builder().status(status).body(Body::empty()).expect("an answer");
    if world.wants_token && token.as_deref() != Some("Bearer hf_ours") && !path.starts_with("/large/") {
        return status(StatusCode::UNAUTHORIZED);
    }
    if let Some(revision) = path.strip_prefix("/api/models/org/small/revision/") {
        if revision != "main" && revision != COMMIT {
            return status(StatusCode::NOT_FOUND);
        }
        let siblings: Vec<_> = world.files.keys().map(|name| serde_json::json!({"rfilename": name})).collect();
        let listing = serde_json::json!({"sha": COMMIT, "siblings": siblings}).to_string();
        return Response::new(Body::from(listing));
    }
    let (name, at_hub) =
        match (path.strip_prefix("/large/"), path.strip_prefix(&format!("/org/small/resolve/{COMMIT}/"))) {
            (Some(name), _) => (name, false),
            (None, Some(name)) => (name, true),
            (None, None) => return status(StatusCode::NOT_FOUND),
        };
    let Some(bytes) = world.files.get(name).cloned() else { return status(StatusCode::NOT_FOUND) };
    let response = Response::builder();
    if at_hub && is_large(name) {
        let location = format!("{}/large/{name}", world.elsewhere);
        let etag = format!("\"{}\"", Digest::of(&bytes).hex());
        let response = response.status(StatusCode::FOUND).header(header::LOCATION, location);
        return response.header("x-linked-etag", etag).body(Body::empty()).expect("an answer");
    }
    let mut bytes = bytes;
    if world.damaged.as_deref() == Some(name) {
        bytes[0] ^= 1;
    }
    let response = response.header(header::ETAG, format!("W/\"etag-{}\"", name.replace(['/', '.', '_'], "-")));
    let mut response = response;
    if let Some(range) = request.headers().get(header::RANGE).map(|value| value.to_str().expect("text").to_owned()) {
        let start = range.trim_start_matches("bytes=").trim_end_matches('-').parse::<usize>().expect("a number");
        let whole = format!("bytes {start}-{}/{}", bytes.len() - 1, bytes.len());
        response = response.status(StatusCode::PARTIAL_CONTENT).header(header::CONTENT_RANGE, whole);
        bytes.drain(..start);
        world.ranges.push(range);
    }
    let length = bytes.len();
    let body = if request.method() == Method::HEAD { Body::empty() } else { Body::from(bytes) };
    response.header(header::CONTENT_LENGTH, length).body(body).expect("an answer")
}

/// The running hub.
struct Server {
    runtime: Option<tokio::runtime::Runtime>,
    world: Shared,
    port: u16,
}

impl Server {
    fn start(files: &[(&str, &str)]) -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime");
        let world = Shared::default();
        let router = Router::new().fallback(answer).with_state(Arc::clone(&world));
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).expect("a port");
        let port = listener.local_addr().expect("bound").port();
        runtime.spawn(async move { axum::serve(listener, router).await });
        let mut kept = world.lock().expect("nobody panics with it");
        // Another name of this machine is another host to a client.
        kept.elsewhere = format!("http://localhost:{port}");
        kept.files = files.iter().map(|(name, text)| ((*name).to_owned(), text.as_bytes().to_vec())).collect();
        drop(kept);
        Self { runtime: Some(runtime), world, port }
    }

    fn settings(&self, cache: &Path) -> Settings {
        let endpoint = format!("http://127.0.0.1:{}", self.port);
        Settings { cache: cache.into(), endpoint, token: Some(TOKEN.into()), offline: false }
    }

    fn asked(&self) -> Vec<(String, String, Option<String>)> {
        std::mem::take(&mut self.world.lock().expect("nobody panics with it").asked)
    }

    fn stop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop();
    }
}

const SENTENCE: &[(&str, &str)] = &[
    ("modules.json", r#"[{"path": ""}, {"path": "1_Pooling"}, {"path": "2_Dense"}, {"path": "3_Normalize"}]"#),
    ("config.json", "{}"),
    ("tokenizer.json", "{\"model\": {}}"),
    ("tokenizer_config.json", "{ }"),
    ("sentence_bert_config.json", "{\"max_seq_length\": 256}"),
    ("model.safetensors", "whole weights"),
    ("pytorch_model.bin", "a pickle"),
    ("tf_model.h5", "another program's"),
    ("README.md", "words"),
    ("1_Pooling/config.json", "{\"pool\": 1}"),
    ("2_Dense/config.json", "{\"dense\": 1}"),
    ("2_Dense/model.safetensors", "dense weights"),
    ("2_Dense/pytorch_model.bin", "a pickle"),
];

fn name(revision: &str) -> Name {
    Name::of("org/small", revision).expect("a name")
}

fn fetch(settings: &Settings, revision: &str, encoder: Encoder) -> Result<hub::Found, HubError> {
    Hub::new(settings.clone()).folder(&name(revision), encoder, &mut |_| {})
}

#[test]
fn what_is_read_is_fetched_once_and_found_again() {
    let cache = tempfile::tempdir().expect("a folder");
    let mut server = Server::start(SENTENCE);
    server.world.lock().expect("ours").wants_token = true;
    let settings = server.settings(cache.path());
    let found = fetch(&settings, "", Encoder::SentenceT5).expect("it is there");
    let root = cache.path().join("models--org--small");
    assert_eq!((&found.folder, found.commit.as_str()), (&root.join("snapshots").join(COMMIT), COMMIT));
    let mut files: Vec<String> = motion::DataPath::local(&found.folder)
        .tree()
        .expect("a folder")
        .iter()
        .map(|file| file.shown().strip_prefix(&found.folder).expect("below").display().to_string())
        .collect();
    files.sort();
    let read = [
        "1_Pooling/config.json",
        "2_Dense/config.json",
        "2_Dense/model.safetensors",
        "config.json",
        "model.safetensors",
        "modules.json",
        "sentence_bert_config.json",
        "tokenizer.json",
        "tokenizer_config.json",
    ];
    assert_eq!(files, read, "no pickle, and nothing of other programs");
    for file in read {
        let expected = SENTENCE.iter().find(|(known, _)| *known == file).expect("one of them").1;
        assert_eq!(fs::read_to_string(found.folder.join(file)).expect("a file"), expected, "{file}");
    }
    // The layout of huggingface_hub: links to blobs that are named by the hub's identity for them.
    let blob = root.join("blobs").join(Digest::of(b"dense weights").hex());
    assert_eq!(
        fs::canonicalize(found.folder.join("2_Dense/model.safetensors")).unwrap(),
        fs::canonicalize(blob).unwrap()
    );
    assert!(root.join("blobs/etag-config-json").is_file());
    assert_eq!(fs::read_to_string(root.join("refs/main")).unwrap(), COMMIT);
    for (method, path, token) in server.asked() {
        let expected = (!path.starts_with("/large/")).then(|| format!("Bearer {TOKEN}"));
        assert_eq!(token, expected, "{method} {path}: the hub sees the token, and nobody else");
    }

    let again = fetch(&settings, "main", Encoder::SentenceT5).expect("it is there");
    assert_eq!(again, found);
    assert_eq!(server.asked().len(), 1, "which commit the branch has, and nothing else");
    assert_eq!(fetch(&settings, COMMIT, Encoder::SentenceT5).expect("it is there").folder, found.folder);
    assert!(server.asked().is_empty(), "a commit never changes");

    server.stop();
    let away = fetch(&settings, "", Encoder::SentenceT5).expect("the cache has it");
    assert_eq!(away.folder, found.folder);
    assert!(away.note.is_some_and(|note| note.contains("cannot be reached") && note.contains(COMMIT)));
    let offline = Settings { offline: true, ..settings.clone() };
    assert_eq!(fetch(&offline, "", Encoder::SentenceT5).expect("the cache has it"), found);
    assert_eq!(Hub::new(offline).cached(&name(""), Encoder::SentenceT5).expect("the cache has it"), found);
}

#[test]
fn what_is_not_there_is_said_with_what_to_do() {
    let cache = tempfile::tempdir().expect("a folder");
    let mut server = Server::start(SENTENCE);
    let settings = server.settings(cache.path());
    let offline = Settings { offline: true, ..settings.clone() };
    let error = fetch(&offline, "", Encoder::SentenceT5).expect_err("nothing is there");
    assert!(
        matches!(error, HubError::NotHere { .. }) && error.to_string().contains("HF_HUB_OFFLINE is set"),
        "{error}"
    );
    assert!(error.advice().contains("hf download org/small"), "{}", error.advice());
    assert!(server.asked().is_empty());

    let error = fetch(&settings, "v9", Encoder::SentenceT5).expect_err("no such revision");
    assert!(error.to_string().contains("`org/small@v9`: no such repository or revision"), "{error}");
    server.world.lock().expect("ours").wants_token = true;
    let stranger = Settings { token: None, ..settings.clone() };
    let error = fetch(&stranger, "", Encoder::SentenceT5).expect_err("private");
    assert!(error.to_string().contains("private or gated; set HF_TOKEN"), "{error}");
    let error = fetch(&settings, "../x", Encoder::SentenceT5).expect_err("no revision");
    assert!(error.to_string().contains("expected a branch, a tag or a commit"), "{error}");

    // Files with other bytes than their name declares are not kept.
    server.world.lock().expect("ours").damaged = Some("model.safetensors".into());
    let error = fetch(&settings, "", Encoder::SentenceT5).expect_err("damaged");
    assert!(error.to_string().contains("the download of `model.safetensors` has the wrong digest"), "{error}");
    let half = Hub::new(offline).cached(&name(COMMIT), Encoder::SentenceT5).expect_err("not all of it");
    assert!(half.to_string().contains("incomplete: has none of `model.safetensors`"), "{half}");
    server.world.lock().expect("ours").damaged = None;
    fetch(&settings, "", Encoder::SentenceT5).expect("it goes on where it was");

    server.stop();
    let elsewhere = tempfile::tempdir().expect("a folder");
    let error = fetch(&server.settings(elsewhere.path()), "", Encoder::SentenceT5).expect_err("nowhere");
    assert!(error.to_string().contains("cannot be reached"), "{error}");
}

#[test]
fn an_interrupted_download_continues_at_its_byte() {
    let cache = tempfile::tempdir().expect("a folder");
    let server = Server::start(SENTENCE);
    let settings = server.settings(cache.path());
    let blobs = cache.path().join("models--org--small/blobs");
    let part = blobs.join(format!("{}.incomplete", Digest::of(b"whole weights").hex()));
    fs::create_dir_all(&blobs).expect("created");
    fs::write(&part, "whole").expect("written");
    let found = fetch(&settings, "", Encoder::SentenceT5).expect("it is there");
    assert_eq!(fs::read_to_string(found.folder.join("model.safetensors")).expect("a file"), "whole weights");
    assert_eq!(std::mem::take(&mut server.world.lock().expect("ours").ranges), ["bytes=5-"]);
    assert!(!part.exists());

    // Bytes that do not fit are found by the digest; then the download begins again.
    let cache = tempfile::tempdir().expect("a folder");
    let settings = server.settings(cache.path());
    let part = cache.path().join(part.strip_prefix(blobs.ancestors().nth(2).expect("the cache")).expect("below"));
    fs::create_dir_all(part.parent().expect("a folder")).expect("created");
    fs::write(&part, "WHOLE").expect("written");
    let error = fetch(&settings, "", Encoder::SentenceT5).expect_err("damaged").to_string();
    assert!(error.contains("has the wrong digest"), "{error}");
    fetch(&settings, "", Encoder::SentenceT5).expect("it is there");
}

#[test]
fn parts_and_older_layouts_are_fetched_too() {
    let shards = r#"{"weight_map": {"a": "model-1.safetensors", "b": "model-2.safetensors"}}"#;
    let clip = [
        ("config.json", "{}"),
        ("vocab.json", "{}"),
        ("merges.txt", "a b"),
        ("model.safetensors.index.json", shards),
        ("model-1.safetensors", "one"),
        ("model-2.safetensors", "two"),
        ("model-3.safetensors", "another's"),
    ];
    let server = Server::start(&clip);
    let cache = tempfile::tempdir().expect("a folder");
    let found = fetch(&server.settings(cache.path()), "", Encoder::Clip).expect("it is there");
    assert_eq!(fs::read_to_string(found.folder.join("model-2.safetensors")).unwrap(), "two");
    assert!(!found.folder.join("model-3.safetensors").exists());
    let error = fetch(&server.settings(cache.path()), "", Encoder::SentenceT5).expect_err("a CLIP");
    assert!(error.to_string().contains("has no `modules.json`"), "{error}");
    let error = fetch(&server.settings(cache.path()), "", Encoder::T5).expect_err("a CLIP");
    assert!(error.to_string().contains("has no `tokenizer.json`; it is not such an encoder"), "{error}");

    // Names that lead out of the folder are ignored, and a listed weights file outside it counts as missing.
    let hostile = [
        ("config.json", "{}"),
        ("tokenizer.json", "{}"),
        ("../../../escaped", "x"),
        ("model.safetensors.index.json", r#"{"weight_map": {"a": "../../../escaped"}}"#),
    ];
    let server = Server::start(&hostile);
    let cache = tempfile::tempdir().expect("a folder");
    let error = fetch(&server.settings(cache.path()), "", Encoder::T5).expect_err("it leads out");
    assert!(error.to_string().contains("has no `../../../escaped`"), "{error}");
    let server = Server::start(&[("modules.json", r#"[{"path": "../x"}]"#)]);
    let error = fetch(&server.settings(cache.path()), "", Encoder::SentenceT5).expect_err("it leads out");
    assert!(error.to_string().contains("lists paths outside the repository"), "{error}");
}
