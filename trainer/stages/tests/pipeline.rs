//! The whole chain in memory, small: its result does not depend on the members that computed it.

mod common;

use std::collections::BTreeMap;

use protocol::stage::{DataSynthetic, Shape, StageSettings, TrainVae};
use protocol::{Digest, Steps};
use stage_lab::{Bench, Script};
use stages::context::Outcome;

use common::Link;

/// The stages in order, at the lengths of these tests.
fn chain(shards: usize) -> Vec<Link> {
    common::chain(shards, [8, 10, 6, 6])
}

/// The digest of every stage's output, and the metrics of the evaluations.
fn run(bench: &mut Bench, shards: usize) -> BTreeMap<&'static str, Digest> {
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain(shards) {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        eprintln!("{name}: {} {:?}", ran.output(), ran.metrics());
        outputs.insert(name, ran.output());
    }
    outputs
}

fn bench(members: usize) -> Bench {
    Bench::new(burn::tensor::Device::flex(), 7, members)
}

/// Sampled: 1, 2 and 3 members, the last with a loss of the leader and a joiner in every training stage.
#[test]
fn p6_every_digest_is_the_same_with_any_number_of_members_and_shards() {
    let alone = run(&mut bench(1), 1);
    let pair = run(&mut bench(2), 3);
    assert_eq!(alone, pair, "1 member and 1 shard against 2 and 3");
    let mut three = bench(3);
    // One member is lost in each training stage, the leader, and another joins.
    three.script = Script { lost: vec![(0, 3)], joins: vec![(5, 1)], ..Script::default() };
    assert_eq!(alone, run(&mut three, 4), "1 member against 3 of which the leader is lost and a fourth joins");
}

#[test]
fn a_stage_that_yields_and_goes_on_gives_the_same_bytes() {
    let chain = chain(2);
    let mut whole = bench(2);
    let mut cut = bench(2);
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let expected = whole.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output();
        if settings.shape() == Shape::Gang {
            cut.script = Script { drain: Some(3), ..Script::default() };
            let ran = cut.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(ran.outcome, Outcome::Yielded { at: 4 }, "{name}");
            assert_eq!(cut.checkpoints(name), [4], "{name}");
            cut.script = Script::default();
            cut.members = 3;
        }
        let ran = cut.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(ran.output(), expected, "{name}: 4 steps by two, the rest by three");
        cut.members = 2;
        outputs.insert(name, expected);
    }
}

#[test]
fn balance_changes_the_clips_that_a_vae_draws() {
    let mut bench = bench(1);
    let links: Vec<Link> = chain(1).into_iter().filter(|(name, ..)| ["dataset", "vae"].contains(name)).collect();
    let [(data, ..), (name, StageSettings::TrainVae(vae), _)] = &links[..] else { panic!("{links:?}") };
    // Of few clips, each has a word of its own.
    let many = DataSynthetic { clips: 200, ..DataSynthetic::default() };
    let clips = bench.run(data, &many.into(), &[]).expect("clips").output();
    let mut trained = |balance| {
        bench.forget(name);
        let settings = TrainVae { balance, ..vae.clone() };
        bench.run(name, &settings.into(), &[("dataset", clips)]).expect("a VAE").output()
    };
    let [evenly, balanced] = [trained(0.0), trained(2.0)];
    assert_ne!(evenly, balanced);
    assert_eq!(balanced, trained(2.0));
}

/// A trial trained in rungs is bit for bit the stage trained in one piece; sweeps depend on it.
#[test]
fn a_stage_that_is_trained_in_rungs_gives_the_same_bytes() {
    let mut bench = bench(1);
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (name, settings, inputs) in chain(2) {
        let inputs: Vec<_> = inputs.iter().map(|(field, stage)| (*field, outputs[stage])).collect();
        let expected = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}")).output();
        outputs.insert(name, expected);
        if settings.shape() != Shape::Gang {
            continue;
        }
        bench.take_checkpoint(name);
        let mut state = None;
        for (stop, members) in [(Some(2), 2), (Some(5), 1), (None, 3)] {
            let mut rung = settings.clone();
            rung.training_mut().expect("a gang trains").stop = stop.map(Steps);
            let inputs: Vec<_> = inputs.iter().copied().chain(state.map(|state| ("state", state))).collect();
            bench.members = members;
            let ran = bench.run(name, &rung, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
            let (step, left) = bench.take_checkpoint(name).expect("a rung leaves its state");
            match stop {
                Some(stop) => {
                    assert_eq!(step, stop, "{name}");
                    assert_ne!(ran.output(), expected, "{name}: what was trained for {stop} steps is something else");
                }
                None => assert_eq!(ran.output(), expected, "{name}"),
            }
            state = Some(left);
        }
        bench.members = 1;
    }
}
