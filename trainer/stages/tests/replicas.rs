//! Replicas that are averaged after several updates. One replica has the bits of a plain training. More of them have the
//! same bits with any number of members and losses.

mod common;

use std::collections::BTreeMap;

use protocol::stage::{CheckpointPolicy, Replicas, StageSettings};
use protocol::{Digest, Steps};
use stage_lab::{Bench, Script};
use stages::run::verify::state_digest;

const STEPS: u64 = 18;

/// The stages before `name`, and its settings and inputs.
fn before(name: &str) -> (Bench, StageSettings, Vec<(&'static str, Digest)>) {
    let mut bench = Bench::new(burn::tensor::Device::flex(), 7, 1);
    bench.checkpoint = CheckpointPolicy { every: Steps(7), ..CheckpointPolicy::default() };
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (stage, settings, inputs) in common::chain(2, [STEPS; 4]) {
        let inputs: Vec<_> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
        if stage == name {
            return (bench, settings, inputs);
        }
        let output = bench.run(stage, &settings, &inputs).unwrap_or_else(|e| panic!("{stage}: {e}")).output();
        outputs.insert(stage, output);
    }
    panic!("no stage {name}")
}

fn with(settings: &StageSettings, every: u64, replicas: usize) -> StageSettings {
    let mut settings = settings.clone();
    settings.training_mut().expect("it trains").sync = Replicas { every: Steps(every), replicas };
    settings
}

/// The digest of the last state, and the steps of all checkpoints.
fn states(bench: &mut Bench, name: &str) -> (Option<Digest>, Vec<u64>) {
    let all = bench.forget_after(name, 0);
    (all.last().and_then(|(_, manifest)| state_digest(manifest)), all.iter().map(|(step, _)| *step).collect())
}

#[test]
fn one_replica_has_the_bits_of_a_plain_training() {
    for name in ["mld", "pcm"] {
        let (mut bench, settings, inputs) = before(name);
        bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        let (plain, at) = states(&mut bench, name);
        assert_eq!(at, [7, 14, STEPS], "{name}");
        bench.run(name, &with(&settings, 5, 1), &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        let (replica, at) = states(&mut bench, name);
        assert_eq!(replica, plain, "{name}");
        // A checkpoint that is due waits for the end of its round.
        assert_eq!(at, [10, 15, STEPS], "{name}");
    }
}

#[test]
fn replicas_do_not_depend_on_members_and_losses() {
    for name in ["vae", "lcm", "pcm"] {
        let (mut bench, settings, inputs) = before(name);
        let settings = with(&settings, 4, 3);
        let mut run = |members: usize, script: Script| {
            (bench.members, bench.script) = (members, script);
            bench.forget(name);
            bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name} by {members}: {e}")).output()
        };
        let alone = run(1, Script::default());
        assert_eq!(run(3, Script::default()), alone, "{name}");
        // In the middle of the second and the last round; a member joins after the first.
        assert_eq!(run(3, Script { lost: vec![(0, 6), (1, 17)], ..Script::default() }), alone, "{name}");
        assert_eq!(run(1, Script { joins: vec![(1, 0)], ..Script::default() }), alone, "{name}");
        // All are lost, and later ones continue from the last average in a checkpoint.
        bench.forget(name);
        (bench.members, bench.script) = (2, Script { lost: vec![(0, 13), (1, 13)], ..Script::default() });
        assert!(bench.run(name, &settings, &inputs).is_err(), "{name}");
        assert_eq!(bench.newest(name).map(|(step, _)| *step), Some(8), "{name}");
        (bench.members, bench.script) = (2, Script::default());
        let resumed = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output();
        assert_eq!(resumed, alone, "{name}");
    }
}

/// Averages after every update are no gradients of the whole batch: AdamW is not linear.
#[test]
fn replicas_are_another_training() {
    let (mut bench, settings, inputs) = before("mld");
    let plain = bench.run("mld", &settings, &inputs).expect("runs").output();
    bench.forget("mld");
    let ran = bench.run("mld", &with(&settings, 1, 2), &inputs).expect("runs");
    assert_ne!(ran.output(), plain);
}
