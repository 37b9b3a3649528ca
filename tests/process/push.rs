//! `trainer data push`: data of a laptop is used by workers that cannot read it.

use std::fs;

use cluster_tests::cluster::{Cluster, TOKEN, stage_of};
use cluster_tests::wait_for;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

const PIPELINE: &str = "name: laptop
stages:
  dataset: {kind: data.features, path: laptop/recordings, shards: 2}
  vae:
    kind: train.vae
    latent: {tokens: 2, dim: 8}
    network: {width: 16, layers: 1, heads: 2, feed_forward: 32, dropout: 0}
    steps: 4
    batch: {global: 2, slices: 1}
";

/// A server with one worker that has no data root, and recordings elsewhere.
fn site() -> Cluster {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let sample = ["data", "sample", "--format", "bvh", "laptop/recordings", "--clips", "6"];
    cluster.bench().run(&sample).expect_code(0);
    fs::write(cluster.bench().path().join("laptop.yaml"), PIPELINE).expect("written");
    cluster
}

#[test]
fn data_of_this_machine_is_used_by_workers_that_cannot_read_it() {
    let cluster = site();
    let url = cluster.url();
    let push = ["data", "push", "laptop.yaml", "--server", &url];
    let said = cluster.bench().run(&push).expect_code(0);
    assert!(said.stdout.contains("trainer submit laptop.yaml"), "{}", said.stdout);
    let pushed = cluster.bench().run(&[&push[..], &["-o", "json"]].concat()).expect_code(0).json();
    assert_eq!(pushed["state"], "finished", "{pushed:#}");
    let dataset = pushed["stages"]["dataset"].clone();
    assert!(dataset.as_object().is_some_and(|outputs| !outputs.is_empty()), "{pushed:#}");

    let run = cluster.submit(&cluster.bench().path().join("laptop.yaml"), &[]);
    let view = cluster.wait_end(&run);
    assert_eq!(stage_of(&view, "dataset")["state"], "cached", "{view:#}");
    assert_eq!(stage_of(&view, "dataset")["outputs"], dataset);
    assert_eq!(stage_of(&view, "vae")["state"], "ran", "{view:#}");
    wait_for("the workers of this machine to have left", || {
        let workers = cluster.get("/v1/workers")?;
        let (w1, others): (Vec<_>, Vec<_>) = workers.as_array()?.iter().partition(|worker| worker["worker"] == "w1");
        assert!(w1.len() == 1 && !others.is_empty(), "{workers:#}");
        others.iter().all(|worker| worker["state"] == "gone").then_some(())
    });
}

/// A token that may not join leaves no run that waits for ever.
#[test]
fn a_push_without_the_right_to_work_ends_and_cancels_its_run() {
    let cluster = site();
    let url = cluster.url();
    let token = cluster_tests::cluster::OTHER_TOKEN;
    let mut command = cluster.bench().command(&["data", "push", "laptop.yaml", "--server", &url]);
    command.env("STRIDE_TOKEN", token);
    let said = cluster_tests::Running::start(command).wait().expect_code(5);
    assert!(said.stderr.contains("scopes `submit` and `worker`"), "{}", said.stderr);
    assert!(!said.stderr.contains(token) && !said.stderr.contains(TOKEN));
    let runs = cluster.get("/v1/runs").expect("runs");
    assert_eq!(runs["items"][0]["state"], "cancelled", "{runs:#}");
    let nothing = cluster.bench().run(&["data", "push", &cluster_tests::Bench::config("smoke.yaml"), "--server", &url]);
    assert!(nothing.expect_code(2).stderr.contains("nothing to push"));
}
