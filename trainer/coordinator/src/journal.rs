//! The stored form of the state: the facts of each decision, and snapshots at intervals. A snapshot consists of parts,
//! and the next one writes only changed parts.
//!
//! Recovery loads the newest snapshot and applies the facts after it in order, without deciding again. Both carry
//! [`FORMAT`].

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
use crate::state::shared::Map;
use crate::state::worker::Worker;
use crate::time::Millis;

/// The version of stored data. Other major versions are refused. A later minor version may have unknown kinds or
/// fields; it is readable as long as none of them occurs.
pub const FORMAT: (u32, u32) = (2, 3);

/// An error in recovered data.
#[derive(Debug, thiserror::Error)]
#[error("{what} {problem}")]
pub struct RecoverError {
    /// The snapshot or the decision, with its number.
    pub what: String,
    pub problem: String,
}

/// The facts of one event.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// The time of the decision.
    pub now: Millis,
    /// Facts in the order of application.
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
    /// Serialises the decision for storage.
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

    /// Reads the output of [`to_json`](Self::to_json).
    ///
    /// # Errors
    /// The reason, with the version that wrote the text.
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
        // A version mismatch explains more than the parse error that it causes.
        let version: Result<Versioned<Nothing>, _> = serde_json::from_str(text);
        match version.map(|version| (version.format, check_format(version.format))) {
            Ok((_, Err(problem))) => problem,
            Ok((found, Ok(()))) if found > FORMAT => {
                format!("cannot be read: {error}; it has format {}.{}; use the build that wrote it", found.0, found.1)
            }
            _ => format!("cannot be read: {error}"),
        }
    })
}

fn check_format((major, minor): (u32, u32)) -> Result<(), String> {
    if major == FORMAT.0 {
        return Ok(());
    }
    Err(format!("has format {major}.{minor}; this build reads {}.x; use the build that wrote it", FORMAT.0))
}

/// The counters of a state. All other data is in parts.
#[derive(Serialize, Deserialize)]
struct Numbers {
    format: (u32, u32),
    seq: u64,
    now: Millis,
    submitted: u64,
    incarnation: Incarnation,
    fence: Fence,
    draining: bool,
}

/// The state after decision [`State::seq`] as stored, without its parts.
pub fn snapshot(state: &State) -> String {
    let numbers = Numbers {
        format: FORMAT,
        seq: state.seq,
        now: state.now,
        submitted: state.submitted,
        incarnation: state.incarnation,
        fence: state.fence,
        draining: state.draining,
    };
    serde_json::to_string(&numbers).expect("numbers serialise")
}

/// A part of a state.
#[derive(Debug, Clone)]
enum Part {
    Run(Arc<Run>),
    Execution(Arc<StageExecution>),
    Worker(Box<Worker>),
}

/// A part that was changed, added or removed.
#[derive(Debug, Clone)]
pub struct ChangedPart {
    name: String,
    content: Option<Part>,
}

impl ChangedPart {
    /// The part's name and its text as stored; `None` if removed.
    pub fn stored(&self) -> (String, Option<String>) {
        let text = self.content.as_ref().map(|part| match part {
            Part::Run(run) => serde_json::to_string(&**run),
            Part::Execution(execution) => serde_json::to_string(&**execution),
            Part::Worker(worker) => serde_json::to_string(worker),
        });
        (self.name.clone(), text.map(|text| text.expect("a part of a state serialises")))
    }
}

const RUN: &str = "run/";
const EXECUTION: &str = "execution/";
const WORKER: &str = "worker/";

/// The parts that differ between `before` and `after`. Shared data is not inspected.
pub fn changed_parts(before: &State, after: &State) -> Vec<ChangedPart> {
    let mut parts = Vec::new();
    for (number, run) in changed(&before.runs, &after.runs, is_same) {
        parts.push(ChangedPart { name: format!("{RUN}{number}"), content: run.cloned().map(Part::Run) });
    }
    for (key, execution) in changed(&before.executions, &after.executions, is_same) {
        let content = execution.cloned().map(Part::Execution);
        parts.push(ChangedPart { name: format!("{EXECUTION}{key}"), content });
    }
    for (name, worker) in changed(&before.workers, &after.workers, PartialEq::eq) {
        let content = worker.cloned().map(|worker| Part::Worker(Box::new(worker)));
        parts.push(ChangedPart { name: format!("{WORKER}{name}"), content });
    }
    parts
}

fn is_same<T: PartialEq>(before: &Arc<T>, after: &Arc<T>) -> bool {
    Arc::ptr_eq(before, after) || before == after
}

/// Entries of `after` that are new or changed, and keys that only `before` has.
fn changed<'a, K: Ord, V>(
    before: &'a Map<K, V>,
    after: &'a Map<K, V>,
    is_same: impl Fn(&V, &V) -> bool,
) -> Vec<(&'a K, Option<&'a V>)> {
    let mut changed = Vec::new();
    let mut old = before.iter().peekable();
    for (key, value) in after {
        while let Some((gone, _)) = old.next_if(|(old, _)| *old < key) {
            changed.push((gone, None));
        }
        match old.next_if(|(old, _)| *old == key) {
            Some((_, known)) if is_same(known, value) => {}
            Some(_) | None => changed.push((key, Some(value))),
        }
    }
    changed.extend(old.map(|(gone, _)| (gone, None)));
    changed
}

/// Restores the state of a snapshot.
fn restore(policy: Policy, text: &str, parts: &BTreeMap<String, String>) -> Result<State, String> {
    let numbers: Numbers = read(text)?;
    check_format(numbers.format)?;
    let mut state = State {
        seq: numbers.seq,
        now: numbers.now,
        submitted: numbers.submitted,
        incarnation: numbers.incarnation,
        fence: numbers.fence,
        draining: numbers.draining,
        ..State::new(policy)
    };
    for (name, text) in parts {
        let at = |error| format!("has the part `{name}`, which cannot be read: {error}");
        if name.starts_with(RUN) {
            let run: Run = serde_json::from_str(text).map_err(at)?;
            state.runs.insert_mut(run.number, Arc::new(run));
        } else if name.starts_with(EXECUTION) {
            let execution: StageExecution = serde_json::from_str(text).map_err(at)?;
            state.executions.insert_mut(execution.key, Arc::new(execution));
        } else if let Some(worker) = name.strip_prefix(WORKER) {
            state.workers.insert_mut(WorkerId::new(worker), serde_json::from_str(text).map_err(at)?);
        } else {
            return Err(format!("has the part `{name}`, which this build does not know; use the build that wrote it"));
        }
    }
    state.index();
    Ok(state)
}

/// The states recovered from a store.
#[derive(Debug)]
pub struct Recovered {
    /// The state of the newest snapshot.
    pub snapshot: State,
    /// The state after all stored facts.
    pub state: State,
}

/// Recovers the state after all stored facts.
///
/// # Errors
/// Stored data that cannot be parsed, has a gap, or was written in another format.
pub fn recover(policy: Policy, stored: &Recovery) -> Result<State, RecoverError> {
    recover_both(policy, stored).map(|recovered| recovered.state)
}

/// Like [`recover`], and also returns the snapshot, on which later ones build.
///
/// # Errors
/// Those of [`recover`].
pub fn recover_both(policy: Policy, stored: &Recovery) -> Result<Recovered, RecoverError> {
    let snapshot = match &stored.snapshot {
        Some((seq, text)) => {
            let at = |problem| RecoverError { what: format!("the snapshot of decision {seq}"), problem };
            restore(policy, text, &stored.parts).map_err(at)?
        }
        None => State::new(policy),
    };
    let mut state = snapshot.clone();
    for (seq, text) in stored.facts.iter().filter(|(seq, _)| *seq > stored.snapshot.as_ref().map_or(0, |(seq, _)| *seq))
    {
        let at = |problem| RecoverError { what: format!("decision {seq}"), problem };
        if *seq != state.seq + 1 {
            return Err(at(format!("follows decision {}; the decisions between them are missing", state.seq)));
        }
        let decision = Decision::from_json(text).map_err(at)?;
        for fact in &decision.facts {
            state.apply(fact).map_err(|misfit| at(format!("does not fit: {misfit}")))?;
        }
        (state.seq, state.now) = (*seq, decision.now);
    }
    Ok(Recovered { snapshot, state })
}
