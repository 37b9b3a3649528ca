//! Checks every number of a stage's settings against the range beside its field.
//!
//! A field states its range and unit by `#[schemars(range(..), extend("x-unit" = ".."))]`, so the schema and the
//! reference of keys show them too. A limit is far above the papers' values and far below an overflow or the exhaustion
//! of a machine's memory. Rules that depend on other settings are in `rules`.

use std::collections::BTreeMap;
use std::ops::{Bound, RangeBounds as _};
use std::sync::LazyLock;

use protocol::limits;
use protocol::stage::{Placement, Problem, Problems, StageSettings};
use schemars::JsonSchema as _;
use serde_json::Value;

use crate::described::generator;

/// Schemas of the settings of each kind.
static KINDS: LazyLock<BTreeMap<&str, Value>> = LazyLock::new(|| {
    let all = StageSettings::all();
    all.iter().map(|settings| (settings.kind(), settings.schema(&mut generator()).to_value())).collect()
});

static PLACEMENT: LazyLock<Value> = LazyLock::new(|| Placement::json_schema(&mut generator()).to_value());

/// Allowed numbers of a setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Range {
    /// Whole numbers, both ends included.
    Whole(u64, u64),
    /// Real numbers between two bounds.
    Real(Bound<f64>, Bound<f64>),
}

impl Range {
    /// The range that a schema states.
    fn of(schema: &Value) -> Option<Self> {
        if let (Some(least), Some(most)) = (schema["minimum"].as_u64(), schema["maximum"].as_u64()) {
            return Some(Self::Whole(least, most));
        }
        let bound = |included: &str, excluded: &str| match schema[included].as_f64() {
            Some(number) => Some(Bound::Included(number)),
            None => schema[excluded].as_f64().map(Bound::Excluded),
        };
        Some(Self::Real(bound("minimum", "exclusiveMinimum")?, bound("maximum", "exclusiveMaximum")?))
    }

    /// Returns true if `value`, a JSON number, is in the range.
    pub(crate) fn holds(self, value: &Value) -> bool {
        match self {
            Self::Whole(from, to) => value.as_u64().is_some_and(|value| (from..=to).contains(&value)),
            Self::Real(from, to) => value.as_f64().is_some_and(|value| (from, to).contains(&value)),
        }
    }

    fn describe(self, unit: &str) -> String {
        let range = match self {
            Self::Whole(from, to) => format!("{from} to {to}"),
            Self::Real(from, to) => {
                let from = match from {
                    Bound::Excluded(number) => format!("a number above {number}"),
                    Bound::Included(number) => format!("a number from {number}"),
                    Bound::Unbounded => "a number".to_owned(),
                };
                match (from.contains("above"), to) {
                    (_, Bound::Excluded(number)) => format!("{from} to below {number}"),
                    (true, Bound::Included(number)) => format!("{from} and at most {number}"),
                    (false, Bound::Included(number)) => format!("{from} to {number}"),
                    (_, Bound::Unbounded) => from,
                }
            }
        };
        if unit.is_empty() { range } else { format!("{range} {unit}") }
    }
}

/// A place in a schema, with the range and unit that hold there. Entries of a list have those of the list.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place<'a> {
    schema: &'a Value,
    pub(crate) range: Option<Range>,
    unit: &'a str,
}

impl<'a> Place<'a> {
    pub(crate) fn of_kind(kind: &str) -> Self {
        Self::at(KINDS.get(kind).unwrap_or(&Value::Null))
    }

    pub(crate) fn of_placement() -> Self {
        Self::at(&PLACEMENT)
    }

    fn at(schema: &'a Value) -> Self {
        Self { schema, range: Range::of(schema), unit: schema["x-unit"].as_str().unwrap_or_default() }
    }

    /// The place of a key of a mapping, which may be optional.
    pub(crate) fn key(self, key: &str) -> Self {
        let alternatives = self.schema["anyOf"].as_array().into_iter().flatten();
        let mut schemas = std::iter::once(self.schema).chain(alternatives);
        Self::at(schemas.find_map(|schema| schema["properties"].get(key)).unwrap_or(&Value::Null))
    }

    /// The place of an entry of a list.
    pub(crate) fn entry(self) -> Self {
        let entry = Self::at(&self.schema["items"]);
        Self { range: entry.range.or(self.range), unit: self.unit, ..entry }
    }
}

/// Checks the settings and the placement of a stage. Skips fields that already have a problem in `p`.
pub(crate) fn check(p: &mut Problems, settings: &StageSettings, placement: &Placement) {
    let mut found = Problems::default();
    for (value, place) in [
        (serde_json::to_value(settings), Place::of_kind(settings.kind())),
        (serde_json::to_value(placement), Place::of_placement()),
    ] {
        walk(&mut found, "", "", &value.unwrap_or_default(), place);
    }
    let known = |problem: &Problem| p.0.iter().any(|other| other.field == problem.field);
    let new: Vec<Problem> = found.0.into_iter().filter(|problem| !known(problem)).collect();
    p.0.extend(new);
}

/// Walks over `value` at `field`, with indices; `path` is the same without them.
fn walk(p: &mut Problems, field: &str, path: &str, value: &Value, place: Place<'_>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                let below = |parent: &str| if parent.is_empty() { key.clone() } else { format!("{parent}.{key}") };
                walk(p, &below(field), &below(path), value, place.key(key));
            }
        }
        Value::Array(items) if items.len() > limits::LIST => {
            p.add(field, format!("`{path}` has {} entries; expected at most {}", items.len(), limits::LIST), "");
        }
        Value::Array(items) => {
            // A problem in a list of numbers is reported for the list, as by its other rules.
            let texts = items.iter().any(Value::is_string);
            for (i, item) in items.iter().enumerate() {
                let field = if texts { format!("{field}[{i}]") } else { field.to_owned() };
                walk(p, &field, path, item, place.entry());
            }
        }
        Value::String(text) if text.len() > limits::TEXT_BYTES => {
            p.add(field, format!("`{path}` has {} bytes; expected at most {}", text.len(), limits::TEXT_BYTES), "");
        }
        Value::String(text) if text.contains(char::is_control) => {
            p.add(
                field,
                format!("`{path}` has a control character, {}", text.escape_debug()),
                "remove the control character",
            );
        }
        Value::Number(_) => {
            if let Some(range) = place.range.filter(|range| !range.holds(value)) {
                p.add(field, format!("`{path}` is {value}; expected {}", range.describe(place.unit)), "");
            }
        }
        Value::String(_) | Value::Bool(_) | Value::Null => {}
    }
}
