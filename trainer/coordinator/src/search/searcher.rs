//! The fold over results that issues the next tickets.

use std::ops::Range;
use std::sync::Arc;

use protocol::stage::{Mode, StageSettings};
use protocol::sweep::{SearchKind, Sweep, Values};
use protocol::{Seed, StageName};
use serde::{Deserialize, Serialize};

use super::score::{Score, Standing};
use super::ticket::{Progress, Ticket};
use super::{asha, grid, random};

/// A searcher with its results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Search {
    kind: SearchKind,
    mode: Mode,
    factor: usize,
    parallel: usize,
    rungs: Vec<u64>,
    /// Constant; shared, because a decision copies the state.
    #[serde(with = "crate::state::shared")]
    trials: Arc<Vec<Values>>,
    tickets: Vec<Ticket>,
    /// Results by ticket, filled in any order.
    scores: Vec<Option<Score>>,
    /// Number of tickets whose results are folded.
    pub(super) folded: usize,
    /// Folded results by trial and rung.
    pub(super) known: Vec<Vec<Score>>,
    /// Number of issued rungs, by trial.
    pub(super) issued: Vec<usize>,
}

impl Search {
    /// Creates the searcher of `sweep` for stage `name` with `settings`, with its first tickets.
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

    /// Adds the result of a ticket and returns the newly issued tickets. A second result of a ticket is ignored.
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
        // Every point gets its first rung before the best ones get more.
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
        let mode = self.mode;
        let factor = self.factor;
        let rungs = self.rungs.len();
        Standing { mode, factor, rungs, known: &self.known, issued: &self.issued }
    }

    /// Returns true if no work is in progress and none will be issued.
    pub fn is_over(&self) -> bool {
        self.tickets[self.folded..].iter().all(|ticket| *ticket == Ticket::Idle) && self.next() == Ticket::Idle
    }

    /// The changes since `before`.
    pub fn since(&self, before: &Self) -> Progress {
        let tickets = self.tickets[before.tickets.len()..].to_vec();
        let mut scores = Vec::new();
        for (ticket, score) in self.scores.iter().enumerate() {
            if let Some(score) = score
                && self.tickets[ticket] != Ticket::Idle
                && before.score(ticket).is_none()
            {
                scores.push((ticket, *score));
            }
        }
        Progress { tickets, scores, folded: self.folded }
    }

    /// Applies stored changes without evaluating any rule.
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

    /// The result of a ticket, if available; it may not be folded yet.
    pub fn score(&self, ticket: usize) -> Option<Score> {
        self.scores.get(ticket).copied().flatten()
    }

    /// The values of every trial, started or not.
    pub fn trials(&self) -> &[Values] {
        &self.trials
    }

    /// Steps at which trials are compared; the last is the whole budget.
    pub fn rungs(&self) -> &[u64] {
        &self.rungs
    }

    /// The step at which a rung stops; `None` is the end of the schedule.
    pub fn stop(&self, rung: usize) -> Option<u64> {
        (rung + 1 < self.rungs.len()).then(|| self.rungs[rung])
    }

    /// Steps that a rung adds to the previous one.
    pub fn steps(&self, rung: usize) -> u64 {
        self.rungs[rung] - rung.checked_sub(1).map_or(0, |before| self.rungs[before])
    }

    /// The best trial at the whole budget so far, with its metric.
    pub fn best(&self) -> Option<(usize, f64)> {
        let last = self.rungs.len() - 1;
        self.standing().ranking(last).into_iter().next().and_then(|trial| match self.known[trial][last] {
            Score::Value(value) => Some((trial, value)),
            Score::Failed => None,
        })
    }

    /// Number of steps for the whole sweep if no trial fails.
    pub fn planned(&self) -> u64 {
        let standing = self.standing();
        (0..self.rungs.len()).map(|rung| asha::quota(standing, rung) as u64 * self.steps(rung)).sum()
    }

    /// Number of steps for all trials at the whole budget.
    pub fn full(&self) -> u64 {
        self.trials.len() as u64 * self.rungs.last().copied().unwrap_or_default()
    }
}
