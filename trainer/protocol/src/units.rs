//! Quantities that users write with a unit or a suffix.

use std::borrow::Cow;
use std::fmt;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

/// A count for people: `1,204`.
pub fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let first = digits.len() % 3;
    let mut text = digits[..first].to_owned();
    for group in digits.as_bytes()[first..].chunks(3) {
        if !text.is_empty() {
            text.push(',');
        }
        text.extend(group.iter().map(|digit| char::from(*digit)));
    }
    text
}

/// A number of bytes for people: `412.0 MiB`.
#[expect(clippy::cast_precision_loss, reason = "for people")]
pub fn size(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "KiB", "MiB", "GiB"] {
        if value < 1024.0 {
            return if unit == "B" { format!("{bytes} B") } else { format!("{value:.1} {unit}") };
        }
        value /= 1024.0;
    }
    format!("{value:.1} TiB")
}

/// A count with its noun: `1 step`, `1,204 steps`.
pub fn counted(count: impl TryInto<u64>, noun: &str) -> String {
    let count = count.try_into().unwrap_or(u64::MAX);
    format!("{} {noun}{}", grouped(count), if count == 1 { "" } else { "s" })
}

/// A number of optimizer updates. Written `300000`, `300k`, `1.2M` or `2000 steps`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(transparent)]
pub struct Steps(pub u64);

impl fmt::Display for Steps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl Steps {
    /// Parses `300k`, `1.2M`, `2000 steps`.
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.trim();
        let text = text.strip_suffix("steps").or_else(|| text.strip_suffix("step")).unwrap_or(text).trim();
        let (digits, factor) = match text.as_bytes().last()? {
            b'k' => (&text[..text.len() - 1], 1e3),
            b'M' => (&text[..text.len() - 1], 1e6),
            _ => (text, 1.0),
        };
        let steps = digits.trim().replace('_', "").parse::<f64>().ok()? * factor;
        ((0.0..1e15).contains(&steps) && steps.fract() == 0.0).then_some(Self(steps as u64))
    }
}

impl<'de> Deserialize<'de> for Steps {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct StepsVisitor;
        impl Visitor<'_> for StepsVisitor {
            type Value = Steps;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a whole number of steps, such as 2000, `300k` or `2000 steps`")
            }

            fn visit_u64<E: de::Error>(self, steps: u64) -> Result<Steps, E> {
                Ok(Steps(steps))
            }

            fn visit_i64<E: de::Error>(self, steps: i64) -> Result<Steps, E> {
                u64::try_from(steps).map(Steps).map_err(|_| E::invalid_value(de::Unexpected::Signed(steps), &self))
            }

            fn visit_str<E: de::Error>(self, text: &str) -> Result<Steps, E> {
                Steps::parse(text).ok_or_else(|| E::invalid_value(de::Unexpected::Str(text), &self))
            }
        }
        deserializer.deserialize_any(StepsVisitor)
    }
}

impl JsonSchema for Steps {
    fn schema_name() -> Cow<'static, str> {
        "Steps".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": ["integer", "string"],
            "minimum": 0,
            "pattern": r"^ *[0-9_.]+ *[kM]? *(steps?)? *$",
            "x-unit": "steps",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural() {
        assert_eq!([0_usize, 1, 1204].map(|count| counted(count, "step")), ["0 steps", "1 step", "1,204 steps"]);
    }

    #[test]
    fn steps_are_read_as_people_write_them() {
        for (text, steps) in [("300k", 300_000), ("1.2M", 1_200_000), ("2000 steps", 2000), ("7", 7)] {
            assert_eq!(Steps::parse(text), Some(Steps(steps)), "{text}");
        }
        for text in ["", "k", "-1", "1.5", "many"] {
            assert_eq!(Steps::parse(text), None, "{text}");
        }
    }
}
