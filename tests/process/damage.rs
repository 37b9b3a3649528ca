//! A blob that is damaged during a run.

use std::fs;

use cluster_tests::cluster::Cluster;
use cluster_tests::{Bench, digests, wait_for};
use nix::sys::signal::Signal;
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// The stage that reads it reports the damage and waits. The stage that produced it is computed again with the same
/// bytes, and the run continues.
#[test]
fn what_a_stage_reads_is_made_again_within_the_run() {
    let until = ["--until", "lcm"];
    let reference = Bench::new(TRAINER).pipeline("smoke.yaml", &[&["--workers", "1"][..], &until].concat());
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&Bench::repository().join("configs/smoke.yaml"), &until);
    let model = wait_for("the teacher to be trained", || {
        let stage = cluster.stage(&run, "mld");
        (stage["state"] == "ran").then(|| stage["outputs"]["model"].as_str().expect("a model").to_owned())
    });
    cluster.signal("w1", Signal::SIGTERM);
    cluster.ended("w1");

    let blobs = cluster.bench().store().join("blobs/sha256");
    let path = |digest: &str| {
        let hex = digest.strip_prefix("sha256:").expect("a digest");
        blobs.join(&hex[..2]).join(&hex[2..])
    };
    let manifest: Value = serde_json::from_slice(&fs::read(path(&model)).expect("a manifest")).expect("JSON");
    let weights = manifest["files"]["denoiser/model.safetensors"]["digest"].as_str().expect("weights").to_owned();
    let mut bytes = fs::read(path(&weights)).expect("weights");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(path(&weights), bytes).expect("damaged");

    cluster.join("w2");
    let view = cluster.wait_end(&run);
    assert_eq!(digests(&view), digests(&reference));
    let said = cluster.said("w2");
    assert!(said.contains(&weights) && said.contains("is corrupt"), "it is named:\n{said}");
    assert!(said.contains("/mld attempt="), "it is computed again:\n{said}");
    let aside = fs::read_dir(cluster.bench().store().join("quarantine")).expect("a folder").count();
    assert_eq!(aside, 1, "the damaged bytes are kept");
    cluster.fsck();
}
