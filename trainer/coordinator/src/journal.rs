//! Durable events. The journal is the coordinator's memory: recovery replays it through `decide`.
//!
//! An entry is one JSON object: the [`Moment`] (`now`, `entropy`) and the [`Event`] (`event` and its fields).
//! A new event or field may be added; what is written stays readable, because `decide` must do again what it did.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::decide::decide;
use crate::event::{Event, Moment};
use crate::policy::Policy;
use crate::state::State;

/// A journal that cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[error("journal entry {number} {problem}; was the store written by a newer version?")]
pub struct ReplayError {
    /// Which entry, from 1.
    pub number: usize,
    /// What is wrong with it.
    pub problem: String,
}

#[derive(Debug, Serialize, Deserialize)]
struct Entry {
    #[serde(flatten)]
    moment: Moment,
    #[serde(flatten)]
    event: Event,
}

/// The entry of an event.
pub fn entry(moment: &Moment, event: &Event) -> Value {
    let entry = Entry { moment: *moment, event: event.clone() };
    serde_json::to_value(entry).expect("events serialise")
}

/// The state after all entries.
pub fn replay(policy: Policy, entries: impl IntoIterator<Item = Value>) -> Result<State, ReplayError> {
    let mut state = State::new(policy);
    for (i, value) in entries.into_iter().enumerate() {
        let at = |problem: String| ReplayError { number: i + 1, problem };
        let entry: Entry = serde_json::from_value(value).map_err(|e| at(format!("cannot be read: {e}")))?;
        decide(&mut state, entry.moment, entry.event).map_err(|e| at(format!("is refused: {e}")))?;
    }
    Ok(state)
}
