//! A training makes way for a run of a higher priority, and continues from its last step.

use cluster_tests::cluster::{Cluster, stage_of};
use cluster_tests::{Bench, documented, wait_for};

use crate::cluster::{VAE, config, equals_reference};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

#[test]
fn a_training_yields_its_only_worker_to_a_higher_priority_and_loses_no_step() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let long = cluster.submit(&config(), &VAE);
    wait_for("the training to advance", || {
        let stage = cluster.stage(&long, "vae");
        assert!(stage["state"] != "ran", "it was over before the other run came");
        (stage["progress"]["done"].as_u64() > Some(10)).then_some(())
    });

    let documented = documented::run_by(&Bench::repository(), "tests/process/priorities.rs").join(" ");
    let priority = documented.split_whitespace().skip_while(|word| *word != "--priority");
    let sets = ["--set", "stages.vae.steps=40", "--set", "stages.vae.lr=2e-3", "--until", "vae"];
    let urgent = cluster.submit(&config(), &sets.into_iter().chain(priority).collect::<Vec<_>>());
    assert_eq!(cluster.view(&urgent)["priority"], 5);
    let ended = cluster.wait_end(&urgent);
    assert_eq!(ended["state"], "finished");
    let waiting = cluster.stage(&long, "vae");
    assert!(waiting["state"] != "ran" && waiting["state"] != "resumed", "the long one came first: {waiting:#}");

    let view = cluster.wait_end(&long);
    let stage = stage_of(&view, "vae");
    assert_eq!((&stage["state"], &stage["attempt"]), (&"resumed".into(), &2.into()), "it yielded once: {stage:#}");
    equals_reference(&cluster, &long, &view);
    cluster.fsck();
}
