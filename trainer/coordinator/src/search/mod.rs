//! Who is tried next: a sweep's searcher as a pure fold over its results.
//!
//! Work is handed out as numbered tickets, one rung of one trial each. Results come in any order, but they are folded in the order of the
//! tickets, and ticket `n` is issued as a function of the results of tickets `0..=n - parallel` alone. So neither the number of workers nor
//! who is fast, who is killed and who starts again can change a trial, a rung or the best: the decisions are a function of the sweep and the
//! seed. The price is that a slow ticket holds up those `parallel` behind it.
//!
//! | question | answered by |
//! |---|---|
//! | which points are tried, and in which order | `grid`, `random`: fixed before anything runs, all different |
//! | who goes on to the next rung | `asha` |
//! | who is best | the best result of the last rung; of equals the trial with the lower number |
//!
//! A trial that failed or whose metric is no finite number has a result like any other: the worst.

mod asha;
mod grid;
mod random;
mod score;

use std::ops::Range;
use std::sync::Arc;

use protocol::stage::{Mode, StageSettings};
use protocol::sweep::{SearchKind, Sweep, Values};
use protocol::{Seed, StageName};
use serde::{Deserialize, Serialize};

pub use self::score::Score;
use self::score::Standing;

/// A thing to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ticket {
    /// Train a trial up to the end of a rung, and measure it.
    Rung {
        /// Which trial.
        trial: usize,
        /// Which rung.
        rung: usize,
    },
    /// Nothing: with what is known now there is nothing to do. It keeps the count of tickets in step with the results.
    Idle,
}

/// What became of a searcher, without the rules by which: as they are kept.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Tickets that were issued.
    pub tickets: Vec<Ticket>,
    /// Results that came, by ticket.
    pub scores: Vec<(usize, Score)>,
    /// Tickets whose results count now.
    pub folded: usize,
}

/// A searcher and all that it knows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Search {
    kind: SearchKind,
    mode: Mode,
    factor: usize,
    parallel: usize,
    rungs: Vec<u64>,
    /// Never changes; shared, because a decision copies the state.
    #[serde(with = "crate::state::shared")]
    trials: Arc<Vec<Values>>,
    tickets: Vec<Ticket>,
    /// By ticket; filled in any order.
    scores: Vec<Option<Score>>,
    /// Tickets whose results count already.
    folded: usize,
    /// Results that count, by trial and rung.
    known: Vec<Vec<Score>>,
    /// Rungs issued, by trial.
    issued: Vec<usize>,
}

impl Search {
    /// The searcher of `sweep` on stage `name` with `settings`, before it has issued anything.
    pub fn new(sweep: &Sweep, settings: &StageSettings, name: &StageName, seed: Seed) -> Self {
        let trials = match sweep.search {
            SearchKind::Grid => grid::points(sweep),
            SearchKind::Random | SearchKind::Asha => random::points(sweep, settings, name, seed),
        };
        let budget = settings.steps().map_or(1, |steps| steps.0);
        let count = trials.len();
        let mut search = Self {
            kind: sweep.search,
            mode: sweep.mode,
            factor: usize::try_from(sweep.rungs.factor.max(2)).unwrap_or(usize::MAX),
            parallel: sweep.parallel.max(1),
            rungs: sweep.rungs(budget),
            trials: Arc::new(trials),
            tickets: Vec::new(),
            scores: Vec::new(),
            folded: 0,
            known: vec![Vec::new(); count],
            issued: vec![0; count],
        };
        for _ in 0..search.parallel {
            search.issue();
        }
        search
    }

    /// Takes note of the result of a ticket and issues what follows from it; a second result of a ticket is ignored.
    pub fn report(&mut self, ticket: usize, score: Score) -> Range<usize> {
        let before = self.tickets.len();
        if let Some(place @ None) = self.scores.get_mut(ticket) {
            *place = Some(score);
        }
        self.fold();
        before..self.tickets.len()
    }

    fn fold(&mut self) {
        while !self.is_over()
            && let Some(Some(score)) = self.scores.get(self.folded).copied()
        {
            if let Ticket::Rung { trial, .. } = self.tickets[self.folded] {
                self.known[trial].push(score);
            }
            self.folded += 1;
            self.issue();
        }
    }

    fn issue(&mut self) {
        let ticket = self.next();
        if let Ticket::Rung { trial, .. } = ticket {
            self.issued[trial] += 1;
        }
        self.tickets.push(ticket);
        self.scores.push((ticket == Ticket::Idle).then_some(Score::Failed));
    }

    fn next(&self) -> Ticket {
        // Every point is looked at before budget goes into the best of some.
        if let Some(trial) = self.issued.iter().position(|rungs| *rungs == 0) {
            return Ticket::Rung { trial, rung: 0 };
        }
        let open = self.tickets[self.folded..].iter().any(|ticket| *ticket != Ticket::Idle);
        let standing = self.standing();
        let promoted = match self.kind {
            SearchKind::Asha => asha::promoted(standing).or_else(|| if open { None } else { asha::finalist(standing) }),
            SearchKind::Grid | SearchKind::Random => None,
        };
        match promoted {
            Some((trial, rung)) => Ticket::Rung { trial, rung },
            None => Ticket::Idle,
        }
    }

    fn standing(&self) -> Standing<'_> {
        let (mode, factor, rungs) = (self.mode, self.factor, self.rungs.len());
        Standing { mode, factor, rungs, known: &self.known, issued: &self.issued }
    }

    /// Whether nothing is under way and nothing will be.
    pub fn is_over(&self) -> bool {
        self.tickets[self.folded..].iter().all(|ticket| *ticket == Ticket::Idle) && self.next() == Ticket::Idle
    }

    /// What has become of it since `before`.
    pub fn since(&self, before: &Self) -> Progress {
        let tickets = self.tickets[before.tickets.len()..].to_vec();
        let new = |(ticket, score): (usize, &Option<Score>)| {
            let score = (*score)?;
            let is_new = self.tickets[ticket] != Ticket::Idle && before.score(ticket).is_none();
            is_new.then_some((ticket, score))
        };
        let scores = self.scores.iter().enumerate().filter_map(new).collect();
        Progress { tickets, scores, folded: self.folded }
    }

    /// Takes note of what has become of it; asks no rule.
    pub fn follow(&mut self, progress: &Progress) {
        for ticket in &progress.tickets {
            if let Ticket::Rung { trial, .. } = ticket
                && let Some(issued) = self.issued.get_mut(*trial)
            {
                *issued += 1;
            }
            self.tickets.push(*ticket);
            self.scores.push((*ticket == Ticket::Idle).then_some(Score::Failed));
        }
        for (ticket, score) in &progress.scores {
            if let Some(place) = self.scores.get_mut(*ticket) {
                *place = Some(*score);
            }
        }
        while self.folded < progress.folded.min(self.tickets.len()) {
            if let (Ticket::Rung { trial, .. }, Some(score)) = (self.tickets[self.folded], self.scores[self.folded])
                && let Some(known) = self.known.get_mut(trial)
            {
                known.push(score);
            }
            self.folded += 1;
        }
    }

    /// All tickets so far.
    pub fn tickets(&self) -> &[Ticket] {
        &self.tickets
    }

    /// The result of a ticket, if it is there; it may not count yet.
    pub fn score(&self, ticket: usize) -> Option<Score> {
        self.scores.get(ticket).copied().flatten()
    }

    /// The values of every trial, whether it has begun or not.
    pub fn trials(&self) -> &[Values] {
        &self.trials
    }

    /// Steps at which trials are compared; the last is the whole budget.
    pub fn rungs(&self) -> &[u64] {
        &self.rungs
    }

    /// Where a rung stops; `None` is the end of the schedule.
    pub fn stop(&self, rung: usize) -> Option<u64> {
        (rung + 1 < self.rungs.len()).then(|| self.rungs[rung])
    }

    /// Steps that a rung adds to those of the rung before.
    pub fn steps(&self, rung: usize) -> u64 {
        self.rungs[rung] - rung.checked_sub(1).map_or(0, |before| self.rungs[before])
    }

    /// The best trial at the whole budget so far, and its metric.
    pub fn best(&self) -> Option<(usize, f64)> {
        let last = self.rungs.len() - 1;
        self.standing().ranking(last).into_iter().next().and_then(|trial| match self.known[trial][last] {
            Score::Value(value) => Some((trial, value)),
            Score::Failed => None,
        })
    }

    /// Steps that the sweep will take if no trial fails.
    pub fn planned(&self) -> u64 {
        let standing = self.standing();
        (0..self.rungs.len()).map(|rung| asha::quota(standing, rung) as u64 * self.steps(rung)).sum()
    }

    /// Steps of every trial at the whole budget.
    pub fn full(&self) -> u64 {
        self.trials.len() as u64 * self.rungs.last().copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests;
