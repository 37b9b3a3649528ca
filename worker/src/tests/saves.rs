//! Checkpoints that are stored while the stage trains on.

use stages::context::ContextError;

use super::*;

/// Bytes of a state whose copy is in a file.
const LARGE: usize = 17 << 20;

/// Makes `count` steps after `done` ones with a gang of this worker alone.
fn steps(context: &mut dyn GangContext, done: u64, count: u64) -> Result<(), StageError> {
    for step in done..done + count {
        let mut parts: Vec<_> = context.share(2).map(|slice| (slice..slice + 1, vec![1.0])).collect();
        let exchanged = context.exchange(step..step + 1, 2, &mut parts)?;
        assert!(matches!(exchanged, Exchange::Sum { .. }), "{exchanged:?}");
        context.record(step + 1, &[("loss", 1.0)]);
        context.progress(step + 1, 10, "steps", &[]);
    }
    Ok(())
}

/// Grants the task to the worker. The store has no room.
fn grant_without_room(worker: &Worker) {
    worker.wait("a join", |coordinator| coordinator.joins == 1);
    worker.fake.full.store(true, Ordering::SeqCst);
    worker.grant(1);
}

fn progress(coordinator: &FakeState) -> Option<u64> {
    Some(coordinator.last_poll.as_ref()?.doing.first()?.progress.done)
}

/// For a state in memory and one in a file.
#[test]
fn a_stage_trains_on_while_its_checkpoint_is_stored() {
    for bytes in [100, LARGE] {
        let worker = Worker::start(Box::new(move |context| {
            context.rendezvous(None, &[])?;
            steps(context, 0, 1)?;
            let mut state = vec![1; bytes];
            context.save(checkpoint(1, serde_json::Value::Null), &[("state", &[&state[..10], &state[10..]])])?;
            state.fill(2);
            steps(context, 1, 4)?;
            assert!(context.saved(false).is_none(), "the store has no room yet");
            assert_eq!(context.saved(true).expect("a save was begun")?, 1);
            assert!(context.saved(true).is_none(), "the result is taken");
            finished(context)
        }));
        grant_without_room(&worker);
        worker.wait("four more steps", |coordinator| progress(coordinator) == Some(5));
        assert!(worker.fake.turned_down.load(Ordering::SeqCst) > 0);
        assert!(lock(&worker.fake.coordinator).checkpoints.is_empty());
        worker.fake.full.store(false, Ordering::SeqCst);
        worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
        let coordinator = worker.leave();
        assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
        let [commit] = &coordinator.checkpoints[..] else { panic!("{:?}", coordinator.checkpoints) };
        assert_eq!(commit.step, 1);
        assert!(coordinator.blobs[&Digest::of(&vec![1; bytes])].iter().all(|byte| *byte == 1), "as it was at the save");
    }
}

/// The folder of the copies is gone, as one on a full disk takes nothing.
#[test]
fn a_state_that_cannot_be_copied_is_stored_while_the_stage_waits() {
    let folder = tempfile::tempdir().expect("a folder");
    let cache = Cache::new(Some(folder.path().to_owned()), None, Bounds::default()).expect("writable");
    drop(folder);
    let script = Box::new(|context: &mut dyn GangContext| {
        context.rendezvous(None, &[])?;
        steps(context, 0, 1)?;
        let state = vec![1; LARGE];
        context.save(checkpoint(1, serde_json::Value::Null), &[("state", &[&state])])?;
        assert_eq!(context.saved(false).expect("it is stored")?, 1);
        finished(context)
    });
    let worker = Worker::start_on(script, StageLimits { memory: None, ..StageLimits::default() }, cache);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert!(matches!(coordinator.outcomes[0].outcome, TaskOutcome::Finished { .. }), "{:?}", coordinator.outcomes);
    assert_eq!(coordinator.blobs[&Digest::of(&vec![1; LARGE])].len(), LARGE);
}

#[test]
fn a_save_that_may_wait_is_put_off_by_a_busy_store_and_another_follows() {
    let worker = Worker::start(Box::new(|context| {
        context.rendezvous(None, &[])?;
        let may_wait = |step| Checkpoint { may_wait: true, ..checkpoint(step, serde_json::Value::Null) };
        context.save(may_wait(1), &[("state", &[&[1]])])?;
        let put_off = context.saved(true).expect("a save was begun");
        assert!(matches!(put_off, Err(ContextError::Unavailable(_))), "{put_off:?}");
        assert!(!context.can_save(), "not at once");
        steps(context, 0, 2)?;
        // The last save waits for the store.
        context.save(checkpoint(2, serde_json::Value::Null), &[("state", &[&[2]])])?;
        assert_eq!(context.saved(true).expect("a save was begun")?, 2);
        Ok(Outcome::Yielded { at: 2 })
    }));
    grant_without_room(&worker);
    worker.wait("two steps", |coordinator| progress(coordinator) == Some(2));
    worker.fake.full.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let steps: Vec<u64> = coordinator.checkpoints.iter().map(|commit| commit.step).collect();
    assert_eq!(steps, [2]);
    assert!(coordinator.logs.values().any(|line| line.starts_with("the checkpoint after step 1 is delayed")));
}

/// A stage that fails has stored the checkpoint that it began to save, and its outcome follows.
#[test]
fn a_save_under_way_is_complete_before_the_outcome_is_reported() {
    let worker = Worker::start(Box::new(|context| {
        context.rendezvous(None, &[])?;
        steps(context, 0, 1)?;
        context.save(checkpoint(1, serde_json::Value::Null), &[("state", &[&[1]])])?;
        Err(StageError::Diverged { step: 1, loss: f64::NAN, norm: 1.0 })
    }));
    worker.fake.slow.store(true, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("a step", |coordinator| progress(coordinator) == Some(1));
    // The stage has failed by then.
    thread::sleep(Duration::from_millis(500));
    assert!(lock(&worker.fake.coordinator).outcomes.is_empty());
    worker.fake.slow.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert_eq!(lock(&worker.fake.coordinator).checkpoints.len(), 1);
    assert!(matches!(worker.leave().outcomes[0].outcome, TaskOutcome::Failed { class: FailureClass::Diverged, .. }));
}

#[test]
fn a_save_ends_with_the_grant() {
    let worker = Worker::start(Box::new(|context| {
        context.rendezvous(None, &[])?;
        context.save(checkpoint(1, serde_json::Value::Null), &[("state", &[&[1]])])?;
        context.progress(1, 10, "steps", &[]);
        let ended = context.saved(true).expect("a save was begun");
        assert!(matches!(ended, Err(ContextError::GrantEnded(_))), "{ended:?}");
        Err(ended.expect_err("the store has no room").into())
    }));
    grant_without_room(&worker);
    worker.wait("a step", |coordinator| progress(coordinator) == Some(1));
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    let coordinator = worker.leave();
    assert!(coordinator.checkpoints.is_empty() && coordinator.outcomes.is_empty(), "{coordinator:?}");
}
