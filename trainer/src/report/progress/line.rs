//! The line of a stage: its new state, its work, its values.

use std::time::Instant;

use protocol::message::{StageState, StageView};
use protocol::printable;
use protocol::stage::LossChange;
use protocol::units::grouped;

use super::curve::Curve;
use crate::report::print;

pub(super) fn loss_changes(stage: &StageView, LossChange { at, what, setting }: &LossChange) -> String {
    let (name, at, total) = (stage.name.as_str(), grouped(*at), grouped(stage.progress.total));
    format!("{name:>14}  from step {at} of {total}: {what} (`{setting}`)")
}

/// The line for a new state; `before` is the state displayed so far.
pub(super) fn change(stage: &StageView, before: StageState) -> Option<String> {
    let name = stage.name.as_str();
    let progress = &stage.progress;
    let says = match stage.state {
        StageState::Waiting => return None,
        // A worker may be about to come; see `PATIENCE`.
        StageState::Ready if stage.wants_workers.is_some() => return None,
        StageState::Ready => stage.message.clone()?,
        StageState::Running if before == StageState::Running => return None,
        StageState::Running if progress.done > 0 => format!("continues at {}", count(stage)),
        StageState::Running => {
            let workers: Vec<&str> = stage.workers.iter().map(protocol::WorkerId::as_str).collect();
            format!("started{}{}", if workers.is_empty() { "" } else { " on " }, workers.join(", "))
        }
        StageState::Ran | StageState::Resumed => {
            let count = if progress.total > 0 { format!(": {}", count(stage)) } else { String::new() };
            let values = values(stage, 3);
            let gap = if values.is_empty() { "" } else { "  " };
            format!("done{count} in {}{gap}{values}", print::duration(stage.wall_s))
        }
        StageState::Cached => "cached".to_owned(),
        StageState::Failed => format!("FAILED: {}", stage.message.as_deref().unwrap_or("no reason given")),
        StageState::Skipped if !stage.is_asked_for() => return None,
        StageState::Skipped => format!("skipped: {}", stage.message.as_deref().unwrap_or("")),
    };
    Some(format!("{name:>14}  {says}"))
}

/// Formats a count: `1,204 of 6,000 steps`.
fn count(stage: &StageView) -> String {
    let progress = &stage.progress;
    format!("{} of {} {}", grouped(progress.done), grouped(progress.total), progress.unit).trim_end().to_owned()
}

/// Formats a running stage: `1,204 of 6,000 steps  23.1/s  3 min 28 s left  ▇▅▃▂▁  loss 0.1834`.
pub(super) fn working(stage: &StageView, curve: &Curve, now: Instant) -> String {
    let progress = &stage.progress;
    let mut parts = vec![count(stage)];
    if let Some(rate) = curve.rate(now) {
        let left = progress.total.saturating_sub(progress.done) as f64 / rate;
        parts.push(format!("{}/s", print::rounded(rate)));
        parts.push(format!("{} left", print::duration(left)));
    }
    let line = curve.sparkline();
    parts.extend((!line.is_empty()).then_some(line));
    let values = values(stage, 3);
    parts.extend((!values.is_empty()).then_some(values));
    parts.join("  ")
}

/// The most important metrics. `skipped` is the number of clips left out of a dataset.
const FIRST: [&str; 4] = ["skipped", "loss", "fid", "r_precision_top3"];

/// The first few metrics, such as `loss 0.1834  grad_norm 0.71`, without the ends of confidence intervals.
fn values(stage: &StageView, count: usize) -> String {
    let end = |key: &str| key.ends_with(".lower") || key.ends_with(".upper");
    let first = FIRST.iter().filter_map(|key| stage.metrics.get_key_value(*key));
    let first = first.filter(|(key, value)| *key != "skipped" || **value > 0.0);
    // A key such as `accuracy/backwards` is a part of another value.
    let others =
        stage.metrics.iter().filter(|(key, _)| !FIRST.contains(&key.as_str()) && !end(key) && !key.contains('/'));
    let shown = first.chain(others).take(count).map(|(key, value)| format!("{key} {}", print::number(*value)));
    printable(&shown.collect::<Vec<_>>().join("  ")).into_owned()
}
