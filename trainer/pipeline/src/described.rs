//! The schema of a settings struct for the pipeline reader: closed, with defaults, and descriptions from its doc
//! comments.

use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde::Serialize;
use serde_json::{Value, json};

pub(crate) fn generator() -> schemars::SchemaGenerator {
    SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true).into_generator()
}

/// Schema of a settings struct: closed, with the defaults of `example`.
pub(crate) fn described<T: JsonSchema + Serialize>(example: &T) -> Value {
    described_as(T::json_schema(&mut generator()).to_value(), example)
}

/// Like [`described`], for an existing schema.
pub(crate) fn described_as(mut schema: Value, example: &impl Serialize) -> Value {
    close(&mut schema, &serde_json::to_value(example).expect("settings are JSON"));
    schema
}

/// Closes the keys of a schema to those of the example, and records the example's values as defaults. Keys that the
/// example lacks are not for users.
fn close(schema: &mut Value, example: &Value) {
    if let Some(text) = schema.get("description").and_then(Value::as_str) {
        schema["description"] = prose(text).into();
    }
    let Some(schema) = schema.as_object_mut() else { return };
    for key in ["title", "format", "required"] {
        schema.remove(key);
    }
    // An optional mapping has no example of its keys.
    if let Some(properties) = schema.get_mut("properties").and_then(Value::as_object_mut)
        && (example.is_object() || example.is_null())
    {
        properties.retain(|key, _| example.is_null() || example.get(key).is_some());
        properties.iter_mut().for_each(|(key, property)| close(property, &example[key]));
        schema.insert("additionalProperties".into(), false.into());
        schema.remove("default");
        if example.is_null() {
            schema.insert("default".into(), Value::Null);
        }
        return;
    }
    for word in schema.get_mut("oneOf").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(text) = word.get("description").and_then(Value::as_str) {
            word["description"] = prose(text).into();
        }
    }
    schema.insert("default".into(), example.clone());
    // One text is a list of one.
    if schema.get("items").is_some_and(|items| items["type"] == "string") {
        schema.insert("type".into(), json!(["array", "string"]));
    }
}

/// Converts a doc comment to one line without links.
fn prose(text: &str) -> String {
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    text.replace("[`", "`").replace("`]", "`")
}
