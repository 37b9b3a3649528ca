//! Stages that read files outside the store. If a submission lacks their digests, a worker computes them before the
//! stage has a key.

use std::collections::BTreeMap;

use crate::common::{PureCoordinator, failed};
use coordinator::{Control, Effect, Event, Policy};
use pipeline::Pipeline;
use protocol::message::{Assignment, FailureClass, ReportOutcome, Role, RunState, StageState, TaskOutcome};
use protocol::{Digest, RunId};

/// A pipeline with a dataset's folder.
const TEXT: &str = "name: p
dataset: {format: kit, path: /data/kit}
stages:
  vae: {kind: train.vae}
";

fn pipeline(digest: Option<&[u8]>) -> Pipeline {
    let mut pipeline = pipeline::read("p.yaml", TEXT, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    if let Some(content) = digest {
        pipeline.fill_external(|_, _| Ok::<_, ()>(Digest::of(content))).expect("one folder");
    }
    pipeline
}

fn submit(coordinator: &mut PureCoordinator, pipeline: Pipeline) -> RunId {
    let pipeline = Box::new(pipeline);
    let until = pipeline.stage(&"vae".into()).is_some().then(|| "dataset".into());
    let owner = protocol::Owner::local("me");
    let event =
        Event::Submit { submission: None, pipeline, source: String::new(), idempotency_key: None, until, owner };
    let effects = coordinator.happen(event).expect("submitted");
    let run = effects.into_iter().find_map(|effect| match effect {
        Effect::Submitted(run) => Some(run),
        _ => None,
    });
    run.expect("a submission gives a run")
}

fn resolved(content: &[u8]) -> TaskOutcome {
    TaskOutcome::Resolved { digests: BTreeMap::from([("path".to_owned(), Digest::of(content))]) }
}

fn finished(output: &[u8]) -> TaskOutcome {
    TaskOutcome::Finished { output: Digest::of(output), metrics: BTreeMap::new() }
}

fn refused(coordinator: &mut PureCoordinator, assignment: &Assignment, outcome: TaskOutcome) -> String {
    let report = ReportOutcome::new(assignment.grant.clone(), outcome);
    coordinator.happen(Event::Outcome { report }).expect_err("refused").to_string()
}

#[test]
fn a_stage_without_digests_gets_its_key_from_what_a_worker_finds() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.join("a");
    let run = submit(&mut coordinator, pipeline(None));
    let first = coordinator.assignment("a").expect("its files are digested first");
    assert_eq!(first.role, Role::Resolve);
    assert!(first.stage.inputs.is_empty());
    let unresolved = coordinator.view(&run).stages[0].key;

    // A resolving task accepts neither a value nor digests of other fields.
    let said = refused(&mut coordinator, &first, finished(b"poison"));
    assert!(said.contains("has no artifact"), "{said}");
    let other = TaskOutcome::Resolved { digests: BTreeMap::from([("words".to_owned(), Digest::of(b"x"))]) };
    let said = refused(&mut coordinator, &first, other);
    assert!(said.contains("digests of other files"), "{said}");

    coordinator.report(&first, resolved(b"the folder"));
    let second = coordinator.assignment("a").expect("now the stage");
    assert_eq!(second.role, Role::Alone);
    assert_eq!(second.stage.inputs["path"], Digest::of(b"the folder"));
    assert_ne!(second.grant.task, first.grant.task);
    let key = coordinator.view(&run).stages[0].key;
    assert_ne!(key, unresolved);

    // The digests survive a restart.
    coordinator.restart(false);
    let again = coordinator.assignment("a").expect("still its own");
    assert_eq!((again.role.clone(), &again.stage.inputs), (Role::Alone, &second.stage.inputs));
    let said = refused(&mut coordinator, &again, resolved(b"another"));
    assert!(said.contains("needs no digests"), "{said}");
    coordinator.report(&again, finished(b"clips"));
    let view = coordinator.view(&run);
    assert_eq!((view.state, view.stages[0].state, view.stages[0].key), (RunState::Finished, StageState::Ran, key));

    // A submission with this digest has the same key, and one with another digest has a different key. Without a
    // digest, a worker digests the files again.
    let same = submit(&mut coordinator, pipeline(Some(b"the folder")));
    assert_eq!(coordinator.view(&same).stages[0].state, StageState::Cached);
    submit(&mut coordinator, pipeline(None));
    let third = coordinator.assignment("a").expect("digested again");
    assert_eq!(third.role, Role::Resolve);
    coordinator.report(&third, resolved(b"another folder"));
    let fourth = coordinator.assignment("a").expect("computed");
    assert_eq!((fourth.role, fourth.stage.inputs["path"]), (Role::Alone, Digest::of(b"another folder")));
}

#[test]
fn files_that_cannot_be_digested_fail_the_stage_and_are_digested_again_when_it_is_resumed() {
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.join("a");
    let run = submit(&mut coordinator, pipeline(None));
    let first = coordinator.assignment("a").expect("its files are digested first");
    coordinator.report(&first, failed(FailureClass::Input));
    assert_eq!(coordinator.run_state(&run), RunState::Failed);
    coordinator.control(&run, Control::Resume).expect("taken up");
    let second = coordinator.assignment("a").expect("digested again");
    assert_eq!((&second.role, &second.grant.task), (&Role::Resolve, &first.grant.task));
    assert!(second.grant.fence > first.grant.fence);
    coordinator.report(&second, resolved(b"mended"));
    let third = coordinator.assignment("a").expect("computed");
    assert_eq!(third.stage.inputs["path"], Digest::of(b"mended"));
    // A differing copy is a final failure too. Resuming the run discards the earlier digests.
    coordinator.report(&third, failed(FailureClass::Input));
    coordinator.control(&run, Control::Resume).expect("taken up");
    let fourth = coordinator.assignment("a").expect("digested once more");
    assert_eq!(fourth.role, Role::Resolve);
    coordinator.report(&fourth, resolved(b"once more"));
    let fifth = coordinator.assignment("a").expect("computed");
    coordinator.report(&fifth, finished(b"clips"));
    assert_eq!(coordinator.run_state(&run), RunState::Finished);
}

/// Gang members prefetch artifacts; the digest of a folder is not one.
#[test]
fn nothing_outside_the_store_is_fetched_ahead() {
    let text = "name: p
dataset: {format: synthetic}
stages:
  judge: {kind: train.evaluator, words: /data/glove}
";
    let mut pipeline = pipeline::read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    pipeline.fill_external(|_, _| Ok::<_, ()>(Digest::of(b"glove"))).expect("one folder");
    let mut coordinator = PureCoordinator::new(Policy::default());
    coordinator.quick = false;
    coordinator.join("a");
    submit(&mut coordinator, pipeline);
    let dataset = coordinator.assignment("a").expect("the clips");
    coordinator.report(&dataset, finished(b"clips"));
    let asked = coordinator.asked("a");
    assert_eq!(asked.len(), 1);
    assert_eq!(asked[0].inputs, BTreeMap::from([("dataset".to_owned(), Digest::of(b"clips"))]));
    coordinator.prepare("a");
    let judge = coordinator.assignment("a").expect("it trains");
    assert_eq!(judge.stage.inputs["words"], Digest::of(b"glove"));
}
