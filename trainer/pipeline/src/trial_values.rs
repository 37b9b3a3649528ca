//! Settings of a trial: those of the swept stage with some values changed.

use protocol::stage::{Placement, StageSettings};
use protocol::sweep::{Sweep, Values, in_evaluation};

use crate::rules::broken_rules;

/// Inserts `values` into `base` and the evaluating stage of `sweep`, each value into its own stage.
///
/// # Errors
/// Values that do not fit, each with the violated rule.
pub(crate) fn trial_settings(
    sweep: &Sweep,
    base: &StageSettings,
    values: &Values,
) -> Result<(StageSettings, StageSettings), String> {
    let mut own = Values::new();
    let mut of_evaluation = Values::new();
    for (path, value) in values {
        match in_evaluation(path) {
            Some(path) => of_evaluation.insert(path.to_owned(), value.clone()),
            None => own.insert(path.clone(), value.clone()),
        };
    }
    let evaluate = match of_evaluation.is_empty() {
        true => (*sweep.evaluate).clone(),
        false => with_values(&sweep.evaluate, &of_evaluation)?,
    };
    Ok((with_values(base, &own)?, evaluate))
}

/// Inserts `values` into `base`.
///
/// # Errors
/// Values that do not fit, each with the violated rule.
pub fn with_values(base: &StageSettings, values: &Values) -> Result<StageSettings, String> {
    let mut json = serde_json::to_value(base).map_err(|e| e.to_string())?;
    for (path, value) in values {
        let place = path.split('.').try_fold(&mut json, |value, key| value.get_mut(key));
        *place.ok_or_else(|| format!("unknown setting `{path}`"))? = value.clone();
    }
    let settings: StageSettings = serde_json::from_value(json).map_err(|e| e.to_string())?;
    let broken = broken_rules(&settings, &Placement::default());
    if broken.is_empty() { Ok(settings) } else { Err(broken.join("; ")) }
}
