//! The schema of a stage, derived from an example.
//!
//! The serialised default of a settings struct has every key with a value of its type. A mapping in the example closes
//! the set of keys. Any other value is a leaf, checked by inserting the user's value and deserialising with serde. So a
//! field is declared once, in its struct.

use protocol::spelling::nearest;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::yaml::{Content, Node};

/// A mistake at a position of the tree.
#[derive(Debug)]
pub(crate) struct Mistake {
    pub(crate) at: crate::diagnostic::Position,
    pub(crate) path: String,
    pub(crate) message: String,
    pub(crate) help: Option<String>,
}

/// Writes the values of `node` over `base`, the example, and collects mistakes. `owner` is for messages: `stage `vae``.
/// `skip` are keys that the caller reads itself, but which are allowed here.
pub(crate) fn overlay<T: DeserializeOwned>(
    base: &mut Value,
    node: &Node,
    owner: &str,
    path: &str,
    skip: &[&str],
    mistakes: &mut Vec<Mistake>,
) {
    let example = base.clone();
    let mut walk = Walk { example: &example, base, owner, mistakes, fits: &fits::<T> };
    walk.mapping(node, &mut Vec::new(), path, skip);
}

fn fits<T: DeserializeOwned>(value: &Value) -> Result<(), String> {
    T::deserialize(value).map(drop).map_err(|error| error.to_string())
}

struct Walk<'a> {
    example: &'a Value,
    base: &'a mut Value,
    owner: &'a str,
    mistakes: &'a mut Vec<Mistake>,
    fits: &'a dyn Fn(&Value) -> Result<(), String>,
}

impl Walk<'_> {
    fn push(&mut self, at: crate::diagnostic::Position, path: &str, message: String, help: Option<String>) {
        self.mistakes.push(Mistake { at, path: path.to_owned(), message, help });
    }

    fn mapping(&mut self, node: &Node, keys: &mut Vec<String>, path: &str, skip: &[&str]) {
        let example = at(self.example, keys).clone();
        let Some(known) = example.as_object() else { return };
        let Some(entries) = node.map() else {
            let found = node.describe();
            let list = list_keys(known.keys().map(String::as_str).chain(skip.iter().copied()));
            self.push(
                node.at,
                path,
                format!("`{}` of {} is {found}; expected a mapping", last(path), self.owner),
                Some(format!("its keys are {list}")),
            );
            return;
        };
        for entry in entries {
            let path = if path.is_empty() { entry.key.clone() } else { format!("{path}.{}", entry.key) };
            if keys.is_empty() && skip.contains(&entry.key.as_str()) {
                continue;
            }
            let Some(value) = known.get(&entry.key) else {
                let names: Vec<&str> = known.keys().map(String::as_str).chain(skip.iter().copied()).collect();
                let place = if keys.is_empty() { String::new() } else { format!("`{}` of ", keys.join(".")) };
                let (message, help) = unknown_key(&entry.key, &format!("in {place}{}", self.owner), &names);
                self.push(entry.key_at, &path, message, Some(help));
                continue;
            };
            keys.push(entry.key.clone());
            if value.is_object() {
                self.mapping(&entry.value, keys, &path, &[]);
            } else {
                self.leaf(&entry.value, keys, &path, value);
            }
            keys.pop();
        }
    }

    fn leaf(&mut self, node: &Node, keys: &[String], path: &str, example: &Value) {
        let label = format!("`{}` of {}", keys.join("."), self.owner);
        if let Content::Scalar { text, plain: true, .. } = &node.value
            && node.to_json().is_none()
            && example.is_number()
        {
            self.push(node.at, path, format!("{label} is `{text}`; expected a finite number"), None);
            return;
        }
        let Some(mut value) = node.to_json() else {
            self.push(node.at, path, format!("{label} has a number that is not finite"), None);
            return;
        };
        // One text is a list of one.
        if example.is_array() && value.is_string() {
            value = Value::Array(vec![value]);
        }
        let mut trial = self.example.clone();
        *at_mut(&mut trial, keys) = value.clone();
        match (self.fits)(&trial) {
            Ok(()) => *at_mut(self.base, keys) = value,
            Err(reason) => {
                let (expected, help) = expectation(example, node, &reason);
                self.push(node.at, path, format!("{label} is {}; expected {expected}", node.describe()), help);
            }
        }
    }
}

/// Expected value of a leaf, in words, from its example and serde's error.
fn expectation(example: &Value, node: &Node, reason: &str) -> (String, Option<String>) {
    if let Some((_, variants)) =
        reason.split_once("unknown variant ").and_then(|(_, rest)| rest.split_once(", expected "))
    {
        let names: Vec<&str> = variants.split('`').skip(1).step_by(2).collect();
        let listed = names.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        let listed = if names.len() == 1 { listed } else { format!("one of {listed}") };
        let help = node.as_text().and_then(|text| nearest(text, names.iter().copied()));
        return (listed, help.map(|name| format!("did you mean `{name}`?")));
    }
    let steps = reason.contains("whole number of steps");
    let expected = match example {
        _ if steps => "a whole number of steps, such as 2000, `300k` or `2000 steps`".to_owned(),
        Value::Bool(_) => "`true` or `false`".into(),
        Value::Number(number) if number.is_f64() => "a number".into(),
        Value::Number(_) => "a whole number of 0 or more".into(),
        Value::String(_) => "a string".into(),
        Value::Array(items) if items.len() == 2 && items[0].is_number() => {
            "a list of two numbers, such as `[5, 15]`".into()
        }
        Value::Array(_) => "a list".into(),
        Value::Null => "a mapping".into(),
        _ => "another value".into(),
    };
    let help = match (&node.value, example) {
        (Content::Scalar { value: Value::Number(_) | Value::Bool(_), text, .. }, Value::String(_)) => {
            Some(format!("to write a string, quote it: \"{text}\""))
        }
        (Content::Scalar { value: Value::String(text), plain: false, .. }, Value::Number(_))
            if text.parse::<f64>().is_ok() =>
        {
            Some("remove the quotes".into())
        }
        (Content::Scalar { value: Value::String(_), .. }, Value::Number(number)) if number.is_f64() => {
            Some("write a number such as 0.0002 or 2e-4".into())
        }
        (Content::Scalar { value: Value::Null, .. }, _) => Some("set a value, or remove the key".into()),
        (Content::List(_), Value::Array(_)) | (_, Value::Null) => Some(reason_in_short(reason)),
        _ => None,
    };
    (expected, help)
}

fn reason_in_short(reason: &str) -> String {
    reason.split(" at line ").next().unwrap_or(reason).replace("usize", "a whole number").replace("f64", "a number")
}

/// Message and advice for an unknown key.
pub(crate) fn unknown_key(key: &str, place: &str, known: &[&str]) -> (String, String) {
    let list = list_keys(known.iter().copied());
    if key == "<<" {
        return (format!("merge keys are not supported {place}"), "write each key".into());
    }
    match nearest(key, known.iter().copied()) {
        Some(near) => (format!("unknown key `{key}` {place}; did you mean `{near}`?"), format!("known keys: {list}")),
        None => (format!("unknown key `{key}` {place}"), format!("known keys: {list}")),
    }
}

/// Lists keys as `a`, `b`, `c`.
pub(crate) fn list_keys<'a>(keys: impl IntoIterator<Item = &'a str>) -> String {
    keys.into_iter().map(|key| format!("`{key}`")).collect::<Vec<_>>().join(", ")
}

fn last(path: &str) -> &str {
    path.rsplit('.').next().unwrap_or(path)
}

fn at<'a>(value: &'a Value, keys: &[String]) -> &'a Value {
    keys.iter().fold(value, |value, key| &value[key.as_str()])
}

fn at_mut<'a>(value: &'a mut Value, keys: &[String]) -> &'a mut Value {
    keys.iter().fold(value, |value, key| &mut value[key.as_str()])
}
