//! All points of a space of choices, in the order of the settings' names; the last setting varies fastest.

use protocol::sweep::{Domain, MAX_TRIALS, Sweep, Values};
use serde_json::Value;

pub(super) fn points(sweep: &Sweep) -> Vec<Values> {
    let mut points = vec![Values::new()];
    for (path, domain) in &sweep.space {
        let Domain::Choice(choices) = domain else { continue };
        let longer = points.iter().flat_map(|point| choices.iter().map(|value| with(point, path, value)));
        points = longer.take(MAX_TRIALS).collect();
    }
    points
}

/// A point with one more setting.
fn with(point: &Values, path: &str, value: &Value) -> Values {
    let mut point = point.clone();
    point.insert(path.to_owned(), value.clone());
    point
}
