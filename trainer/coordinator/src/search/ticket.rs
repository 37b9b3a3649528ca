//! Tickets, and the stored changes of a searcher.

use serde::{Deserialize, Serialize};

use super::score::Score;

/// A unit of work for a sweep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ticket {
    /// Train a trial to the end of a rung, and evaluate it.
    Rung { trial: usize, rung: usize },
    /// No work can be chosen from the current results. An idle ticket keeps the number of tickets in step with the
    /// results.
    Idle,
}

/// The changes of a searcher, without the rules that caused them, as stored.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Newly issued tickets.
    pub tickets: Vec<Ticket>,
    /// New results, by ticket.
    pub scores: Vec<(usize, Score)>,
    /// Number of tickets whose results are folded.
    pub folded: usize,
}
