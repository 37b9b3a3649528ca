//! Rules for a single stage: those of its kind, and of its placement. Rules between stages are in `graph`.

use protocol::stage::{Placement, StageSettings};
pub(crate) use protocol::stage::{Problem, Problems};

use crate::ranges;

/// Checks a single stage.
pub(crate) fn stage(settings: &StageSettings, placement: &Placement) -> Vec<Problem> {
    let mut problems = Problems::default();
    settings.check(&mut problems);
    placement.check(&mut problems);
    let saved = settings.recorded();
    if !saved.is_empty()
        && let Err(message) = placement.checkpoint.keep.check(saved)
    {
        problems.add("checkpoint.keep.metric", message, "");
    }
    ranges::check(&mut problems, settings, placement);
    problems.0
}

/// Violated rules of one stage's settings, one per line.
pub fn broken_rules(settings: &StageSettings, placement: &Placement) -> Vec<String> {
    stage(settings, placement).into_iter().map(|problem| problem.message).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_but_for_what_has_no_default() {
        for settings in StageSettings::all() {
            let fields: Vec<String> =
                stage(&settings, &Placement::default()).into_iter().map(|problem| problem.field).collect();
            let expected: &[&str] = match settings.kind() {
                "data.open" | "data.features" | "import.evaluator" => &["path"],
                "import.model" => &["path", "statistics"],
                "register" => &["model", "from"],
                _ => &[],
            };
            assert_eq!(fields, expected, "{}", settings.kind());
        }
    }
}
