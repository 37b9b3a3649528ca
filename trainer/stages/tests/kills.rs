//! A training stage that is killed at any step, any number of times, ends with the bytes of an undisturbed one.
//!
//! In memory: a kill of all members loses everything but the committed checkpoints, like `kill -9` of the whole gang.
//! The process tests do the same to real processes at sampled steps.

mod common;

use std::collections::BTreeMap;

use protocol::stage::{CheckpointPolicy, Shape, StageSettings};
use protocol::{Digest, Steps};
use stage_lab::{Bench, Script};

/// A stage to be disturbed: the world before it, its settings, its inputs, and its expected output.
struct Case {
    bench: Bench,
    settings: StageSettings,
    inputs: Vec<(&'static str, Digest)>,
    expected: Digest,
}

/// Runs everything up to the stage `name`, and that stage undisturbed by one member.
fn case(name: &str, steps: common::Steps4) -> Case {
    let mut bench = Bench::new(burn::tensor::Device::flex(), 7, 1);
    // Neither a divisor of the steps nor in step with the batches.
    bench.checkpoint = CheckpointPolicy { every: Steps(7), ..CheckpointPolicy::default() };
    let mut outputs: BTreeMap<&'static str, Digest> = BTreeMap::new();
    for (stage, settings, inputs) in common::chain(2, steps) {
        let inputs: Vec<_> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
        let output = bench.run(stage, &settings, &inputs).unwrap_or_else(|e| panic!("{stage}: {e}")).output();
        if stage == name {
            return Case { bench, settings, inputs, expected: output };
        }
        outputs.insert(stage, output);
    }
    panic!("no stage {name}")
}

impl Case {
    /// Runs the stage from the start and kills all members at each of `kills`. They restart in other numbers, and
    /// finally run to the end. `as_name` is for messages.
    fn run(&mut self, name: &str, as_name: &str, kills: &[u64]) {
        self.bench.forget(name);
        for (round, step) in kills.iter().enumerate() {
            let members = 1 + round % 3;
            self.bench.members = members;
            self.bench.script = Script { lost: (0..members).map(|m| (m, *step)).collect(), ..Script::default() };
            let killed = self.bench.run(name, &self.settings, &self.inputs);
            assert!(killed.is_err(), "{as_name}: over before the kill at step {step}");
        }
        self.bench.script = Script::default();
        self.bench.members = 1 + kills.len() % 2;
        let ran = self.bench.run(name, &self.settings, &self.inputs).unwrap_or_else(|e| panic!("{as_name}: {e}"));
        assert_eq!(ran.output(), self.expected, "{as_name}");
    }
}

/// All steps of the stages of a latent model, one after the other. A kill at a step loses everything after the last
/// checkpoint before it. The next checkpoint is then reached again and must be the same object. The last run continues
/// to the end. Sampled: 20 steps; 60 with `STRIDE_LONG_TESTS=1`.
#[test]
fn p5_a_kill_at_every_step_changes_no_byte() {
    let steps = if fixtures::long("a kill at each of 60 steps") { 60 } else { 20 };
    for name in ["vae", "mld", "lcm", "pcm"] {
        let mut case = case(name, [steps; 4]);
        let whole: BTreeMap<u64, _> = case.bench.forget_after(name, 0).into_iter().collect();
        let saves = (1..=steps).filter(|step: &u64| step.is_multiple_of(7) || *step == steps);
        assert_eq!(whole.keys().copied().collect::<Vec<_>>(), saves.collect::<Vec<_>>(), "{name}");
        for step in 0..steps {
            case.bench.script = Script { lost: vec![(0, step)], ..Script::default() };
            assert!(case.bench.run(name, &case.settings, &case.inputs).is_err(), "{name}: over before step {step}");
            let next = *whole.range(step + 1..).next().expect("the last is one").0;
            case.bench.script = Script { drain: Some(next - 1), ..Script::default() };
            let ran = case.bench.run(name, &case.settings, &case.inputs);
            let ran = ran.unwrap_or_else(|e| panic!("{name} killed at step {step}: {e}"));
            let (at, saved) = case.bench.newest(name).expect("it has saved");
            assert_eq!((*at, saved.digest()), (next, whole[&next].digest()), "{name} killed at step {step}");
            if next == steps {
                assert_eq!(ran.output(), case.expected, "{name} killed at step {step}");
            }
            case.bench.forget_after(name, step + 1);
        }
    }
}

/// Chains of 1, 2 and 5 kills with 1 to 3 members in turn, for every kind of training stage. Some kills are right after
/// a checkpoint, some before the first, two at one step.
#[test]
fn p5_chains_of_1_2_and_5_kills_change_no_byte() {
    let chains: [&[u64]; 3] = [&[13], &[7, 8], &[2, 9, 9, 15, 17]];
    for name in ["vae", "length", "mld", "lcm", "pcm", "control"] {
        let mut case = case(name, [18; 4]);
        for chain in chains {
            case.run(name, &format!("{name} killed at {chain:?}"), chain);
        }
    }
}

/// The state is a file of two blobs, and the weights are one. Kills change no byte, and the file has the digest that it
/// has in one blob.
#[test]
fn p5_kills_with_a_state_in_several_blobs_change_no_byte() {
    let mut case = case("vae", [18; 4]);
    let (at, whole) = case.bench.newest("vae").expect("it has saved").clone();
    let (name, file) = whole.files.iter().next().expect("the state");
    assert!(file.chunks.is_empty());
    case.bench.chunk_bytes = file.bytes / 2 + 1;
    case.run("vae", "a state in several blobs", &[2, 9, 9, 15, 17]);
    let (again, saved) = case.bench.newest("vae").expect("it has saved");
    let cut = &saved.files[name];
    assert_eq!((*again, cut.digest, cut.bytes, cut.chunks.len()), (at, file.digest, file.bytes, 2));
}

/// 1 -> 3 -> 2 -> 1 members within one stage, without a restart, for every kind of training stage. The joiners adopt
/// the state of a peer. The first member is lost, and so is one of the joiners, in either order.
#[test]
fn p6_members_1_to_3_to_2_to_1_change_no_byte() {
    // Once with results that count as large, which are added as they come.
    let all = ["vae", "length", "mld", "lcm", "pcm", "control"].map(|name| (name, None));
    for (name, large) in all.into_iter().chain([("pcm", Some(0))]) {
        let mut case = case(name, [24; 4]);
        case.bench.large = large;
        assert_eq!(case.settings.shape(), Shape::Gang);
        case.bench.forget(name);
        case.bench.members = 1;
        let lost = if name == "vae" { vec![(0, 13), (2, 19)] } else { vec![(2, 13), (0, 19)] };
        case.bench.script = Script { joins: vec![(1, 5), (2, 5)], lost, ..Script::default() };
        let ran = case.bench.run(name, &case.settings, &case.inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(ran.output(), case.expected, "{name}");
    }
}

/// Sampled: the VAE with two and three members, and only the last checkpoint. The leader is lost in that save. With
/// three members its successor is lost there too. The remaining members still have the state, and nothing is computed
/// again.
#[test]
fn p4_a_leader_that_is_lost_in_its_last_save_costs_nothing() {
    let mut case = case("vae", [20; 4]);
    for (members, lost) in [(2, vec![0]), (3, vec![0, 1])] {
        case.bench.forget("vae");
        case.bench.checkpoint.every = Steps(0);
        case.bench.members = members;
        let lost_saving = lost.into_iter().map(|member| (member, 20)).collect();
        case.bench.script = Script { lost_saving, ..Script::default() };
        let ran = case.bench.run("vae", &case.settings, &case.inputs).unwrap_or_else(|e| panic!("{members}: {e}"));
        assert_eq!(ran.output(), case.expected, "{members} members");
        assert_eq!(case.bench.checkpoints("vae"), [20], "{members} members");
        let steps: Vec<u64> =
            ran.told.records.iter().filter(|(_, key, _)| key == "loss").map(|(step, _, _)| *step).collect();
        assert_eq!(steps, (1..=20).collect::<Vec<_>>(), "{members} members: no step is applied twice");
    }
}

/// Sampled: the VAE with two and three members. The leader learns in a save that another member leads now, in the middle
/// and at the end. The next leader saves, and nothing is computed again.
#[test]
fn p4_a_leader_that_is_succeeded_during_a_save_costs_nothing() {
    let mut case = case("vae", [20; 4]);
    for (members, step, saved) in [(2, 20, &[20][..]), (3, 20, &[20]), (2, 10, &[11, 20]), (3, 10, &[11, 20])] {
        case.bench.forget("vae");
        case.bench.checkpoint.every = Steps(if step == 10 { 10 } else { 0 });
        case.bench.members = members;
        case.bench.script = Script { demoted_saving: vec![(0, step)], ..Script::default() };
        let ran = case.bench.run("vae", &case.settings, &case.inputs).unwrap_or_else(|e| panic!("{members}: {e}"));
        assert_eq!(ran.output(), case.expected, "{members} members");
        assert_eq!(case.bench.checkpoints("vae"), saved, "{members} members");
    }
}

/// A student and a discriminator that take turns, with members lost and gained.
#[test]
fn p6_alternating_updates_change_no_byte() {
    let mut case = case("pcm", [24; 4]);
    let both = case.expected;
    let StageSettings::DistillPcm(pcm) = &mut case.settings else { panic!("distill.pcm") };
    pcm.alternate = true;
    case.bench.forget("pcm");
    case.expected = case.bench.run("pcm", &case.settings, &case.inputs).expect("it runs").output();
    assert_ne!(case.expected, both);
    case.run("pcm", "alternating pcm killed at two steps", &[8, 13]);
    case.bench.forget("pcm");
    case.bench.members = 1;
    case.bench.script = Script { joins: vec![(1, 5), (2, 5)], lost: vec![(2, 13), (0, 19)], ..Script::default() };
    let ran = case.bench.run("pcm", &case.settings, &case.inputs).expect("it runs");
    assert_eq!(ran.output(), case.expected);
}
