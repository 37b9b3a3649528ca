//! All points of a space of choices, in the order of the settings' names; the last setting varies fastest.

use protocol::sweep::{Domain, MAX_TRIALS, Sweep, Values};

pub(super) fn points(sweep: &Sweep) -> Vec<Values> {
    let mut points = vec![Values::new()];
    for (path, domain) in &sweep.space {
        let Domain::Choice(choices) = domain else { continue };
        let with = |point: &Values| {
            choices
                .iter()
                .map(|value| {
                    point
                        .iter()
                        .map(|(k, v)| (k.clone(), v.clone()))
                        .chain([(path.clone(), value.clone())])
                        .collect::<Values>()
                })
                .collect::<Vec<_>>()
        };
        points = points.iter().flat_map(with).take(MAX_TRIALS).collect();
    }
    points
}
