//! Fields that joined when stores already held stages without them.
//!
//! A stage's key, a checkpoint's configuration and a run's name are digests over settings, and recovery derives them again from what the
//! journal holds. A new field would change them all, though nothing else did: an older store's journal would not replay and its stages
//! would be computed again. So a field that joins a kind that was released is listed here, and is left out of digests as long as it has
//! its default, which must mean "as before". Whoever changes a default later raises the kind's code version.

use serde_json::Value;

use super::{Placement, StageSettings};

/// (a kind's name or [`PLACEMENT`], the field's path such as `sampler.order`).
const LATER: &[(&str, &str)] = &[(PLACEMENT, "checkpoint.keep.metric"), (PLACEMENT, "checkpoint.keep.mode")];

/// What owns the fields of [`Placement`], which count for a pipeline's digest.
const PLACEMENT: &str = "placement";

/// Settings as JSON, as they enter a digest.
pub(super) fn settings(settings: &StageSettings) -> Value {
    let mut value = json(settings);
    leave_out(LATER, &mut value);
    value
}

/// A pipeline as JSON, as it enters its digest.
pub(crate) fn pipeline(pipeline: &crate::Pipeline) -> Value {
    let mut value = json(pipeline);
    for stage in value["stages"].as_array_mut().into_iter().flatten() {
        leave_out(LATER, &mut stage["settings"]);
        leave_out_of_placement(LATER, &mut stage["placement"]);
        if let Some(evaluate) = stage.pointer_mut("/sweep/evaluate") {
            leave_out(LATER, evaluate);
        }
    }
    value
}

fn json<T: serde::Serialize>(value: &T) -> Value {
    serde_json::to_value(value).expect("our types serialise to JSON")
}

fn leave_out(later: &[(&str, &str)], settings: &mut Value) {
    let kind = settings["kind"].as_str().unwrap_or_default().to_owned();
    let of_kind = |(owner, path): &&(&str, &str)| *owner == kind && !path.is_empty();
    if !later.iter().any(|entry| of_kind(&entry)) {
        return;
    }
    let Some(default) = StageSettings::all().into_iter().find(|settings| settings.kind() == kind) else { return };
    let default = json(&default);
    later.iter().filter(of_kind).for_each(|(_, path)| remove(settings, &default, path));
}

fn leave_out_of_placement(later: &[(&str, &str)], placement: &mut Value) {
    let default = json(&Placement::default());
    later.iter().filter(|(owner, _)| *owner == PLACEMENT).for_each(|(_, path)| remove(placement, &default, path));
}

/// Removes what is at `path` if it is what the default has there.
fn remove(value: &mut Value, default: &Value, path: &str) {
    let (parents, field) = path.rsplit_once('.').map_or((None, path), |(parents, field)| (Some(parents), field));
    let mut keys = parents.into_iter().flat_map(|parents| parents.split('.'));
    let places =
        keys.try_fold((value, default), |(value, default), key| Some((value.get_mut(key)?, default.get(key)?)));
    if let Some((Value::Object(map), default)) = places
        && map.get(field) == default.get(field)
    {
        map.remove(field);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canonical;
    use crate::stage::EvaluateT2m;

    #[test]
    fn a_later_field_is_left_out_while_it_has_its_default() {
        let later = [("evaluate.t2m", "widen"), ("evaluate.t2m", "sampler.guidance"), ("train.vae", "ema")];
        let left = |settings: EvaluateT2m| {
            let mut value = json(&StageSettings::EvaluateT2m(settings));
            leave_out(&later, &mut value);
            (value.get("widen").cloned(), value["sampler"].get("guidance").cloned(), value["sampler"]["steps"].clone())
        };
        assert_eq!(left(EvaluateT2m::default()), (None, None, 1.into()));
        let other = EvaluateT2m { widen: true, ..EvaluateT2m::default() };
        assert_eq!(left(other), (Some(true.into()), None, 1.into()));
        let mut placement = json(&Placement::default());
        leave_out_of_placement(&[(PLACEMENT, "checkpoint.keep.best")], &mut placement);
        let keep = &placement["checkpoint"]["keep"];
        assert_eq!((keep.get("best"), &keep["latest"]), (None, &2.into()), "{keep}");
    }

    #[test]
    fn what_is_listed_exists() {
        for (owner, path) in LATER {
            let mut all = StageSettings::all().into_iter();
            let default = match all.find(|settings| settings.kind() == *owner) {
                Some(settings) => json(&settings),
                None if *owner == PLACEMENT => json(&Placement::default()),
                None => panic!("there is no kind `{owner}`"),
            };
            let place = path.split('.').try_fold(&default, |value, key| value.get(key));
            assert!(place.is_some(), "there is no `{path}` of `{owner}`");
        }
    }

    /// `testdata/settings.json` is what a build of November 2026 stored: the default settings of its kinds, and its placement.
    #[test]
    fn what_older_builds_stored_keeps_its_digest() {
        let stored: Value = serde_json::from_str(include_str!("../../testdata/settings.json")).expect("JSON");
        let advice = "a field that joined is listed in `LATER`, with a default that means: as before";
        for old in stored["settings"].as_array().expect("a list") {
            let read: StageSettings = serde_json::from_value(old.clone()).unwrap_or_else(|e| panic!("{old}: {e}"));
            assert_eq!(canonical::digest(&settings(&read)), canonical::digest(old), "{}: {advice}", read.kind());
        }
        let old = &stored["placement"];
        let read: Placement = serde_json::from_value(old.clone()).expect("a placement");
        let mut value = json(&read);
        leave_out_of_placement(LATER, &mut value);
        assert_eq!(&value, old, "placement: {advice}");
    }

    /// Each field of a mapping with a default may be missing, one at a time.
    #[test]
    fn a_field_that_an_older_build_did_not_know_has_its_default() {
        let mut tried = 0;
        for default in StageSettings::all() {
            let whole = json(&default);
            for path in paths(&whole, "") {
                let required = ["steps", "batch", "lr", "warmup", "decay", "max_grad_norm", "kind"];
                let first = path.trim_start_matches('/').split('/').next().unwrap_or_default();
                if required.contains(&first) {
                    continue;
                }
                let mut value = whole.clone();
                let (parent, field) = path.rsplit_once('/').expect("a path");
                let parent = value.pointer_mut(parent).and_then(Value::as_object_mut).expect("a mapping");
                parent.remove(field).expect("it was there");
                let read: StageSettings = serde_json::from_value(value).unwrap_or_else(|e| panic!("{path}: {e}"));
                assert_eq!(read, default, "without {path}");
                tried += 1;
            }
        }
        assert!(tried > 100, "{tried}");
    }

    fn paths(value: &Value, at: &str) -> Vec<String> {
        let Some(map) = value.as_object() else { return Vec::new() };
        let below = map.iter().flat_map(|(key, value)| {
            let path = format!("{at}/{key}");
            [vec![path.clone()], paths(value, &path)].concat()
        });
        below.collect()
    }
}
