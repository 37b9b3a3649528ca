//! Every kind of event, for every object in a state and for some that do not exist.

use std::collections::BTreeMap;
use std::sync::Arc;

use coordinator::state::execution::StageExecution;
use coordinator::state::run::Run;
use coordinator::state::worker::Identity;
use coordinator::value::Known;
use coordinator::{Control, Event, State};
use protocol::message::{CommitCheckpoint, FailureClass, Grant, Join, PROTOCOL_VERSION, ReportOutcome, TaskOutcome};
use protocol::stage::Backend;
use protocol::{Digest, Fence, Incarnation, RunId, TaskId, WorkerId};

pub(crate) fn events(state: &State, ended: &[Run]) -> Vec<Event> {
    let mut events = vec![
        Event::Started { alone: false, park: false },
        Event::Started { alone: true, park: true },
        Event::Drain,
        Event::Limits { limits: Arc::default() },
        Event::Limits { limits: crate::world::limits(1) },
        Event::Submit {
            submission: None,
            pipeline: Box::new(crate::pipelines::quickstart(0, Default::default(), &[])),
            source: String::new(),
            idempotency_key: None,
            until: Some("nowhere".into()),
            owner: protocol::Owner::local("me"),
        },
    ];
    let nobody: WorkerId = "nobody".into();
    for worker in state.workers.keys().chain([&nobody]) {
        let incarnation = state.workers.get(worker).map_or(Incarnation(9), |worker| worker.incarnation);
        let (worker_name, peer_address) = (worker.clone(), "x:1".into());
        let join = Join {
            protocol: PROTOCOL_VERSION,
            worker: worker_name,
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            code_versions: protocol::stage::StageSettings::code_versions(),
            peer_address,
            labels: Default::default(),
        };
        for caller in ["t", "another"] {
            for secret in [format!("{worker} 1"), "another".to_owned()] {
                let by = Identity { caller: caller.into(), secret: Digest::of(secret.as_bytes()) };
                events.push(Event::Join { join: join.clone(), by });
            }
        }
        events.push(Event::WorkerBack { worker: worker.clone() });
        let tasks = state.tasks.keys().take(3).cloned().chain(["none".into()]).collect();
        events.push(Event::WorkerReady { worker: worker.clone(), incarnation, tasks });
        events.push(Event::WorkerLeaves { worker: worker.clone(), incarnation });
        events.push(Event::LeaseExpired { worker: worker.clone(), incarnation });
        events.push(Event::LeaseExpired { worker: worker.clone(), incarnation: Incarnation(0) });
        for incarnation in [None, Some(incarnation), Some(Incarnation(0))] {
            events.push(Event::WorkerGone { worker: worker.clone(), incarnation });
        }
        events.push(Event::WorkerForgotten { worker: worker.clone(), incarnation });
    }
    let no_run: RunId = "no-run".into();
    for run in state.runs.values().map(|run| &run.id).chain([&no_run]) {
        for action in [Control::Pause, Control::Resume, Control::Cancel] {
            events.push(Event::Control { run: run.clone(), action, archived: None });
        }
    }
    for run in ended {
        for action in [Control::Pause, Control::Resume, Control::Cancel] {
            let archived = Some(Box::new(run.clone()));
            events.push(Event::Control { run: run.id.clone(), action, archived });
        }
    }
    let known = Known { outputs: BTreeMap::from([("x".into(), Digest::of(b"x"))]), metrics: BTreeMap::new() };
    for key in state.executions.keys().copied().chain([Digest::of(b"no key")]) {
        let source = Some(("r-1".into(), "s".into()));
        events.push(Event::LookedUp { key, known: Some(known.clone()), source, archived: None });
        events.push(Event::LookedUp { key, known: None, source: None, archived: None });
        let archived = state.executions.get(&key).map(|execution| Box::new(StageExecution::clone(execution)));
        events.push(Event::LookedUp { key, known: None, source: None, archived });
        events.push(Event::Bundled { key, bundles: vec![Digest::of(b"1"), Digest::of(b"2")] });
        events.push(Event::Bundled { key, bundles: vec![] });
        events.push(Event::Quiet { key, for_ms: 60_000 });
        events.push(Event::RegisterRefused { key, message: "no".into() });
    }
    let no_task: TaskId = "no/task".into();
    for task in state.tasks.keys().chain([&no_task]) {
        events.push(Event::BackoffOver { task: task.clone() });
        for grant in grants(state, task, &nobody) {
            events.push(Event::GraceOver { task: task.clone(), fence: grant.fence });
            events.push(Event::GangDivided { task: task.clone(), fence: grant.fence });
            events.push(Event::GangStalled { task: task.clone(), fence: grant.fence });
            let commit = CommitCheckpoint {
                grant: grant.clone(),
                step: 2,
                manifest: Digest::of(b"m"),
                metrics: BTreeMap::new(),
            };
            events.push(Event::Checkpoint { commit });
            let failed = |class| TaskOutcome::Failed { class, message: "made up".into() };
            for outcome in [
                TaskOutcome::Finished { output: Digest::of(b"o"), metrics: BTreeMap::new() },
                TaskOutcome::Yielded { at: 2 },
                failed(FailureClass::Input),
                failed(FailureClass::Diverged),
                failed(FailureClass::OutOfMemory),
                failed(FailureClass::Storage),
                failed(FailureClass::Damaged),
                failed(FailureClass::Fault),
                failed(FailureClass::Infrastructure),
            ] {
                events.push(Event::Outcome { report: ReportOutcome::new(grant.clone(), outcome) });
            }
        }
    }
    events
}

/// Grants of the holders, an outdated one, one from the future, and a stranger's.
fn grants(state: &State, task: &TaskId, nobody: &WorkerId) -> Vec<Grant> {
    let stranger = Grant {
        task: task.clone(),
        attempt: Default::default(),
        fence: Fence(0),
        worker: nobody.clone(),
        incarnation: Incarnation(1),
    };
    let Ok((_, task)) = state.task(task) else { return vec![stranger] };
    let mut grants: Vec<Grant> =
        task.holders().iter().map(|member| task.grant_of(&member.worker, member.incarnation)).collect();
    let current = task.grant_of(nobody, Incarnation(1));
    grants.push(Grant { fence: Fence(task.fence.0.saturating_sub(1)), ..current.clone() });
    grants.push(Grant { fence: task.fence.next(), ..current.clone() });
    grants.push(current);
    grants.push(stranger);
    grants
}
