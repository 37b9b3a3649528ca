//! Successive halving that does not wait for a rung to be full. After Li et al., "A System for Massively Parallel
//! Hyperparameter Tuning" (arXiv:1810.05934), for a fixed number of trials.
//!
//! A trial advances as soon as it is among the best `1/factor` of the results at its rung. Departs from the paper in
//! two ways, both because the number of trials is fixed. Lower rungs come first, so that a promotion uses all results
//! that can be available. A rung never has more trials than in synchronous halving, so the cost is known in advance.

use super::score::{Score, Standing};

/// Number of trials that reach `rung`.
pub(super) fn quota(standing: Standing<'_>, rung: usize) -> usize {
    let trials = standing.known.len();
    let divided = (0..rung).fold(trials, |count, _| count / standing.factor);
    divided.max(1).min(trials)
}

/// The trial to advance now, and its next rung.
pub(super) fn promoted(standing: Standing<'_>) -> Option<(usize, usize)> {
    (1..standing.rungs).find_map(|rung| {
        if begun(standing, rung) >= quota(standing, rung) {
            return None;
        }
        let ranking = standing.ranking(rung - 1);
        let good = ranking.len() / standing.factor;
        ranking.into_iter().take(good).find(|trial| may_go_on(standing, *trial, rung)).map(|trial| (trial, rung))
    })
}

/// The trial to advance when nothing is in progress, no trial qualifies by rank, and none has reached the last rung.
/// This happens if there are too few trials for a promotion by rank, or if a promoted trial failed.
pub(super) fn finalist(standing: Standing<'_>) -> Option<(usize, usize)> {
    let last = standing.rungs - 1;
    if standing.known.iter().any(|scores| matches!(scores.get(last), Some(Score::Value(_)))) {
        return None;
    }
    (1..=last).rev().find_map(|rung| {
        let ranking = standing.ranking(rung - 1);
        ranking.into_iter().find(|trial| may_go_on(standing, *trial, rung)).map(|trial| (trial, rung))
    })
}

fn begun(standing: Standing<'_>, rung: usize) -> usize {
    standing.issued.iter().filter(|rungs| **rungs > rung).count()
}

/// Returns true if a trial has a finite result at the previous rung and has not advanced yet.
fn may_go_on(standing: Standing<'_>, trial: usize, rung: usize) -> bool {
    standing.issued[trial] == rung && matches!(standing.known[trial].get(rung - 1), Some(Score::Value(_)))
}
