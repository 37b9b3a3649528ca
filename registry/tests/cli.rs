//! Tests of the binary: its output, its exit codes, and its requests to the holder of a store.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::io::{BufRead, BufReader, Read, Write as _};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Output};

use common::{artifact, open, version};
use protocol::ArtifactKind;
use serde_json::Value;

fn registry(store: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_registry"));
    command.arg("--store").arg(store).args(args).env("USER", "alice").env_remove("STRIDE_ACTOR");
    command.output().unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn stdout(output: &Output) -> String {
    assert_eq!(code(output), 0, "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

async fn with_models(dir: &Path) {
    let store = open(dir).await;
    for fid in [0.3, 0.2] {
        let model = artifact(store.blobs(), ArtifactKind::Model, &format!("model {fid}"));
        store.write(vec![version("quickstart", model, fid)]).await.unwrap();
    }
}

#[tokio::test]
async fn models_are_compared_and_ranked_in_tables_to_paste() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path();
    with_models(store).await;

    let compared = stdout(&registry(store, &["compare", "quickstart:1", "quickstart"]));
    assert!(compared.contains("noise not measured") && compared.contains("-0.100"), "{compared}");
    let leaderboard = stdout(&registry(store, &["leaderboard", "quickstart", "--style", "markdown"]));
    let rows: Vec<&str> = leaderboard.lines().skip(2).collect();
    assert_eq!(rows, ["| quickstart:2 | **0.200** |", "| quickstart:1 | 0.300 |"], "best first, the best in bold");
    let kit = stdout(&registry(store, &["leaderboard", "kit", "--style", "latex"]));
    assert!(kit.contains("MotionPCM, 1 step [MotionPCM] & $0.031$ & $0.433^{\\pm0.007}$"), "{kit}");

    let absent = registry(store, &["compare", "quickstart:1", "quickstart:9"]);
    assert_eq!(code(&absent), 7, "{}", stderr(&absent));
    let absent = registry(store, &["leaderboard", "nobody"]);
    assert_eq!(code(&absent), 7);
    assert!(stderr(&absent).contains("nobody"), "{}", stderr(&absent));
}

#[tokio::test]
async fn a_promotion_from_the_first_gate_to_the_rollback() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path();
    with_models(store).await;

    let refused = registry(
        store,
        &["promote", "quickstart@best", "--to", "prod", "--require", "latent_fid<=0.1", "--reason", "first"],
    );
    assert_eq!(code(&refused), 10);
    assert_eq!(
        stderr(&refused),
        "error: quickstart:2 cannot be promoted to `prod`: `latent_fid<=0.1`: latent_fid is 0.2, bound 0.1: it misses by 0.1\n\n\
         hint: nothing was changed; `registry show MODEL` lists every version with its metrics\n\
         more: trainer explain gate\n"
    );
    assert!(stdout(&registry(store, &["history", "quickstart"])).contains("no alias of `quickstart` has moved yet"));

    let first = ["promote", "quickstart:1", "--to", "prod", "--expect", "none", "--reason", "first"];
    assert_eq!(stdout(&registry(store, &first)), "quickstart@prod points at version 1 (before: nothing)\n");
    assert_eq!(code(&registry(store, &first)), 4, "somebody was first");
    let better =
        ["promote", "quickstart@best", "--to", "prod", "--require", "latent_fid < prod - 0.05", "--reason", "better"];
    assert!(stdout(&registry(store, &better)).contains("gate `latent_fid < prod - 0.05` holds"));
    stdout(&registry(store, &["rollback", "quickstart", "--alias", "prod", "--reason", "worse in the game"]));

    let history = stdout(&registry(store, &["history", "quickstart", "-o", "json"]));
    let history: Value = serde_json::from_str(&history).unwrap();
    let moves: Vec<_> = history["history"]
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| (entry["action"].as_str().unwrap(), entry["from"].as_u64(), entry["to"].as_u64().unwrap()))
        .collect();
    assert_eq!(moves, [("promote", None, 1), ("promote", Some(1), 2), ("rollback", Some(2), 1)]);
    assert_eq!(history["history"][0]["actor"], "alice");

    let list = stdout(&registry(store, &["list"]));
    assert!(list.contains("quickstart") && list.contains("latent_fid (min)") && list.contains("prod=1"), "{list}");
    let show = stdout(&registry(store, &["show", "quickstart"]));
    assert!(show.contains("best") && show.contains("latent_fid=0.200"), "{show}");
    assert!(stdout(&registry(store, &["show", "quickstart@prod"])).contains("content"));
    assert!(stdout(&registry(store, &["fsck"])).contains("0 problems"));
    assert!(stdout(&registry(store, &["gc", "--dry-run"])).contains("would remove 0 blobs"));
    let out = dir.path().join("out");
    stdout(&registry(store, &["export", "quickstart@prod", out.to_str().unwrap()]));
    assert_eq!(std::fs::read_to_string(out.join("content")).unwrap(), "model 0.3");
    assert_eq!(code(&registry(store, &["export", "quickstart@prod", out.to_str().unwrap()])), 2, "not empty");
}

#[tokio::test]
async fn what_is_wrong_has_a_code_and_a_hint() {
    let dir = tempfile::tempdir().unwrap();
    let missing = registry(&dir.path().join("nothing"), &["list"]);
    assert_eq!(code(&missing), 2, "as `trainer`");
    assert!(stderr(&missing).contains("there is no store") && stderr(&missing).contains("\n\nhint: "));
    assert!(!dir.path().join("nothing").exists());

    with_models(dir.path()).await;
    for (args, expected) in [
        (&["show", "other"][..], 7),
        (&["show", "quickstart:9"], 7),
        (&["show", "not a name"], 2),
        (&["promote", "quickstart", "--to", "prod", "--reason", "r"], 2),
        (&["promote", "quickstart:1", "--to", "prod", "--reason", "r", "--require", "latent_fid"], 2),
        (&["promote", "quickstart:1", "--to", "prod"], 2),
        (&["rollback", "quickstart", "--alias", "prod"], 7),
        (&["no-such-verb"], 2),
    ] {
        let output = registry(dir.path(), args);
        assert_eq!(code(&output), expected, "{args:?}: {}", stderr(&output));
    }
    let json = registry(dir.path(), &["show", "other", "-o", "json"]);
    let error: Value = serde_json::from_str(&stderr(&json)).unwrap();
    assert_eq!(error["error"]["code"], "not-found");
    assert!(json.stdout.is_empty());

    let blob =
        walk(&dir.path().join("blobs")).into_iter().find(|path| std::fs::read(path).unwrap() == b"model 0.2").unwrap();
    std::fs::write(blob, b"model 0.1").unwrap();
    let damaged = registry(dir.path(), &["fsck"]);
    assert_eq!(code(&damaged), 9);
    assert!(stderr(&damaged).contains("is corrupt"), "{}", stderr(&damaged));
}

fn walk(dir: &Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

/// Answers one request like a server that hosts the commands.
fn serve_once(listener: &TcpListener, answer: impl FnOnce(registry::cli::Command) -> registry::cli::Answer) {
    let (stream, _) = listener.accept().unwrap();
    let mut reader = BufReader::new(stream);
    let mut length = 0;
    let mut first = String::new();
    reader.read_line(&mut first).unwrap();
    assert!(first.starts_with("POST /v1/registry "), "{first}");
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).unwrap();
        if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        if line.trim().is_empty() {
            break;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    let answer = serde_json::to_vec(&answer(serde_json::from_slice(&body).unwrap())).unwrap();
    let head = format!(
        "HTTP/1.1 200 OK\r\ncontent-type: application/json\r\nconnection: close\r\ncontent-length: {}\r\n\r\n",
        answer.len()
    );
    let mut stream = reader.into_inner();
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&answer).unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_store_that_is_held_is_asked_through_its_holder() {
    let dir = tempfile::tempdir().unwrap();
    with_models(dir.path()).await;
    let store = open(dir.path()).await;
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    store.set_address(format!("http://{}", listener.local_addr().unwrap())).unwrap();
    let path = dir.path().to_owned();
    let client = std::thread::spawn(move || {
        // Read-only commands need no holder.
        let promote = ["promote", "quickstart:1", "--to", "prod", "--reason", "r", "--require", "latent_fid<=0.1"];
        (registry(&path, &["list"]), registry(&path, &promote))
    });
    let runtime = tokio::runtime::Handle::current();
    let hosted = store.clone();
    tokio::task::spawn_blocking(move || {
        serve_once(&listener, |command| runtime.block_on(registry::cli::run(command, &hosted, "bob")));
    })
    .await
    .unwrap();
    let (list, promote) = client.join().unwrap();
    assert!(stdout(&list).contains("quickstart"));
    assert_eq!(code(&promote), 10);
}

#[tokio::test]
async fn a_holder_that_does_not_answer_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let _store = open(dir.path()).await;
    let output = registry(dir.path(), &["promote", "m:1", "--to", "prod", "--reason", "r"]);
    assert_eq!(code(&output), 6);
    assert!(stderr(&output).contains(&format!("`test` (process {})", std::process::id())), "{}", stderr(&output));
}
