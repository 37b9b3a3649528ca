//! What a run looks like while it runs: bars on a terminal, else a line for each change and one per stage every ten seconds.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use protocol::message::{RunView, StageState, StageView};
use protocol::{StageName, printable};

use crate::print;

const BETWEEN_LINES: Duration = Duration::from_secs(10);

/// What was last shown of a stage.
#[derive(Debug)]
struct Shown {
    state: StageState,
    message: Option<String>,
    bar: Option<ProgressBar>,
    /// Where the present stretch of work began, for rates: a resumed stage does not begin at 0.
    from: Option<(u64, Instant)>,
    line_at: Instant,
    done: u64,
}

/// Shows a run's stages as they change.
#[derive(Debug)]
pub(crate) struct Progress {
    bars: Option<MultiProgress>,
    stages: BTreeMap<StageName, Shown>,
}

impl Progress {
    /// Bars if `bars`, else lines.
    pub(crate) fn new(bars: bool) -> Self {
        Self { bars: bars.then(MultiProgress::new), stages: BTreeMap::new() }
    }

    /// A message between the bars.
    pub(crate) fn note(&self, text: &str) {
        match &self.bars {
            // Without a terminal any more there is nobody to tell.
            Some(bars) => drop(bars.println(printable(text))),
            None => print::note(text),
        }
    }

    /// Takes the bars away.
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

    /// Shows what changed.
    pub(crate) fn update(&mut self, run: &RunView) {
        for stage in &run.stages {
            self.stage(stage);
        }
    }

    fn stage(&mut self, stage: &StageView) {
        let now = Instant::now();
        let shown = self.stages.entry(stage.name.clone()).or_insert_with(|| Shown {
            state: StageState::Waiting,
            message: None,
            bar: None,
            from: None,
            line_at: now,
            done: 0,
        });
        let mut lines = Vec::new();
        if shown.state != stage.state || shown.message != stage.message {
            lines.extend(change(stage, shown));
            if shown.state != stage.state {
                shown.from = None;
            }
            shown.state = stage.state;
            shown.message.clone_from(&stage.message);
        }
        if stage.state == StageState::Running {
            let progress = &stage.progress;
            // An attempt that goes back to a checkpoint starts a new stretch.
            let restarted = shown.from.is_none() || progress.done < shown.done;
            if restarted && progress.total > 0 {
                shown.from = Some((progress.done, now));
            }
            shown.done = progress.done;
            match (&self.bars, &shown.bar) {
                (Some(bars), None) if progress.total > 0 => {
                    let bar = ProgressBar::new(progress.total).with_style(style());
                    let bar = bars.add(bar.with_prefix(stage.name.to_string()).with_position(progress.done));
                    bar.reset_eta();
                    shown.bar = Some(bar);
                }
                (None, _) if progress.total > 0 && now - shown.line_at >= BETWEEN_LINES => {
                    shown.line_at = now;
                    lines.push(working(stage, shown.from, now));
                }
                _ => {}
            }
            if let Some(bar) = &shown.bar {
                bar.set_length(progress.total);
                bar.set_position(progress.done);
                if restarted {
                    bar.reset_eta();
                }
                bar.set_message(values(stage, 3));
            }
        } else if let Some(bar) = shown.bar.take() {
            bar.finish_and_clear();
        }
        for line in lines {
            self.note(&line);
        }
    }
}

fn style() -> ProgressStyle {
    ProgressStyle::with_template("{prefix:>14} {bar:24} {pos}/{len} {per_sec:>10} {eta:>5} left  {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// The line for a new state.
fn change(stage: &StageView, shown: &Shown) -> Option<String> {
    let name = stage.name.as_str();
    Some(match stage.state {
        StageState::Waiting => return None,
        StageState::Ready => format!("{name:>14}  {}", stage.message.as_deref()?),
        StageState::Running if shown.state == StageState::Running => return None,
        StageState::Running if stage.progress.done > 0 => {
            format!(
                "{name:>14}  goes on at {} of {} {}",
                stage.progress.done, stage.progress.total, stage.progress.unit
            )
        }
        StageState::Running => {
            let workers: Vec<&str> = stage.workers.iter().map(protocol::WorkerId::as_str).collect();
            format!("{name:>14}  started{}{}", if workers.is_empty() { "" } else { " on " }, workers.join(", "))
        }
        StageState::Ran | StageState::Resumed => {
            let values = values(stage, 3);
            format!(
                "{name:>14}  done in {}{}{values}",
                print::duration(stage.wall_s),
                if values.is_empty() { "" } else { "  " }
            )
        }
        StageState::Cached => format!("{name:>14}  cached"),
        StageState::Failed => format!("{name:>14}  FAILED: {}", stage.message.as_deref().unwrap_or("no reason given")),
        StageState::Skipped => format!("{name:>14}  skipped: {}", stage.message.as_deref().unwrap_or("")),
    })
}

fn working(stage: &StageView, from: Option<(u64, Instant)>, now: Instant) -> String {
    let progress = &stage.progress;
    let (first, since) = from.unwrap_or((progress.done, now));
    let seconds = (now - since).as_secs_f64();
    let done = progress.done.saturating_sub(first) as f64;
    let speed = if seconds > 0.0 && done > 0.0 {
        let rate = done / seconds;
        let left = progress.total.saturating_sub(progress.done) as f64 / rate;
        format!("  {} {}/s, {} left", print::number(rate), progress.unit, print::duration(left))
    } else {
        String::new()
    };
    let name = stage.name.as_str();
    format!("{name:>14}  {}/{} {}{speed}  {}", progress.done, progress.total, progress.unit, values(stage, 3))
}

/// What one looks at first.
const FIRST: [&str; 3] = ["loss", "fid", "r_precision_top3"];

/// The first few values, such as `loss 0.1834  grad_norm 0.71`; ends of intervals are left to reports.
pub(crate) fn values(stage: &StageView, count: usize) -> String {
    let end = |key: &str| key.ends_with(".lower") || key.ends_with(".upper");
    let first = FIRST.iter().filter_map(|key| stage.metrics.get_key_value(*key));
    let others = stage.metrics.iter().filter(|(key, _)| !FIRST.contains(&key.as_str()) && !end(key));
    let shown = first.chain(others).take(count).map(|(key, value)| format!("{key} {}", print::number(*value)));
    printable(&shown.collect::<Vec<_>>().join("  ")).into_owned()
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
            attempt: protocol::Attempt(1),
            workers: vec!["w1".into(), "w2".into()],
            instruction_set: None,
            message: None,
            of: None,
        }
    }

    fn shown(state: StageState) -> Shown {
        Shown { state, message: None, bar: None, from: None, line_at: Instant::now(), done: 0 }
    }

    #[test]
    fn changes_are_told_once() {
        let waiting = shown(StageState::Waiting);
        let line = |state, done| change(&stage(state, done), &waiting);
        assert_eq!(line(StageState::Running, 0).unwrap(), "           vae  started on w1, w2");
        assert_eq!(line(StageState::Running, 40).unwrap(), "           vae  goes on at 40 of 100 steps");
        assert_eq!(line(StageState::Ran, 100).unwrap(), "           vae  done in 12 s  loss 0.2500  grad_norm 0.5000");
        assert_eq!(line(StageState::Waiting, 0), None);
        assert_eq!(change(&stage(StageState::Running, 50), &shown(StageState::Running)), None);
    }

    #[test]
    fn the_rate_is_that_of_the_present_stretch() {
        let now = Instant::now();
        let since = now.checked_sub(Duration::from_secs(10)).unwrap();
        let line = working(&stage(StageState::Running, 60), Some((40, since)), now);
        assert_eq!(line, "           vae  60/100 steps  2.000 steps/s, 20 s left  loss 0.2500  grad_norm 0.5000");
    }
}
