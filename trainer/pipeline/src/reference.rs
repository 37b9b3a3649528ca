//! Reference of a pipeline's keys, for editors ([`json_schema`]) and for users ([`markdown`]).
//!
//! Each fact has one source. Keys, types, ranges, values and their meaning come from the settings structs and their doc
//! comments, defaults from their `Default`, and targets of references from
//! [`StageSpec::refs`](protocol::stage::StageSpec::refs).

use std::collections::BTreeMap;
use std::fmt::Write as _;

use protocol::limits;
use protocol::stage::{DataOpen, DataSynthetic, ImportModel, Placement, Shape, StageSettings, Target, TextEmbed};
use schemars::JsonSchema as _;
use serde_json::{Map, Value, json};

use crate::described::{described, described_as, generator};
use crate::{copies, read, sweep};

/// JSON Schema (draft 2020-12) of a pipeline file.
pub fn json_schema() -> Value {
    let mut definitions = Map::new();
    let mut cases = Vec::new();
    let all = StageSettings::all();
    for settings in &all {
        let kind = settings.kind();
        definitions.insert(kind.to_owned(), stage(settings));
        cases.push(json!({
            "if": {"properties": {"kind": {"const": kind}}, "required": ["kind"]},
            "then": {"$ref": format!("#/$defs/{kind}")},
        }));
    }
    let kinds: Vec<&str> = all.iter().map(StageSettings::kind).collect();
    let mut top = read::described_head();
    let properties = &mut top["properties"];
    let mut synthetic = described(&DataSynthetic::default());
    synthetic["properties"]["format"] = json!({"const": "synthetic"});
    synthetic["required"] = json!(["format"]);
    let mut folder = described(&DataOpen::default());
    folder["required"] = json!(["format", "path"]);
    properties["dataset"] = json!({
        "description": "The clips: a `data.synthetic` or a `data.open` stage called `dataset`.",
        "anyOf": [synthetic, folder],
    });
    properties["text"] = described(&TextEmbed::default());
    properties["stages"] = json!({
        "description": "The stages, by name.",
        "type": "object",
        "minProperties": 1,
        "propertyNames": {"pattern": "^[a-z][a-z0-9_-]{0,63}$"},
        "additionalProperties": {
            "type": "object",
            "properties": {"kind": {"description": "The kind of the stage.", "enum": kinds}},
            "required": ["kind"],
            "allOf": cases,
        },
    });
    top["required"] = json!(["name", "stages"]);
    top["$schema"] = "https://json-schema.org/draft/2020-12/schema".into();
    top["title"] = "Stride pipeline".into();
    top["$defs"] = definitions.into();
    top
}

/// Schema of the keys of every stage: its placement and the number of its copies.
fn schema_of_every_stage() -> Value {
    let schema = Placement::json_schema(&mut generator()).to_value();
    let mut schema = described_as(schema, &Placement::example());
    schema["properties"][copies::KEY] = json!({
        "description": copies::MEANING,
        "type": "integer",
        "minimum": 1,
        "maximum": limits::SEEDS,
        "default": 1,
    });
    schema
}

/// Schema of a stage of this kind.
fn stage(settings: &StageSettings) -> Value {
    let mut schema = described_kind(settings);
    let every = schema_of_every_stage();
    let properties = &mut schema["properties"];
    properties["kind"] = json!({"const": settings.kind()});
    for (key, value) in every["properties"].as_object().into_iter().flatten() {
        properties[key] = value.clone();
    }
    if settings.training().is_some() {
        properties["sweep"] = sweep::described();
    }
    schema["required"] = json!(["kind"]);
    schema
}

/// Schema of a kind's settings, with the targets of its references.
fn described_kind(settings: &StageSettings) -> Value {
    let mut schema = described_as(settings.schema(&mut generator()).to_value(), &settings.example());
    for (field, target) in references(settings) {
        let key = field.split_once('[').map_or(&*field, |(list, _)| list);
        let lead = match target {
            Target::Stage(kind) => {
                let or = if kind.is_of_models() && settings.shape() != Shape::Registry { " or a version" } else { "" };
                format!("{} stage{or} that outputs {}", if key == field { "A" } else { "Each a" }, kind.noun())
            }
            Target::Dataset(_) | Target::Folder => "A folder".to_owned(),
            Target::File => "A file".to_owned(),
        };
        let inner = key.split('.').fold(&mut schema, |schema, part| &mut schema["properties"][part]);
        inner["x-refers-to"] = lead.into();
    }
    schema
}

/// References of a kind. A list that is empty by default is treated as having one entry.
fn references(settings: &StageSettings) -> BTreeMap<String, Target> {
    let mut json = settings.example();
    for value in json.as_object_mut().into_iter().flat_map(Map::values_mut) {
        if value.as_array().is_some_and(Vec::is_empty) {
            *value = json!(["x"]);
        }
    }
    // A list of numbers does not accept a text, so it has no references.
    let mut probe = serde_json::from_value(json).unwrap_or_else(|_| settings.clone());
    probe.refs().into_iter().map(|reference| (reference.field.into_owned(), reference.target)).collect()
}

/// Reference of all kinds and keys, `docs/pipeline.md`.
pub fn markdown() -> String {
    let mut text = String::from(
        "# Stage kinds and their keys\n\nGenerated from the code: `trainer schema --markdown`. `trainer schema` prints \
         the same as JSON Schema, for editors that check YAML.\n\nA pipeline has the keys `name`, `seed`, `backend`, `priority`, \
         `dataset` (a `data.synthetic` or `data.open` stage with this name), `text` (a\n`text.embed` stage) and \
         `stages`, a mapping from names to stages. A stage has a `kind`, the keys of its kind, and, where they \
         apply,\nthe keys of every stage. An unknown key is an error.\n\n",
    );
    let all = StageSettings::all();
    for settings in &all {
        let _ = writeln!(text, "- [`{0}`](#{1})", settings.kind(), settings.kind().replace('.', ""));
    }
    let _ = writeln!(
        text,
        "\n## Every stage\n\nAll keys but `seeds` only say where and how a stage is computed; they cannot change its value.\n"
    );
    table(&mut text, &schema_of_every_stage());
    let _ = writeln!(text, "\nA training stage may have a hyperparameter search, `sweep`:\n");
    table(&mut text, &sweep::described());
    for settings in &all {
        let schema = described_kind(settings);
        let kind = settings.kind();
        let output = settings.output();
        let runs = match settings.shape() {
            Shape::Gang => "trained by a gang of workers",
            Shape::Map => "split into shards over workers",
            Shape::Plain => "run by one worker",
            Shape::Registry => "run by the coordinator",
        };
        let _ = writeln!(text, "\n## {kind}\n\n{}\n", sentence(&schema));
        let version = settings.code_version();
        // The output of `import.model` is described at its parts.
        let gives = match settings.get::<ImportModel>() {
            Some(_) => "the artifact that `part` names".to_owned(),
            None => format!("{} (`{}`)", output.kind.noun(), output.name),
        };
        let _ = writeln!(text, "Outputs {gives}; {runs}; code version {version}.\n");
        table(&mut text, &schema);
    }
    text
}

fn sentence(schema: &Value) -> &str {
    schema["description"].as_str().unwrap_or_default()
}

fn table(text: &mut String, schema: &Value) {
    text.push_str("| key | default | is | meaning |\n|---|---|---|---|\n");
    rows(text, schema, "");
}

fn rows(text: &mut String, schema: &Value, path: &str) {
    for (key, property) in schema["properties"].as_object().into_iter().flatten() {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        if property.get("properties").is_some() {
            if property.get("default").is_some() {
                let _ = writeln!(
                    text,
                    "| `{path}` |  | mapping, or left out | {} |",
                    sentence(property).replace('|', "\\|")
                );
            }
            rows(text, property, &path);
            continue;
        }
        let cell = |text: String| text.replace('|', "\\|");
        let default = match &property["default"] {
            Value::Null => String::new(),
            Value::String(text) if text.is_empty() => String::new(),
            Value::String(text) => format!("`{text}`"),
            other => format!("`{other}`"),
        };
        let words = property["oneOf"].as_array().into_iter().flatten();
        let words: String = words
            .filter_map(|word| Some(format!(" `{}`: {}", word["const"].as_str()?, word["description"].as_str()?)))
            .collect();
        let meaning = cell(format!("{}{words}", sentence(property)));
        let _ = writeln!(text, "| `{path}` | {} | {} | {meaning} |", cell(default), cell(kind_of_value(property)));
    }
}

/// Type and range of a value, in words.
fn kind_of_value(property: &Value) -> String {
    if let Some(lead) = property["x-refers-to"].as_str() {
        return lead[..1].to_lowercase() + &lead[1..];
    }
    let optional = property["type"] == json!(["integer", "null"]);
    let whole = optional || property["type"] == "integer" || property["x-unit"] == "steps";
    let words: Vec<&str> = match (&property["oneOf"], &property["enum"]) {
        (Value::Array(words), _) => words.iter().filter_map(|word| word["const"].as_str()).collect(),
        (_, Value::Array(words)) => words.iter().filter_map(Value::as_str).collect(),
        _ => Vec::new(),
    };
    let base = match (&property["type"], property.get("prefixItems")) {
        _ if !words.is_empty() => words.iter().map(|word| format!("`{word}`")).collect::<Vec<_>>().join(", "),
        _ if optional => "whole number or null".to_owned(),
        _ if whole => "whole number".to_owned(),
        (Value::String(word), _) if word == "number" => "number".to_owned(),
        (Value::String(word), _) if word == "boolean" => "`true` or `false`".to_owned(),
        (Value::String(word), _) if word == "string" => "string".to_owned(),
        (_, Some(_)) => "two numbers".to_owned(),
        (Value::String(word), _) if word == "array" => "list of numbers".to_owned(),
        (Value::Array(_), _) => "list of strings".to_owned(),
        _ => "mapping".to_owned(),
    };
    let list = [&property["items"], &property["prefixItems"][0]];
    let number = |key: &str| std::iter::once(property).chain(list).find_map(|schema| schema[key].as_f64());
    let range = match (number("minimum"), number("exclusiveMinimum"), number("maximum"), number("exclusiveMaximum")) {
        (Some(low), _, Some(high), _) => format!(", {low} to {high}"),
        (Some(low), _, _, Some(high)) => format!(", {low} to below {high}"),
        (_, Some(low), Some(high), _) => format!(", above {low}, at most {high}"),
        (_, Some(low), _, Some(high)) => format!(", above {low} and below {high}"),
        (_, Some(low), _, _) => format!(", above {low}"),
        (Some(low), _, _, _) if low > 0.0 || !whole => format!(", at least {low}"),
        _ => String::new(),
    };
    let unit = property["x-unit"].as_str().map(|unit| format!(", {unit}")).unwrap_or_default();
    format!("{base}{range}{unit}")
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::yaml;

    fn in_repository(path: &str) -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
    }

    /// `UPDATE_DOCS=1` writes the file.
    #[test]
    fn the_reference_of_kinds_and_keys_is_current() {
        let path = in_repository("docs/pipeline.md");
        let expected = markdown();
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(&path, &expected).unwrap();
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(
            found == expected,
            "docs/pipeline.md is not what the code says; write it with `UPDATE_DOCS=1 cargo test -p pipeline reference`"
        );
    }

    #[test]
    fn every_key_has_a_type_and_a_meaning() {
        fn walk(path: &str, schema: &Value, missing: &mut Vec<String>) {
            for (key, property) in schema["properties"].as_object().into_iter().flatten() {
                let path = format!("{path}.{key}");
                let typed =
                    ["type", "oneOf", "enum", "const", "properties"].iter().any(|word| property.get(word).is_some());
                if !typed || (sentence(property).is_empty() && property.get("const").is_none()) {
                    missing.push(path.clone());
                }
                walk(&path, property, missing);
            }
        }
        let mut missing = Vec::new();
        for settings in StageSettings::all() {
            walk(settings.kind(), &stage(&settings), &mut missing);
        }
        assert!(missing.is_empty(), "{missing:?}");
    }

    /// Validates a value by the part of JSON Schema that ours uses.
    fn fits(schema: &Value, value: &Value, root: &Value) -> Result<(), String> {
        let wrong = |what: &str| Err(format!("{value} is not {what} of {schema}"));
        if let Some(reference) = schema["$ref"].as_str() {
            let name = reference.strip_prefix("#/$defs/").expect("a definition");
            return fits(&root["$defs"][name], value, root);
        }
        let is = |word: &Value| match word.as_str() {
            Some("object") => value.is_object(),
            Some("array") => value.is_array(),
            Some("string") => value.is_string(),
            Some("integer") => value.is_u64() || value.is_i64(),
            Some("number") => value.is_number(),
            Some("boolean") => value.is_boolean(),
            other => panic!("no type {other:?}"),
        };
        match &schema["type"] {
            Value::Null => {}
            Value::Array(words) if words.iter().any(is) => {}
            word @ Value::String(_) if is(word) => {}
            _ => return wrong("the type"),
        }
        if schema.get("const").is_some_and(|only| only != value) {
            return wrong("the value");
        }
        if schema["enum"].as_array().is_some_and(|words| !words.contains(value)) {
            return wrong("a word");
        }
        for any in ["anyOf", "oneOf"] {
            if let Some(all) = schema[any].as_array()
                && !all.iter().any(|schema| fits(schema, value, root).is_ok())
            {
                return wrong(any);
            }
        }
        if schema.get("if").is_some_and(|condition| fits(condition, value, root).is_ok()) {
            fits(&schema["then"], value, root)?;
        }
        for schema in schema["allOf"].as_array().into_iter().flatten() {
            fits(schema, value, root)?;
        }
        for required in schema["required"].as_array().into_iter().flatten() {
            if value.get(required.as_str().expect("a key")).is_none() {
                return wrong(&format!("complete without {required}, a part"));
            }
        }
        for (key, value) in value.as_object().into_iter().flatten() {
            match (schema["properties"].get(key), &schema["additionalProperties"]) {
                (Some(property), _) => fits(property, value, root)?,
                (None, Value::Bool(false)) => return Err(format!("`{key}` is not a key of {schema}")),
                (None, Value::Null | Value::Bool(_)) => {}
                (None, property) => fits(property, value, root)?,
            }
        }
        for item in value.as_array().into_iter().flatten().filter(|_| schema.get("items").is_some()) {
            fits(&schema["items"], item, root)?;
        }
        Ok(())
    }

    #[test]
    fn shipped_pipelines_fit_the_schema_and_a_misspelt_key_does_not() {
        let schema = json_schema();
        let mut seen = 0;
        for entry in std::fs::read_dir(in_repository("configs")).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_none_or(|extension| extension != "yaml") {
                continue;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let value = yaml::parse(&text, 0, &mut yaml::Budget::default()).unwrap().to_json().unwrap();
            fits(&schema, &value, &schema).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
            for (name, stage) in value["stages"].as_object().unwrap() {
                for (key, wrong) in
                    [("kind", json!("train.vea")), ("lernrate", json!(1)), ("workers", json!({"mni": 1}))]
                {
                    let mut broken = value.clone();
                    broken["stages"][name.as_str()][key] = wrong;
                    assert!(fits(&schema, &broken, &schema).is_err(), "{name} {stage} with {key}");
                }
            }
            seen += 1;
        }
        assert!(seen >= 7, "{seen}");
    }
}
