//! Two tokens whose runs share the workers of one coordinator.

use cluster_tests::cluster::{Cluster, OTHER_TOKEN};
use cluster_tests::wait_for;
use serde_json::Value;

use crate::cluster::{VAE, config, equals_reference};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

fn members(stage: &Value) -> usize {
    stage["workers"].as_array().map_or(0, Vec::len)
}

#[test]
fn a_long_training_gives_a_worker_to_another_token_and_gets_it_back() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    cluster.join("w2");
    let long = cluster.submit(&config(), &VAE);
    wait_for("both workers to train", || {
        let stage = cluster.stage(&long, "vae");
        assert!(stage["state"] != "ran", "it was over before both trained");
        (members(&stage) == 2 && stage["progress"]["done"].as_u64() > Some(10)).then_some(())
    });

    let sets = ["--set", "stages.vae.steps=40", "--set", "stages.vae.lr=2e-3", "--until", "vae"];
    let short = cluster.submit_as(OTHER_TOKEN, &config(), &sets);
    let view = cluster.view(&short);
    assert_eq!(view["owner"]["name"], "other");
    wait_for("one worker for each token", || {
        let others = cluster.stage(&short, "vae");
        let own = cluster.stage(&long, "vae");
        assert!(own["state"] != "ran", "it was over before it had shared: {others:#}");
        (members(&own) == 1 && members(&others) == 1).then_some(())
    });
    let ended = cluster.wait_end(&short);
    assert_eq!(ended["state"], "finished");
    wait_for("the worker to come back", || {
        let stage = cluster.stage(&long, "vae");
        assert!(stage["state"] != "ran", "it was over before it had its worker back");
        (members(&stage) == 2).then_some(())
    });

    let view = cluster.wait_end(&long);
    let stage = cluster_tests::cluster::stage_of(&view, "vae");
    assert_eq!((&stage["state"], &stage["attempt"]), (&"ran".into(), &1.into()), "nothing was taken up again");
    equals_reference(&cluster, &long, &view);
    cluster.fsck();
}
