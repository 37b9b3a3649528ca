//! A journal as an older build left it, replayed by this one.
//!
//! `testdata/journal.jsonl` is a run of each kind of training, map and register stage from submission to end, by one worker that was killed
//! once, as a build of November 2026 wrote it; `make_the_sample` wrote it. It is not written again when the code changes: that it stays
//! readable is what is tested.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use coordinator::event::Known;
use coordinator::state::run::Status;
use coordinator::{Effect, Event, Millis, Moment, Observation, Policy, State, decide, journal, observe};
use protocol::Digest;
use protocol::message::{
    Assignment, CommitCheckpoint, Join, PROTOCOL_VERSION, Poll, ReportOutcome, Role, RunState, TaskOutcome,
};
use protocol::stage::Backend;
use serde_json::Value;

const PIPELINE: &str = "name: stored
seed: 7
dataset: {format: synthetic, clips: 40}
stages:
  vae: {kind: train.vae, steps: 40, checkpoint: {every: 20}}
  latents: {kind: encode.latents, shards: 2}
  mld: {kind: train.mld, steps: 40}
  lcm: {kind: distill.lcm, steps: 40}
  pcm: {kind: distill.pcm, steps: 40, phases: 2}
  judge: {kind: train.evaluator, steps: 40}
  recon: {kind: evaluate.reconstruction, shards: 2}
  fid: {kind: evaluate.latent_fid, model: pcm, sampler: {steps: 2}, repeats: 2, shards: 2}
  t2m: {kind: evaluate.t2m, model: pcm, evaluator: judge, sampler: {steps: 2}, repeats: 2, shards: 2}
  release: {kind: register, model: stored, from: [pcm], metric: latent_fid, promote: {to: staging}}
";

fn sample() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("testdata/journal.jsonl")
}

fn entries(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"))).collect()
}

fn stored() -> Vec<Value> {
    entries(&std::fs::read_to_string(sample()).expect("the sample"))
}

/// What the run came to, and that it is what the journal's own entries say.
fn check(state: &State, journal: &[Value]) {
    let [run] = &state.runs[..] else { panic!("one run, not {}", state.runs.len()) };
    assert_eq!(run.state, RunState::Finished);
    let of = |event: &str| journal.iter().filter(|entry| entry["event"] == *event).collect::<Vec<_>>();
    // Names and keys are derived anew; what the workers and the store answered names them.
    for report in of("outcome") {
        let task = report["report"]["grant"]["task"].as_str().expect("a task");
        assert!(task.starts_with(&format!("{}/", run.id)), "{task} is not of run {}", run.id);
    }
    let known: BTreeSet<&str> = of("looked-up").iter().filter_map(|entry| entry["key"].as_str()).collect();
    assert_eq!(run.stages.len(), known.len());
    for (stage, status) in run.pipeline.stages.iter().zip(&run.stages) {
        let Status::Done { key, known: value, .. } = status else { panic!("{} is {status:?}", stage.name) };
        assert!(known.contains(key.to_string().as_str()), "the key of {} is another", stage.name);
        assert!(!value.outputs.is_empty(), "{} has no output", stage.name);
    }
    let vae = run.status(&"vae".into()).expect("a stage");
    assert!(matches!(vae, Status::Done { attempt, .. } if attempt.0 == 2), "its first try was lost: {vae:?}");
}

#[test]
fn a_stored_journal_replays_to_its_end() {
    let journal = stored();
    check(&journal::replay(Policy::default(), journal.clone()).expect("it replays"), &journal);
}

/// The same without fields of all kinds of places, as if they had joined later with the defaults that they have.
#[test]
fn a_journal_without_fields_that_joined_later_replays_to_its_end() {
    let mut journal = stored();
    let submit = journal.iter_mut().find(|entry| entry["event"] == "submit").expect("a submission");
    let later = [
        ("vae", "/settings/loss", "joint_from"),
        ("vae", "/settings/network", "positions"),
        ("vae", "/settings", "windows"),
        ("mld", "/settings", "guidance_dropout"),
        ("lcm", "/settings", "upstream_dropout"),
        ("pcm", "/settings", "discriminator_optimizer"),
        ("pcm", "/settings", "optimizer"),
        ("judge", "/settings/movement", "sparsity"),
        ("fid", "/settings", "components"),
        ("t2m", "/settings", "widen"),
        ("t2m", "/settings/sampler", "timesteps"),
        ("t2m", "/settings/multimodality", "pairs"),
        ("release", "/settings/promote", "require"),
        ("vae", "/placement/checkpoint", "keep"),
        ("mld", "/placement", "workers"),
    ];
    for (stage, parent, field) in later {
        let stages = submit["pipeline"]["stages"].as_array_mut().expect("stages");
        let stage = stages.iter_mut().find(|candidate| candidate["name"] == stage).expect("a stage of that name");
        let parent = stage.pointer_mut(parent).and_then(Value::as_object_mut).expect("a mapping");
        parent.remove(field).unwrap_or_else(|| panic!("the sample has no `{field}`"));
    }
    let text: String = journal.iter().map(|entry| format!("{entry}\n")).collect();
    assert!(!text.contains("widen"));
    let journal = entries(&text);
    check(&journal::replay(Policy::default(), journal.clone()).expect("it replays"), &journal);
}

/// An entry that cannot be read is named with its number and with what is missing.
#[test]
fn an_entry_that_cannot_be_read_is_named() {
    let mut journal = stored();
    let at = journal.iter().position(|entry| entry["event"] == "outcome").expect("an outcome");
    journal[at]["report"].as_object_mut().expect("a mapping").remove("grant");
    let said = journal::replay(Policy::default(), journal).expect_err("a report without a grant").to_string();
    assert!(said.contains(&format!("entry {} ", at + 1)) && said.contains("missing field `grant`"), "{said}");
}

#[test]
#[ignore = "writes the sample: cargo test -p coordinator --test stored_journal -- --ignored"]
fn make_the_sample() {
    let mut actor_handle = ActorHandle { state: State::new(Policy::default()), journal: Vec::new(), now: 1_000_000 };
    let pipeline = protocol::pipeline::read("stored.yaml", PIPELINE, &[]).unwrap_or_else(|e| panic!("{e}"));
    actor_handle.happen(Event::Started { alone: false, park: false });
    let submit = Event::Submit {
        pipeline: Box::new(pipeline),
        source: PIPELINE.into(),
        idempotency_key: Some("once".into()),
        until: None,
    };
    actor_handle.happen(submit);
    actor_handle.join();
    let mut lost = false;
    while !actor_handle.state.runs[0].state.is_final() {
        actor_handle.now += 1000;
        actor_handle.poll();
        let Some(assignment) = actor_handle.assignment() else { continue };
        let grant = assignment.grant.clone();
        if matches!(assignment.role, Role::Member { .. }) && assignment.resume.is_none() {
            let manifest = Digest::of(format!("{} at 20", grant.task).as_bytes());
            let metrics = BTreeMap::from([("loss".to_owned(), 0.5)]);
            actor_handle.happen(Event::Checkpoint {
                commit: CommitCheckpoint { grant: grant.clone(), step: 20, manifest, metrics },
            });
        }
        if assignment.stage.name.as_str() == "vae" && !lost {
            lost = true;
            actor_handle.now += 400;
            actor_handle.happen(Event::WorkerGone { worker: "w".into() });
            actor_handle.now += 10_000;
            actor_handle.join();
            continue;
        }
        let output = Digest::of(grant.task.as_str().as_bytes());
        let metrics = BTreeMap::from([("latent_fid".to_owned(), 0.1)]);
        actor_handle.happen(Event::Outcome {
            report: ReportOutcome { grant, outcome: TaskOutcome::Finished { output, metrics } },
        });
    }
    let text: String = actor_handle.journal.iter().map(|entry| format!("{entry}\n")).collect();
    std::fs::create_dir_all(sample().parent().expect("a folder")).expect("a folder");
    std::fs::write(sample(), text).expect("written");
}

/// A coordinator without a shell, for the sample.
struct ActorHandle {
    state: State,
    journal: Vec<Value>,
    now: u64,
}

impl ActorHandle {
    fn happen(&mut self, event: Event) {
        let moment = Moment { now: Millis(self.now), entropy: Digest::of(b"entropy") };
        for effect in decide(&mut self.state, moment, event).expect("taken") {
            match effect {
                Effect::Store(writes) => self.journal.extend(writes.into_iter().filter_map(|write| match write {
                    registry::Write::Journal(entry) => Some(entry),
                    _ => None,
                })),
                Effect::Lookup { key } => self.happen(Event::LookedUp { key, known: None::<Known> }),
                Effect::Register { key, candidates } => {
                    let bundles = candidates.iter().map(|c| Digest::of(c.stage.as_str().as_bytes())).collect();
                    self.happen(Event::Bundled { key, bundles });
                }
                _ => {}
            }
        }
    }

    fn join(&mut self) {
        let join = Join {
            protocol: PROTOCOL_VERSION,
            worker: "w".into(),
            pid: 1,
            backend: Backend::Flex,
            peer_address: "w:1".into(),
        };
        self.happen(Event::Join { join });
    }

    fn poll(&mut self) {
        let incarnation = self.state.workers[&"w".into()].incarnation;
        let poll = Poll { incarnation, doing: Vec::new(), version: 0 };
        let heard = Observation::Poll { worker: "w".into(), poll };
        for observation in [heard, Observation::Tick] {
            for event in observe(&mut self.state, Millis(self.now), observation).expect("heard") {
                self.happen(event);
            }
        }
    }

    fn assignment(&self) -> Option<Assignment> {
        let incarnation = self.state.workers[&"w".into()].incarnation;
        self.state.desired(&"w".into(), incarnation).expect("known").assignments.into_iter().next()
    }
}
