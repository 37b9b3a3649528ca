//! Swept stages. Tickets of a searcher become stages of the run, and their results return to the searcher.
//!
//! A rung of a trial is two ordinary stages, appended to the pipeline: a training, and an evaluation of its output.
//! They have keys like every stage, so that values computed earlier by this run or another are found. When the searcher
//! is complete, the swept stage takes the value of its best trial, and its readers can start.
//!
//! | result of a trial's stage | consequence |
//! |---|---|
//! | a finite metric | a result |
//! | a non-finite metric, or its own failure (diverged, settings, memory, faults) | the worst result: the trial is stopped |
//! | a failure of machines or the store | the run ends until it is resumed |
//! | an evaluation without the metric | the run ends: no other trial would have the metric |

use std::collections::BTreeMap;
use std::sync::Arc;

use protocol::message::{RunState, StageState, SweepView, TrialState, TrialView};
use protocol::{Digest, Steps};

use crate::decide::deciding::Deciding;
use crate::search::{Score, Search, Ticket};
use crate::state::State;
use crate::state::execution::ExecutionState;
use crate::state::run::{Run, Status, Sweeping, value};
use crate::value::Known;

/// The outcome of a ticket.
enum Found {
    Score(Score, Option<String>),
    /// The sweep cannot continue.
    End {
        key: Digest,
        message: String,
    },
}

impl Deciding<'_> {
    /// Starts or resumes a sweep.
    pub(crate) fn begin_sweep(&mut self, number: u64, j: usize) -> Status {
        if self.state.runs[&number].sweep(j).is_none() {
            self.change_run(number, |run| {
                let stage = &run.pipeline.stages[j];
                let sweep = stage.sweep.as_ref().expect("the stage has a sweep");
                let search = Search::new(sweep, &stage.settings, &stage.name, run.pipeline.seed);
                let sweep = Sweeping { stage: j, search, places: Vec::new(), failures: BTreeMap::new() };
                run.sweeps.push(Arc::new(sweep));
                unfold(run, run.sweeps.len() - 1);
            });
        }
        Status::Sweeping
    }

    /// Passes results to the searchers of a run, creates the stages that they request, and concludes complete sweeps.
    pub(crate) fn sweep(&mut self, number: u64) {
        for k in 0..self.state.runs[&number].sweeps.len() {
            let run = &self.state.runs[&number];
            let sweep = &run.sweeps[k];
            let under_way = matches!(run.state, RunState::Running | RunState::Paused);
            if !under_way || run.stages[sweep.stage] != Status::Sweeping {
                continue;
            }
            let open = sweep.places.iter().enumerate().filter(|(ticket, _)| sweep.search.score(*ticket).is_none());
            let found: Vec<(usize, usize, Found)> = open
                .filter_map(|(ticket, place)| Some((ticket, (*place)?, found(self.state, run, sweep, (*place)?)?)))
                .collect();
            if found.is_empty() && !sweep.search.is_over() {
                continue;
            }
            self.change_run(number, |run| take_note(run, k, found));
        }
    }
}

/// Passes outcomes to the searcher and creates the stages that it requests next.
fn take_note(run: &mut Run, k: usize, found: Vec<(usize, usize, Found)>) {
    for (ticket, place, found) in found {
        match found {
            Found::Score(score, why) => {
                let sweep = Arc::make_mut(&mut run.sweeps[k]);
                if let (Some(why), Ticket::Rung { trial, .. }) = (why, sweep.search.tickets()[ticket]) {
                    sweep.failures.insert(trial, why);
                }
                sweep.search.report(ticket, score);
                if run.stages[place + 1] == Status::Waiting {
                    let reason = "there is nothing to evaluate".to_owned();
                    run.set(place + 1, Status::Skipped { key: None, reason });
                }
            }
            Found::End { key, message } => run.set(run.sweeps[k].stage, Status::Failed { key, message }),
        }
    }
    unfold(run, k);
    let stage = run.sweeps[k].stage;
    if run.stages[stage] == Status::Sweeping && run.sweeps[k].search.is_over() {
        run.set(stage, concluded(run, &run.sweeps[k]));
    }
}

/// Creates the stages of tickets that have none yet.
fn unfold(run: &mut Run, k: usize) {
    let first = run.pipeline.stages.len();
    let mut new = Vec::new();
    let sweep = Arc::make_mut(&mut run.sweeps[k]);
    while let Some(ticket) = sweep.search.tickets().get(sweep.places.len()).copied() {
        let Ticket::Rung { trial, rung } = ticket else {
            sweep.places.push(None);
            continue;
        };
        let stop = sweep.search.stop(rung).map(Steps);
        match run.pipeline.stages[sweep.stage].rung(trial, rung, stop, &sweep.search.trials()[trial]) {
            Ok(made) => {
                sweep.places.push(Some(first + new.len()));
                new.extend(made);
            }
            Err(message) => {
                sweep.failures.insert(trial, message);
                sweep.places.push(None);
                sweep.search.report(sweep.places.len() - 1, Score::Failed);
            }
        }
    }
    if !new.is_empty() {
        run.add_stages(new);
    }
}

/// The outcome of the ticket with stages at `place`; `None` while they are in progress.
fn found(state: &State, run: &Run, sweep: &Sweeping, place: usize) -> Option<Found> {
    let train = &run.stages[place];
    let eval = &run.stages[place + 1];
    let stage = &run.pipeline.stages[sweep.stage];
    if let Some((key, message)) = [train, eval].into_iter().find_map(|status| match status {
        Status::Failed { key, message } => Some((*key, message.clone())),
        _ => None,
    }) {
        let others = matches!(
            state.executions.get(&key).map(|execution| &execution.state),
            Some(ExecutionState::Failed { own: false, .. })
        );
        return Some(if others {
            Found::End { key, message: format!("a trial was interrupted, but not because of its settings: {message}") }
        } else {
            Found::Score(Score::Failed, Some(message))
        });
    }
    let Status::Done { key, known, .. } = eval else { return None };
    let metric = stage.sweep.as_ref().map_or("", |sweep| &sweep.metric);
    let Some(value) = known.metrics.get(metric) else {
        let names: Vec<&str> = known.metrics.keys().map(String::as_str).collect();
        let message = format!(
            "`metric` of the sweep is `{metric}`, which its evaluation does not report; it reports {}",
            if names.is_empty() { "nothing".to_owned() } else { names.join(", ") }
        );
        return Some(Found::End { key: *key, message });
    };
    let score = Score::of(*value);
    Some(Found::Score(score, (score == Score::Failed).then(|| format!("`{metric}` is {value}"))))
}

/// The final status of the swept stage, with the value of its best trial.
fn concluded(run: &Run, sweep: &Sweeping) -> Status {
    let made = || sweep.places.iter().flatten().flat_map(|place| [&run.stages[*place], &run.stages[place + 1]]);
    let last = sweep.search.rungs().len() - 1;
    let best = sweep.search.best().and_then(|(trial, _)| {
        let ticket = sweep.search.tickets().iter().position(|ticket| *ticket == Ticket::Rung { trial, rung: last })?;
        Some((trial, sweep.places[ticket]?))
    });
    let Some((trial, place)) = best else {
        let first = sweep.failures.iter().next();
        let why = first.map(|(trial, why)| format!("; trial {trial}: {why}")).unwrap_or_default();
        let key = made().find_map(Status::key).unwrap_or_else(|| Digest::of(b"no trial started"));
        let message = format!("no trial of the {} trials of the sweep was completed{why}", sweep.search.trials().len());
        return Status::Failed { key, message };
    };
    let (Status::Done { key, known, attempt, .. }, Status::Done { known: evaluated, .. }) =
        (&run.stages[place], &run.stages[place + 1])
    else {
        unreachable!("a trial with a result is done");
    };
    let name = run.pipeline.stages[place].settings.output().name;
    let outputs = value(known).map(|output| (name.to_owned(), *output)).into_iter().collect();
    let mut metrics = known.metrics.clone();
    metrics.extend(evaluated.metrics.clone());
    metrics.insert("sweep.trial".into(), trial as f64);
    let numbers = sweep.search.trials()[trial].iter().filter_map(|(path, value)| Some((path, value.as_f64()?)));
    metrics.extend(numbers.map(|(path, value)| (format!("sweep.{path}"), value)));
    let mut how = StageState::Cached;
    let mut seconds = 0.0;
    let mut peak_memory = None;
    for status in made() {
        if let Status::Done { how: this, wall_s, peak_memory: peak, .. } = status {
            seconds += wall_s;
            peak_memory = peak_memory.max(*peak);
            how = match (how, this) {
                (StageState::Resumed, _) | (_, StageState::Resumed) => StageState::Resumed,
                (StageState::Cached, this) => *this,
                (how, _) => how,
            };
        }
    }
    let known = Arc::new(Known { outputs, metrics });
    Status::Done { key: *key, how, known, wall_s: seconds, attempt: *attempt, peak_memory }
}

impl State {
    /// A sweep as clients see it.
    pub(crate) fn sweep_view(&self, run: &Run, sweep: &Sweeping) -> SweepView {
        let stage = &run.pipeline.stages[sweep.stage];
        let settings = stage.sweep.as_ref().expect("the stage has a sweep");
        let search = &sweep.search;
        let over = search.is_over();
        let mut trials = Vec::new();
        for (trial, values) in search.trials().iter().enumerate() {
            let message = sweep.failures.get(&trial).cloned();
            let state = TrialState::Waiting;
            trials.push(TrialView { trial, values: values.clone(), state, steps: 0, results: Vec::new(), message });
        }
        for (n, ticket) in search.tickets().iter().enumerate() {
            let Ticket::Rung { trial, rung } = *ticket else { continue };
            let view = &mut trials[trial];
            let place = sweep.places.get(n).copied().flatten();
            let trained = place.is_some_and(|place| run.stages[place].known().is_some());
            view.steps += match place.filter(|_| !trained).and_then(|place| run.stages[place].key()) {
                _ if trained => search.steps(rung),
                Some(key) => {
                    let done = self.executions.get(&key).map_or(0, |execution| self.progress(execution).done);
                    done.saturating_sub(search.rungs()[rung] - search.steps(rung)).min(search.steps(rung))
                }
                None => 0,
            };
            view.state = match search.score(n) {
                None => TrialState::Running,
                Some(Score::Failed) => TrialState::Failed,
                Some(Score::Value(_)) if rung + 1 == search.rungs().len() => TrialState::Finished,
                Some(Score::Value(_)) if over => TrialState::Stopped,
                Some(Score::Value(_)) => TrialState::Paused,
            };
            match search.score(n) {
                Some(Score::Value(value)) => view.results.push(Some(value)),
                Some(Score::Failed) => view.results.push(None),
                None => {}
            }
        }
        SweepView {
            stage: stage.name.clone(),
            search: settings.search,
            metric: settings.metric.clone(),
            mode: settings.mode,
            rungs: search.rungs().to_vec(),
            over,
            spent: trials.iter().map(|trial| trial.steps).sum(),
            planned: search.planned(),
            full: search.full(),
            best: search.best().map(|(trial, _)| trial),
            trials,
        }
    }
}

/// Summarises a sweep, such as `14 of 24 trials begun, 5 at rung 1, 1 failed`.
pub(crate) fn in_words(sweep: &SweepView) -> String {
    let begun = sweep.trials.iter().filter(|trial| trial.state != TrialState::Waiting).count();
    let mut words = format!("{begun} of {} trials started", sweep.trials.len());
    for rung in 1..sweep.rungs.len() {
        let at = |trial: &&TrialView| trial.steps > sweep.rungs[rung - 1];
        let count = sweep.trials.iter().filter(at).count();
        if count > 0 {
            words += &format!(", {count} past step {}", sweep.rungs[rung - 1]);
        }
    }
    let failed = sweep.trials.iter().filter(|trial| trial.state == TrialState::Failed).count();
    if failed > 0 {
        words += &format!(", {failed} failed");
    }
    words
}
