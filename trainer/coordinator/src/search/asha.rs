//! Successive halving without waiting for a rung to be full. After Li et al., "A System for Massively Parallel Hyperparameter Tuning"
//! (arXiv:1810.05934), for a number of trials that is known beforehand.
//!
//! A trial goes on as soon as it is among the best `1/factor` of those that have a result at its rung. Two things differ from the paper,
//! both because the number of trials is fixed: lower rungs come first, so that a promotion rests on as many results as there can be, and a
//! rung never takes more trials than it would if one had waited, so that the cost is known before anything runs.

use super::score::{Score, Standing};

/// How many trials get to `rung`.
pub(super) fn quota(standing: Standing<'_>, rung: usize) -> usize {
    let trials = standing.known.len();
    let divided = (0..rung).fold(trials, |count, _| count / standing.factor);
    divided.max(1).min(trials)
}

/// The trial that goes on now, and to which rung.
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

/// Who goes on when nothing is under way, nobody may go on by rank, and no trial has got to the end: so few trials that a third of them is
/// none, or a promoted one that failed.
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

/// Its result at the rung before counts and is a number, and it has not gone on yet.
fn may_go_on(standing: Standing<'_>, trial: usize, rung: usize) -> bool {
    standing.issued[trial] == rung && matches!(standing.known[trial].get(rung - 1), Some(Score::Value(_)))
}
