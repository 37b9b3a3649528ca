//! Decisions of searchers for results in any order, from any number of workers, with crashes at any point.

use std::collections::{BTreeMap, BTreeSet};

use protocol::stage::{DistillPcm, EvaluateLatentFid, Mode, StageSettings};
use protocol::sweep::{Domain, Rungs, SearchKind, Sweep, Values};
use protocol::{Seed, Steps};

use super::{Score, Search, Ticket};

fn sweep(search: SearchKind, trials: usize) -> Sweep {
    let grid = [
        ("adversarial".to_owned(), Domain::Choice(vec![0.0.into(), 0.1.into(), 0.5.into(), 1.0.into()])),
        ("skip".to_owned(), Domain::Choice(vec![20.into(), 50.into(), 100.into()])),
        ("ema".to_owned(), Domain::Choice(vec![0.9.into(), 0.95.into()])),
    ];
    let mut space = BTreeMap::from(grid);
    if search != SearchKind::Grid {
        space.insert("lr".to_owned(), Domain::LogUniform(1e-5, 1e-2));
        space.insert("ema".to_owned(), Domain::Uniform(0.9, 0.99));
    }
    Sweep {
        search,
        metric: "latent_fid".into(),
        mode: Mode::Min,
        trials,
        parallel: 4,
        rungs: Rungs { first: Steps(100), factor: 3 },
        space,
        evaluate: Box::new(StageSettings::EvaluateLatentFid(EvaluateLatentFid::default())),
    }
}

fn settings() -> StageSettings {
    let mut settings = DistillPcm::default();
    settings.distillation.training.steps = Steps(900);
    StageSettings::DistillPcm(settings)
}

fn search(sweep: &Sweep) -> Search {
    Search::new(sweep, &settings(), &"pcm".into(), Seed(7))
}

/// A random generator for the tests' own choices.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n as u64) as usize
    }
}

/// The result of a rung of a trial, the same for every worker: better with each rung, with occasional failures.
fn truth(world: u64, ticket: Ticket) -> Score {
    let Ticket::Rung { trial, rung } = ticket else { panic!("nobody executions on {ticket:?}") };
    let mut dice = Dice(1 + world * 7919 + trial as u64 * 104_729);
    for _ in 0..10 {
        dice.below(2);
    }
    let quality = dice.below(1000) as f64;
    match dice.below(12) {
        0 if rung == dice.below(3) => Score::Failed,
        1 if rung == 0 => Score::of(f64::NAN),
        _ => Score::of(quality / (rung + 1) as f64),
    }
}

fn open(search: &Search) -> Vec<usize> {
    (0..search.tickets().len()).filter(|ticket| search.score(*ticket).is_none()).collect()
}

/// Completes a sweep with `workers` that finish in random order. With `crashes`, some results are followed by a crash,
/// after which all results are folded again.
fn work_off(sweep: &Sweep, world: u64, workers: usize, dice: &mut Dice, crashes: bool) -> Search {
    let mut at = search(sweep);
    for _ in 0..10_000 {
        if at.is_over() {
            return at;
        }
        let open = open(&at);
        let busy = &open[..open.len().min(workers)];
        let ticket = busy[dice.below(busy.len())];
        let issued = at.report(ticket, truth(world, at.tickets()[ticket]));
        assert!(issued.end == at.tickets().len() && at.tickets().len() - at.folded <= sweep.parallel);
        if crashes && dice.below(3) == 0 {
            let mut again = search(sweep);
            let mut left: Vec<(usize, Score)> =
                (0..at.tickets().len()).filter_map(|ticket| Some((ticket, at.score(ticket)?))).collect();
            while !left.is_empty() {
                let known: Vec<usize> = (0..left.len()).filter(|i| left[*i].0 < again.tickets().len()).collect();
                let (ticket, score) = left.swap_remove(known[dice.below(known.len())]);
                again.report(ticket, score);
            }
            assert_eq!(again, at, "folding the same results again gives the same searcher");
        }
    }
    panic!("the sweep does not end: {at:?}");
}

#[test]
fn decisions_hang_on_nothing_but_the_results() {
    for kind in [SearchKind::Grid, SearchKind::Random, SearchKind::Asha] {
        for world in 0..40 {
            let sweep = Sweep { parallel: 1 + world as usize % 7, ..sweep(kind, 24) };
            let reference = work_off(&sweep, world, 1, &mut Dice(1), false);
            for round in 0..8 {
                let mut dice = Dice(100 + world * 31 + round);
                let other = work_off(&sweep, world, 1 + round as usize % 5, &mut dice, round % 2 == 0);
                assert_eq!(other, reference, "{kind:?}, world {world}, round {round}");
            }
        }
    }
}

#[test]
fn asha_gets_somebody_to_the_end_for_at_most_half_of_the_full_grid() {
    for trials in [1, 2, 3, 5, 8, 9, 24, 50, 81] {
        for world in 0..30 {
            let done = work_off(&sweep(SearchKind::Asha, trials), world, 3, &mut Dice(world + 1), false);
            let begun = |rung| {
                done.tickets().iter().filter(|t| matches!(t, Ticket::Rung { rung: r, .. } if *r == rung)).count()
            };
            let spent: u64 = (0..3).map(|rung| begun(rung) as u64 * done.steps(rung)).sum();
            assert_eq!(begun(0), trials);
            if trials >= 8 {
                assert!(spent * 2 <= done.full(), "{trials} trials took {spent} of {} steps", done.full());
            }
            let sound = |trial| (0..3).all(|rung| truth(world, Ticket::Rung { trial, rung }) != Score::Failed);
            assert!(done.best().is_some() || !(0..trials).any(sound), "{trials} trials, world {world}");
            for (trial, scores) in done.known.iter().enumerate() {
                assert_eq!(scores.len(), done.issued[trial], "every rung that was issued has a result");
                let failed = scores.iter().position(|score| *score == Score::Failed);
                assert!(failed.is_none_or(|at| at + 1 == scores.len()), "a failed trial is stopped: {scores:?}");
            }
        }
    }
}

#[test]
fn without_failures_asha_costs_what_was_planned_and_keeps_the_good_ones() {
    for order in 0..20 {
        let sweep = sweep(SearchKind::Asha, 24);
        let mut at = search(&sweep);
        let mut dice = Dice(order + 1);
        while !at.is_over() {
            let open = open(&at);
            let ticket = open[dice.below(open.len())];
            let Ticket::Rung { trial, .. } = at.tickets()[ticket] else { unreachable!() };
            // The worst case for asynchronous halving: every trial is better than all before it.
            at.report(ticket, Score::of(100.0 - trial as f64));
        }
        let spent: u64 =
            at.tickets().iter().map(|t| if let Ticket::Rung { rung, .. } = t { at.steps(*rung) } else { 0 }).sum();
        assert_eq!((spent, at.planned(), at.full()), (24 * 100 + 8 * 200 + 2 * 600, 5200, 21_600));
        let (best, _) = at.best().unwrap();
        assert!(best >= 20, "trial {best} of 24 is the best that was found");
    }
}

#[test]
fn grid_and_random_try_every_point_once_for_the_whole_budget() {
    for (kind, count) in [(SearchKind::Grid, 24), (SearchKind::Random, 40)] {
        let done = work_off(&sweep(kind, 40), 3, 2, &mut Dice(5), false);
        let rungs: Vec<_> = done.tickets().iter().filter(|ticket| **ticket != Ticket::Idle).collect();
        assert_eq!((rungs.len(), done.rungs(), done.stop(0)), (count, &[900][..], None));
        assert!(rungs.iter().all(|ticket| matches!(ticket, Ticket::Rung { rung: 0, .. })));
        let best = done.best().unwrap().0;
        let value = |trial: usize| done.known[trial][0].loss(Mode::Min);
        assert!((0..count).all(|trial| value(best) <= value(trial)));
    }
}

#[test]
fn equal_points_are_not_tried_twice() {
    let text = |point: &Values| serde_json::to_string(point).unwrap();
    for kind in [SearchKind::Grid, SearchKind::Random, SearchKind::Asha] {
        let searched = search(&sweep(kind, 24));
        let different: BTreeSet<String> = searched.trials().iter().map(text).collect();
        assert_eq!((different.len(), searched.trials().len()), (24, 24));
        for point in searched.trials() {
            pipeline::with_values(&settings(), point).unwrap();
        }
    }
    // A space with 24 points gives at most 24 trials, however many are requested.
    let small = Sweep { search: SearchKind::Asha, trials: 1000, ..sweep(SearchKind::Grid, 0) };
    let points: BTreeSet<String> = search(&small).trials().iter().map(text).collect();
    assert_eq!(points.len(), 24);
    let narrow = Sweep {
        space: [("guidance_dim".to_owned(), Domain::Uniform(4.0, 6.0))].into(),
        ..sweep(SearchKind::Random, 9)
    };
    let found: BTreeSet<u64> = search(&narrow).trials().iter().filter_map(|p| p["guidance_dim"].as_u64()).collect();
    assert_eq!(found, [4, 5, 6].into());
}

#[test]
fn drawn_values_are_in_range_and_hang_on_seed_stage_and_trial() {
    let sweep = sweep(SearchKind::Random, 200);
    let of = |seed, name: &str| Search::new(&sweep, &settings(), &name.into(), Seed(seed)).trials().to_vec();
    let points = of(7, "pcm");
    let lr: Vec<f64> = points.iter().filter_map(|point| point["lr"].as_f64()).collect();
    assert!(lr.len() == 200 && lr.iter().all(|lr| (1e-5..=1e-2).contains(lr)));
    let low = lr.iter().filter(|lr| **lr < 10f64.powf(-3.5)).count();
    assert!((70..130).contains(&low), "half of the draws lie below the middle of the exponents: {low}");
    assert_eq!(points, of(7, "pcm"));
    assert_ne!(points, of(8, "pcm"));
    assert_ne!(points, of(7, "lcm"));
    let fewer = Sweep { trials: 20, ..sweep.clone() };
    assert_eq!(Search::new(&fewer, &settings(), &"pcm".into(), Seed(7)).trials(), &points[..20]);
}

#[test]
fn a_larger_value_is_better_when_the_sweep_says_so() {
    let sweep = Sweep { mode: Mode::Max, ..sweep(SearchKind::Grid, 0) };
    let mut at = search(&sweep);
    while let Some(ticket) = open(&at).first().copied() {
        let Ticket::Rung { trial, .. } = at.tickets()[ticket] else { unreachable!() };
        at.report(ticket, if trial == 23 { Score::Failed } else { Score::of(trial as f64) });
    }
    assert_eq!(at.best(), Some((22, 22.0)));
}
