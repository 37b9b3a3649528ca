//! The bars and lines of a run's stages.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use pipeline::Pipeline;
use protocol::message::{RunView, StageState, StageView};
use protocol::stage::LossChange;
use protocol::{StageName, printable};

use super::curve::Curve;
use super::line::{change, loss_changes, working};
use crate::report::print;

const BETWEEN_LINES: Duration = Duration::from_secs(60);
/// Time without a worker after which a stage reports it; before that, workers are starting or about to be free.
const PATIENCE: Duration = Duration::from_secs(15);
/// The same while other stages of the run are computed, which then free their workers.
const PATIENCE_IN_A_QUEUE: Duration = Duration::from_secs(600);

/// Last displayed state of a stage.
#[derive(Debug)]
struct Shown {
    state: StageState,
    message: Option<String>,
    bar: Option<ProgressBar>,
    line_at: Instant,
    done: u64,
    /// Start of its wait for a worker, and whether it was reported.
    lacks: Option<(Instant, bool)>,
    curve: Curve,
}

/// Displays a run's stages as they change.
#[derive(Debug)]
pub(crate) struct Progress {
    bars: Option<MultiProgress>,
    stages: BTreeMap<StageName, Shown>,
    changes: BTreeMap<StageName, Vec<LossChange>>,
    /// Advice for a stage without a worker.
    for_workers: &'static str,
    /// Time after which such a stage is mentioned.
    patience: Duration,
}

impl Progress {
    /// Displays bars if `bars`, else lines. `for_workers` is the advice for getting more workers.
    pub(crate) fn new(bars: bool, pipeline: &Pipeline, for_workers: &'static str) -> Self {
        let changes = pipeline.stages.iter().map(|stage| (stage.name.clone(), stage.settings.loss_changes()));
        Self {
            bars: bars.then(MultiProgress::new),
            stages: BTreeMap::new(),
            changes: changes.filter(|(_, changes)| !changes.is_empty()).collect(),
            for_workers,
            patience: PATIENCE,
        }
    }

    /// Prints a message between the bars.
    pub(crate) fn note(&self, text: &str) {
        match &self.bars {
            // A terminal that is gone needs no message.
            Some(bars) => drop(bars.println(printable(text))),
            None => print::note(text),
        }
    }

    /// Removes the bars.
    pub(crate) fn finish(&mut self) {
        for shown in self.stages.values_mut() {
            if let Some(bar) = shown.bar.take() {
                bar.finish_and_clear();
            }
        }
        if let Some(bars) = &self.bars {
            // The bars are gone already; this only frees the line.
            let _ = bars.clear();
        }
    }

    /// Displays the changes of a run.
    pub(crate) fn update(&mut self, run: &RunView) {
        self.update_at(&run.stages, Instant::now());
    }

    fn update_at(&mut self, stages: &[StageView], now: Instant) {
        let is_busy = stages.iter().any(|stage| stage.state == StageState::Running);
        self.patience = if is_busy { PATIENCE_IN_A_QUEUE } else { PATIENCE };
        for stage in stages {
            for line in self.stage(stage, now) {
                self.note(&line);
            }
        }
    }

    /// Updates a stage and returns the lines that report changes.
    fn stage(&mut self, stage: &StageView, now: Instant) -> Vec<String> {
        let shown = self.stages.entry(stage.name.clone()).or_insert_with(|| Shown {
            state: StageState::Waiting,
            message: None,
            bar: None,
            line_at: now,
            done: stage.progress.done,
            lacks: None,
            curve: Curve::default(),
        });
        let mut lines = Vec::new();
        let progress = &stage.progress;
        let is_at_work = stage.state == StageState::Running && progress.total > 0;
        let changes = self.changes.get(&stage.name).map(Vec::as_slice).unwrap_or_default();
        // A stage that is taken from an earlier run has no curve to explain.
        let trains = stage.state != StageState::Cached;
        let passed = changes.iter().filter(|change| trains && (shown.done..progress.done).contains(&change.at));
        for change in passed {
            lines.push(loss_changes(stage, change));
            shown.curve.forget_losses();
        }
        shown.done = progress.done;
        if is_at_work {
            shown.curve.push(now, progress.done, stage.metrics.get("loss").copied());
        }
        if shown.state != stage.state || shown.message != stage.message {
            // A bar already shows that a stage has started.
            let is_shown = self.bars.is_some() && stage.state == StageState::Running && progress.done == 0;
            lines.extend(change(stage, shown.state).filter(|_| !is_shown));
            if shown.state != stage.state {
                shown.line_at = now;
            }
            shown.state = stage.state;
            shown.message.clone_from(&stage.message);
        }
        shown.lacks = stage.wants_workers.map(|_| shown.lacks.unwrap_or((now, false)));
        if let Some((since, said @ false)) = &mut shown.lacks
            && now - *since >= self.patience
        {
            *said = true;
            let (name, message) = (stage.name.as_str(), stage.message.as_deref().unwrap_or_default());
            lines.push(format!("{name:>14}  {message}; {}", self.for_workers));
        }
        match (&self.bars, &shown.bar) {
            (Some(bars), None) if is_at_work => {
                let bar = ProgressBar::new(progress.total).with_style(style());
                shown.bar = Some(bars.add(bar.with_prefix(stage.name.to_string())));
            }
            (None, _) if is_at_work && now - shown.line_at >= BETWEEN_LINES => {
                shown.line_at = now;
                lines.push(format!("{:>14}  {}", stage.name.as_str(), working(stage, &shown.curve, now)));
            }
            _ => {}
        }
        if is_at_work {
            if let Some(bar) = &shown.bar {
                bar.set_length(progress.total);
                bar.set_position(progress.done);
                bar.set_message(working(stage, &shown.curve, now));
            }
        } else if let Some(bar) = shown.bar.take() {
            bar.finish_and_clear();
        }
        lines
    }
}

fn style() -> ProgressStyle {
    ProgressStyle::with_template("{prefix:>14}  {bar:20} {wide_msg}").unwrap_or_else(|_| ProgressStyle::default_bar())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use protocol::message::Progress as Done;

    use super::*;

    fn stage(state: StageState, done: u64) -> StageView {
        StageView {
            name: "vae".into(),
            kind: "train.vae".into(),
            state,
            key: None,
            outputs: BTreeMap::new(),
            metrics: BTreeMap::from([("grad_norm".to_owned(), 0.5), ("loss".to_owned(), 0.25)]),
            progress: Done { done, total: 100, unit: "steps".into(), metrics: BTreeMap::new() },
            wall_s: 12.0,
            peak_memory: None,
            attempt: protocol::Attempt(1),
            workers: vec!["w1".into(), "w2".into()],
            instruction_set: None,
            message: None,
            wants_workers: None,
            of: None,
            copy_of: None,
            times: Default::default(),
            needs: vec![],
        }
    }

    fn pipeline() -> Pipeline {
        let text = "name: p\ndataset: {format: synthetic}\nstages:\n  vae: {kind: train.vae, steps: 100, loss: {joint_from: 0.5}}\n";
        pipeline::read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"))
    }

    fn progress() -> Progress {
        Progress::new(false, &pipeline(), "`--workers N` starts more")
    }

    #[test]
    fn changes_are_told_once() {
        let line = |state, done| change(&stage(state, done), StageState::Waiting);
        assert_eq!(line(StageState::Running, 0).unwrap(), "           vae  started on w1, w2");
        assert_eq!(line(StageState::Running, 40).unwrap(), "           vae  continues at 40 of 100 steps");
        assert_eq!(
            line(StageState::Ran, 100).unwrap(),
            "           vae  done: 100 of 100 steps in 12 s  loss 0.2500  grad_norm 0.5000"
        );
        assert_eq!(line(StageState::Waiting, 0), None);
        assert_eq!(change(&stage(StageState::Running, 50), StageState::Running), None);
    }

    #[test]
    fn what_was_not_asked_for_has_no_line() {
        let skipped = |why: &str| {
            let stage = StageView { message: Some(why.to_owned()), ..stage(StageState::Skipped, 0) };
            change(&stage, StageState::Waiting)
        };
        assert_eq!(skipped(StageView::NOT_ASKED_FOR), None);
        assert_eq!(skipped("stage `data` failed").unwrap(), "           vae  skipped: stage `data` failed");
    }

    #[test]
    fn a_stage_at_work_has_a_line_a_minute() {
        let (mut progress, start) = (progress(), Instant::now());
        let mut lines = Vec::new();
        for second in 0..130 {
            let now = start + Duration::from_secs(second);
            let at = |line: String| (second, line);
            lines.extend(progress.stage(&stage(StageState::Running, 1 + second / 4), now).into_iter().map(at));
        }
        let seconds: Vec<u64> = lines.iter().map(|(second, _)| *second).collect();
        assert_eq!(seconds, [0, 60, 120], "{lines:#?}");
        let values = "loss 0.2500  grad_norm 0.5000";
        assert_eq!(
            lines[1].1,
            format!("           vae  16 of 100 steps  0.250/s  5 min 36 s left  ▁▁▁▁▁▁▁▁▁▁▁▁▁▁▁▁  {values}")
        );
    }

    #[test]
    fn a_missing_worker_is_mentioned_after_a_while_with_what_to_do() {
        let (mut progress, start) = (progress(), Instant::now());
        let waits = StageView {
            message: Some("waits for 1 idle `flex` worker".to_owned()),
            wants_workers: Some(1),
            ..stage(StageState::Ready, 0)
        };
        let mut said = |second| progress.stage(&waits, start + Duration::from_secs(second));
        assert_eq!(said(0), [""; 0]);
        assert_eq!(said(14), [""; 0]);
        assert_eq!(said(15), ["           vae  waits for 1 idle `flex` worker; `--workers N` starts more"]);
        assert_eq!(said(16), [""; 0]);
    }

    #[test]
    fn a_stage_behind_others_of_its_run_waits_without_a_word() {
        let (mut progress, start) = (progress(), Instant::now());
        let waits = StageView { wants_workers: Some(1), ..stage(StageState::Ready, 0) };
        let other = StageView { name: "mld".into(), ..stage(StageState::Running, 1) };
        let mut said = |stages: &[StageView], second| {
            progress.update_at(stages, start + Duration::from_secs(second));
            progress.stages[&StageName::from("vae")].lacks.is_some_and(|(_, said)| said)
        };
        assert!(!said(&[waits.clone(), other.clone()], 0));
        assert!(!said(&[waits.clone(), other], 500), "the other stage frees its worker");
        assert!(said(&[waits], 501), "nothing of the run is computed");
    }

    #[test]
    fn a_jump_of_the_loss_is_explained_where_it_happens() {
        let (mut progress, start) = (progress(), Instant::now());
        let mut lines = |done| progress.stage(&stage(StageState::Running, done), start);
        assert_eq!(lines(10), ["           vae  continues at 10 of 100 steps"]);
        assert_eq!(lines(50), [""; 0]);
        let joins = "the loss includes the terms on joints";
        assert_eq!(lines(52), [format!("           vae  from step 50 of 100: {joins} (`loss.joint_from`)")]);
        assert_eq!(lines(60), [""; 0]);
        let mut later = self::progress();
        let lines = later.stage(&stage(StageState::Running, 70), start);
        assert_eq!(lines, ["           vae  continues at 70 of 100 steps"], "it joined long ago");
        let mut cached = self::progress();
        assert_eq!(cached.stage(&stage(StageState::Cached, 100), start), ["           vae  cached"]);
    }
}
