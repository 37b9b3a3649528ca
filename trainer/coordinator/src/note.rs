//! One sentence on how a run stands: the reason of a failure, what it waits for or computes, or its result.

use protocol::message::{RunState, StageState, StageView};

/// Metrics that sum a result up, the most telling first.
const TELLING: [&str; 6] = ["fid", "latent_fid", "recognised", "r_precision_top1", "mpjpe_mm", "loss"];

/// Says how a run with these stages stands; empty if there is nothing to say.
pub(crate) fn note(state: RunState, stages: &[StageView]) -> String {
    let main = || stages.iter().filter(|stage| stage.of.is_none() && stage.is_asked_for());
    let failed = |stage: &&StageView| stage.state == StageState::Failed;
    if state == RunState::Failed
        && let Some(broken) = main().find(failed).or_else(|| stages.iter().find(failed))
    {
        return said(broken);
    }
    if state == RunState::Finished {
        let measured = main().rfind(|stage| stage.state.is_done() && stage.kind.starts_with("evaluate"));
        return measured.map(result).unwrap_or_default();
    }
    if state.is_final() {
        return String::new();
    }
    if let Some(lacking) = main().find(|stage| stage.wants_workers.is_some()) {
        return said(lacking);
    }
    let at_work: Vec<&str> =
        main().filter(|stage| stage.state == StageState::Running).map(|stage| stage.name.as_str()).collect();
    if !at_work.is_empty() {
        return at_work.join(", ");
    }
    main().find(|stage| stage.state == StageState::Ready && stage.message.is_some()).map(said).unwrap_or_default()
}

/// The first line of a stage's message, with the stage's name.
fn said(stage: &StageView) -> String {
    let line = stage.message.as_deref().and_then(|message| message.lines().next()).unwrap_or_default();
    format!("{}: {line}", stage.name)
}

/// The metric of a stage that says most.
fn result(stage: &StageView) -> String {
    let telling = TELLING.iter().find_map(|key| stage.metrics.get_key_value(*key));
    match telling.or_else(|| stage.metrics.first_key_value()) {
        Some((key, value)) => format!("{}: {key} {}", stage.name, rounded(*value)),
        None => String::new(),
    }
}

/// A number with four significant digits.
fn rounded(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let digits = (3.0 - value.abs().log10().floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_four_digits() {
        for (value, text) in
            [(0.0, "0"), (12.345_67, "12.35"), (0.001_234_56, "0.001235"), (1234.5, "1234"), (-2.5, "-2.5")]
        {
            assert_eq!(rounded(value), text);
        }
    }
}
