//! The coordinator's memory on disk: the facts of each decision, and a snapshot of the state every so many of them.
//!
//! Recovery is the newest snapshot and the facts after it, applied in order; nothing is decided again. Both carry [`FORMAT`].

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::{Fence, Incarnation, WorkerId};
use registry::Recovery;
use serde::{Deserialize, Serialize};

use crate::fact::Fact;
use crate::policy::Policy;
use crate::state::State;
use crate::state::execution::StageExecution;
use crate::state::run::Run;
use crate::state::worker::Worker;
use crate::time::Millis;

/// The version of what is stored. Another major version is refused. A later minor one has kinds or fields that this build does not know:
/// it is read for as long as none of them occurs.
pub const FORMAT: (u32, u32) = (1, 2);

/// What cannot be recovered.
#[derive(Debug, thiserror::Error)]
#[error("{what} {problem}")]
pub struct RecoverError {
    /// The snapshot or the decision, by number.
    pub what: String,
    /// What is wrong with it.
    pub problem: String,
}

/// What one event came to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// When.
    pub now: Millis,
    /// What is so from then on, in this order.
    pub facts: Vec<Fact>,
}

#[derive(Serialize, Deserialize)]
struct Versioned<T> {
    format: (u32, u32),
    #[serde(flatten)]
    content: T,
}

#[derive(Deserialize)]
struct Nothing {}

impl Decision {
    /// As it is stored.
    pub fn to_json(&self) -> String {
        #[derive(Serialize)]
        struct Stored<'a> {
            format: (u32, u32),
            now: Millis,
            facts: &'a [Fact],
        }
        let stored = Stored { format: FORMAT, now: self.now, facts: &self.facts };
        serde_json::to_string(&stored).expect("facts serialise")
    }

    /// Reads what [`to_json`](Self::to_json) wrote.
    ///
    /// # Errors
    /// Why it does not read, with the version that wrote it.
    pub fn from_json(text: &str) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Stored {
            format: (u32, u32),
            now: Millis,
            facts: Vec<Fact>,
        }
        let stored: Stored = read(text)?;
        check_format(stored.format)?;
        Ok(Self { now: stored.now, facts: stored.facts })
    }
}

fn read<'a, T: Deserialize<'a>>(text: &'a str) -> Result<T, String> {
    serde_json::from_str(text).map_err(|error| {
        // The version says more than whatever it was that did not read.
        let version: Result<Versioned<Nothing>, _> = serde_json::from_str(text);
        match version.map(|version| (version.format, check_format(version.format))) {
            Ok((_, Err(problem))) => problem,
            Ok((found, Ok(()))) if found > FORMAT => {
                format!("cannot be read: {error}; it is of format {}.{}, use the build that wrote it", found.0, found.1)
            }
            _ => format!("cannot be read: {error}"),
        }
    })
}

fn check_format((major, minor): (u32, u32)) -> Result<(), String> {
    if major == FORMAT.0 {
        return Ok(());
    }
    Err(format!("is of format {major}.{minor}, this build reads {}.x; use the build that wrote it", FORMAT.0))
}

#[derive(Serialize)]
struct SnapshotOf<'a> {
    format: (u32, u32),
    seq: u64,
    now: Millis,
    submitted: u64,
    incarnation: Incarnation,
    fence: Fence,
    draining: bool,
    workers: &'a BTreeMap<WorkerId, Worker>,
    runs: Vec<&'a Run>,
    executions: Vec<&'a StageExecution>,
}

#[derive(Deserialize)]
struct Snapshot {
    format: (u32, u32),
    seq: u64,
    now: Millis,
    submitted: u64,
    incarnation: Incarnation,
    fence: Fence,
    draining: bool,
    workers: BTreeMap<WorkerId, Worker>,
    runs: Vec<Run>,
    executions: Vec<StageExecution>,
}

/// The state as it is stored, after decision [`State::seq`].
pub fn snapshot(state: &State) -> String {
    let snapshot = SnapshotOf {
        format: FORMAT,
        seq: state.seq,
        now: state.now,
        submitted: state.submitted,
        incarnation: state.incarnation,
        fence: state.fence,
        draining: state.draining,
        workers: &state.workers,
        runs: state.runs.values().map(|run| &**run).collect(),
        executions: state.executions.values().map(|execution| &**execution).collect(),
    };
    serde_json::to_string(&snapshot).expect("a state serialises")
}

/// The state of a snapshot.
fn restore(policy: Policy, text: &str) -> Result<State, String> {
    let snapshot: Snapshot = read(text)?;
    check_format(snapshot.format)?;
    let mut state = State {
        seq: snapshot.seq,
        now: snapshot.now,
        submitted: snapshot.submitted,
        incarnation: snapshot.incarnation,
        fence: snapshot.fence,
        draining: snapshot.draining,
        workers: Arc::new(snapshot.workers),
        runs: snapshot.runs.into_iter().map(|run| (run.number, Arc::new(run))).collect(),
        executions: snapshot.executions.into_iter().map(|execution| (execution.key, Arc::new(execution))).collect(),
        ..State::new(policy)
    };
    state.index();
    Ok(state)
}

/// The state after all that is stored.
///
/// # Errors
/// What does not read, does not follow on what is before it, or was written in another format.
pub fn recover(policy: Policy, stored: &Recovery) -> Result<State, RecoverError> {
    let mut state = match &stored.snapshot {
        Some((seq, text)) => {
            let at = |problem| RecoverError { what: format!("the snapshot of decision {seq}"), problem };
            restore(policy, text).map_err(at)?
        }
        None => State::new(policy),
    };
    for (seq, text) in stored.facts.iter().filter(|(seq, _)| *seq > stored.snapshot.as_ref().map_or(0, |(seq, _)| *seq))
    {
        let at = |problem| RecoverError { what: format!("decision {seq}"), problem };
        if *seq != state.seq + 1 {
            return Err(at(format!("follows on decision {}: what is between is missing", state.seq)));
        }
        let decision = Decision::from_json(text).map_err(at)?;
        for fact in &decision.facts {
            state.apply(fact).map_err(|misfit| at(format!("does not fit: {misfit}")))?;
        }
        (state.seq, state.now) = (*seq, decision.now);
    }
    Ok(state)
}
