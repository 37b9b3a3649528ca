//! A submitter chooses the files that a worker reads, with these limits: only files below its data roots, no quote of
//! their content, and only the digest that a worker verifies.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use cluster_tests::cluster::Cluster;
use cluster_tests::{Bench, wait_for};
use motion::DataPath;
use motion::folder_digest::files_digest;
use protocol::Digest;
use serde_json::{Value, json};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
/// A word in files that no submitter may see.
const CANARY: &str = "qzcanaryzq";
/// The worker's data root.
const ROOT: &str = "data";

/// Starts a cluster with recordings in `data/a` and `data/b`, in the data root of its worker.
fn cluster() -> Cluster {
    let mut cluster = Cluster::start(TRAINER);
    let root = at(&cluster, ROOT);
    for (name, seed) in [("a", "1"), ("b", "2")] {
        let folder = root.join(name).display().to_string();
        let sample = ["data", "sample", "--format", "bvh", &folder, "--clips", "4", "--seed", seed];
        cluster.bench().run(&sample).expect_code(0);
    }
    let root = root.display().to_string();
    cluster.join_by("w1", &[], &["--data-root", &root]);
    cluster
}

fn at(cluster: &Cluster, name: &str) -> PathBuf {
    cluster.bench().path().join(name)
}

/// Submits a stage of features of recordings as a custom client may: `digests` are the client's claims about the files.
fn submit(cluster: &Cluster, settings: &str, digests: &[(&str, Digest)]) -> String {
    let text = format!("name: p\nstages:\n  dataset: {{kind: data.features, mirror: false, shards: 1, {settings}}}\n");
    let mut pipeline = pipeline::read("p.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    let digests = digests.iter().map(|(field, digest)| ((*field).to_owned(), *digest));
    pipeline.stages[0].external = digests.collect();
    let body = json!({"pipeline": pipeline, "source": text, "idempotency_key": null, "until": null});
    let reply = cluster.post("/v1/runs", &body).expect("an answer");
    assert_eq!(reply.status, 200, "{}", reply.body);
    reply.body["run"].as_str().expect("a run").to_owned()
}

/// Returns the run's only stage, once the run has ended.
fn ended(cluster: &Cluster, run: &str) -> Value {
    wait_for("the run to end", || {
        let view = cluster.view(run);
        let over = matches!(view["state"].as_str(), Some("finished" | "failed" | "cancelled"));
        over.then(|| view["stages"][0].clone())
    })
}

/// Returns the reason for the failure of a run.
fn refused(cluster: &Cluster, settings: &str, digests: &[(&str, Digest)]) -> String {
    let stage = ended(cluster, &submit(cluster, settings, digests));
    assert_eq!(stage["state"], "failed", "{stage:#}");
    stage["message"].as_str().expect("a reason").to_owned()
}

fn digest(path: &Path) -> Digest {
    files_digest(&DataPath::local(path)).expect("it is there")
}

/// Files below `folder` that contain the word.
fn with_canary(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let found = entries.filter(|path| !path.is_symlink()).flat_map(|path| match path.is_dir() {
        true => with_canary(&path),
        false => {
            let bytes = fs::read(&path).unwrap_or_default();
            if bytes.windows(CANARY.len()).any(|part| part == CANARY.as_bytes()) { vec![path] } else { vec![] }
        }
    });
    found.collect()
}

#[test]
fn a_submitter_names_no_file_outside_the_data_roots() {
    let cluster = cluster();
    let secret = at(&cluster, "secret.csv");
    fs::write(&secret, format!("clip,caption\n000000,{CANARY}#\n")).expect("written");
    symlink(&secret, at(&cluster, "data/link.csv")).expect("a link");
    symlink("/proc/self", at(&cluster, "data/process")).expect("a link");
    symlink("../../secret.csv", at(&cluster, "data/a/climbing.bvh")).expect("a link");
    let root = at(&cluster, ROOT);
    let below = |name: &str| root.join(name).display().to_string();
    let (secret, token) = (secret.display().to_string(), at(&cluster, ".stride/token").display().to_string());
    for (captions, part) in [
        (secret.clone(), "is not below a data root"),
        (token, "is not below a data root"),
        ("/etc/passwd".into(), "is not below a data root"),
        ("/proc/self/environ".into(), "is not below a data root"),
        (below("../secret.csv"), "is outside the data root"),
        ("../secret.csv".into(), "is outside the data root"),
        (below("link.csv"), "is outside the data root"),
        (below("process/environ"), "is outside the data root"),
    ] {
        for digests in [vec![], vec![("path", digest(&root.join("b"))), ("captions", Digest::of(b"made up"))]] {
            let said = refused(&cluster, &format!("path: b, captions: {captions}"), &digests);
            assert!(said.contains(part), "{captions}: {said}");
        }
    }
    let said = refused(&cluster, "path: a", &[]);
    assert!(said.contains("climbing.bvh: is outside the data root"), "{said}");
    // Every other setting that may name a file, and an unknown name of a shipped map.
    for setting in ["target", "map"] {
        let said = refused(&cluster, &format!("path: b, {setting}: {secret}.yaml"), &[]);
        assert!(said.contains("is not below a data root"), "{setting}: {said}");
    }
    let said = refused(&cluster, "path: b, map: /etc/passwd", &[]);
    assert!(said.contains("no built-in joint map `/etc/passwd`"), "{said}");
    assert_eq!(with_canary(cluster.bench().path()), [PathBuf::from(&secret)], "{}", cluster.everything());
}

#[test]
fn no_answer_log_or_artifact_quotes_a_file() {
    let cluster = cluster();
    let captions = at(&cluster, "data/b/captions.csv");
    for (text, part) in [
        (format!("{CANARY},{CANARY}\n"), "captions.csv:1:"),
        (format!("clip,caption\n000000,{CANARY}#\n"), "captions.csv:2:"),
        (format!("clip,caption,from,to\n000000,a,{CANARY},1\n"), "captions.csv:2:"),
        (format!("{{\"000000\": {{\"{CANARY}\": 1}}}}"), "is not a string"),
        (format!("[\"{CANARY}"), "at line 1 column"),
    ] {
        fs::write(&captions, text).expect("written");
        let said = refused(&cluster, "path: b", &[]);
        assert!(said.contains(part), "{said}");
    }
    fs::remove_file(&captions).expect("removed");
    for (name, part) in [("000000.bvh", "000000.bvh:1:"), ("000000.txt", "000000.txt:1:")] {
        let path = at(&cluster, "data/b").join(name);
        let good = fs::read(&path).expect("a file");
        fs::write(&path, format!("{CANARY} # {CANARY}\n")).expect("written");
        let said = refused(&cluster, "path: b", &[]);
        assert!(said.contains(part), "{said}");
        fs::write(&path, good).expect("written");
    }
    fs::write(at(&cluster, "data/map.yaml"), format!("{CANARY}: [{CANARY}]\n")).expect("written");
    let said = refused(&cluster, "path: b, map: map.yaml", &[]);
    assert!(said.contains("map.yaml:"), "{said}");
    let map = at(&cluster, "data/map.yaml");
    assert_eq!(with_canary(cluster.bench().path()), [map], "{}", cluster.everything());
}

#[test]
fn a_worker_without_a_data_root_opens_no_file() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join_by("w1", &[], &["--data-root", ""]);
    let said = refused(&cluster, "path: /etc", &[]);
    assert!(said.contains("has no data root") && said.contains("--data-root DIR"), "{said}");
}

#[test]
fn a_digest_is_an_expectation_that_a_worker_verifies() {
    let cluster = cluster();
    let (a, b) = (digest(&at(&cluster, "data/a")), digest(&at(&cluster, "data/b")));
    assert_ne!(a, b);
    // Claim the digest of one folder for the other.
    let said = refused(&cluster, "path: b", &[("path", a)]);
    for part in ["`b` on `", &a.to_string(), &b.to_string(), "the copies on the machines differ"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    // The refused run stored nothing under its key.
    let honest = ended(&cluster, &submit(&cluster, "path: a", &[("path", a)]));
    assert_eq!(honest["state"], "ran", "{honest:#}");
    let output = |stage: &Value| stage["outputs"]["dataset"].as_str().expect("a dataset").to_owned();

    // Without a claim, a worker computes the digest, and the result is the same.
    let found = ended(&cluster, &submit(&cluster, "path: a", &[]));
    assert_eq!((found["state"].as_str(), output(&found)), (Some("cached"), output(&honest)), "{found:#}");
    let other = ended(&cluster, &submit(&cluster, "path: b", &[]));
    assert_eq!(other["state"], "ran", "{other:#}");
    assert_ne!(output(&other), output(&honest));
    let known = ended(&cluster, &submit(&cluster, "path: b", &[("path", b)]));
    assert_eq!(known["state"], "cached", "{known:#}");

    // Folders that were exchanged have other digests.
    fs::rename(at(&cluster, "data/a"), at(&cluster, "data/c")).expect("moved");
    fs::rename(at(&cluster, "data/b"), at(&cluster, "data/a")).expect("moved");
    let swapped = ended(&cluster, &submit(&cluster, "path: a", &[]));
    assert_eq!((swapped["state"].as_str(), output(&swapped)), (Some("cached"), output(&other)), "{swapped:#}");
    let said = refused(&cluster, "path: a, cut: false", &[("path", a)]);
    assert!(said.contains("the copies on the machines differ"), "{said}");
}

#[test]
fn a_worker_in_a_sandbox_trains_and_reads_nothing_but_its_root() {
    let mut cluster = Cluster::start(TRAINER);
    let root = at(&cluster, ROOT);
    let folder = root.join("a").display().to_string();
    cluster.bench().run(&["data", "sample", "--format", "bvh", &folder, "--clips", "4"]).expect_code(0);
    let secret = at(&cluster, "secret.csv");
    fs::write(&secret, format!("clip,caption\n000000,{CANARY}\n")).expect("written");
    let (root, cache) = (root.display().to_string(), at(&cluster, "cache").display().to_string());
    cluster.join_by("w1", &[], &["--sandbox", "--data-root", &root, "--cache", &cache]);

    let honest = ended(&cluster, &submit(&cluster, "path: a", &[]));
    // A process that can gain no right again: the kernel asks for that before it takes rules.
    let status = fs::read_to_string(format!("/proc/{}/status", cluster.pid("w1"))).expect("the worker lives");
    assert!(status.contains("NoNewPrivs:\t1"), "{status}");
    assert_eq!(honest["state"], "ran", "{honest:#}");
    for captions in [secret.display().to_string(), "/etc/passwd".to_owned(), "/proc/self/environ".to_owned()] {
        let said = refused(&cluster, &format!("path: a, captions: {captions}"), &[]);
        assert!(said.contains("is not below a data root"), "{captions}: {said}");
    }
    let run = cluster.submit(Path::new(&Bench::config("smoke.yaml")), &["--until", "vae"]);
    let stage = ended(&cluster, &run);
    assert_eq!(stage["state"], "ran", "{stage:#}");
    assert_eq!(with_canary(cluster.bench().path()), [secret], "{}", cluster.everything());
}
