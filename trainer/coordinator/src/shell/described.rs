//! Types of a call's query, body and answer, from which [`openapi`](super::openapi) makes the schemas.

use axum::Json;
use schemars::{JsonSchema, SchemaGenerator};
use serde_json::{Value, json};

use super::extract::Query;

/// A body by its media types.
pub(super) trait Content {
    /// The schema of each media type; `None` if there is no body.
    fn content(generator: &mut SchemaGenerator) -> Option<Value>;
}

/// No query or no body.
pub(super) enum Nothing {}
/// Bytes of any kind.
pub(super) enum Bytes {}
/// The texts that Prometheus reads.
pub(super) enum Exposition {}
/// Events as a browser's `EventSource` reads them.
pub(super) enum EventStream {}
/// JSON, or the packed form that `Accept: application/octet-stream` asks for.
pub(super) struct Packed<T>(std::marker::PhantomData<T>);

impl Content for Nothing {
    fn content(_: &mut SchemaGenerator) -> Option<Value> {
        None
    }
}

impl<T: JsonSchema> Content for Json<T> {
    fn content(generator: &mut SchemaGenerator) -> Option<Value> {
        Some(json!({"application/json": {"schema": generator.subschema_for::<T>()}}))
    }
}

impl Content for Bytes {
    fn content(_: &mut SchemaGenerator) -> Option<Value> {
        Some(json!({"application/octet-stream": {}}))
    }
}

impl Content for Exposition {
    fn content(_: &mut SchemaGenerator) -> Option<Value> {
        let text = json!({"schema": {"type": "string"}});
        Some(json!({"text/plain": text, "application/openmetrics-text": text}))
    }
}

impl Content for EventStream {
    fn content(_: &mut SchemaGenerator) -> Option<Value> {
        Some(json!({"text/event-stream": {"schema": {"type": "string"}}}))
    }
}

impl<T: JsonSchema> Content for Packed<T> {
    fn content(generator: &mut SchemaGenerator) -> Option<Value> {
        let mut content = Json::<T>::content(generator)?;
        content["application/octet-stream"] = json!({});
        Some(content)
    }
}

/// A query by its parameters.
pub(super) trait Parameters {
    /// The parameters as OpenAPI writes them.
    fn parameters(generator: &mut SchemaGenerator) -> Vec<Value>;
}

impl Parameters for Nothing {
    fn parameters(_: &mut SchemaGenerator) -> Vec<Value> {
        Vec::new()
    }
}

impl<T: JsonSchema> Parameters for Query<T> {
    fn parameters(generator: &mut SchemaGenerator) -> Vec<Value> {
        let schema = Value::from(T::json_schema(generator));
        let required: Vec<&Value> = schema["required"].as_array().into_iter().flatten().collect();
        let fields = schema["properties"].as_object().into_iter().flatten();
        fields.map(|(name, field)| parameter(name, field.clone(), required.iter().any(|one| *one == name))).collect()
    }
}

fn parameter(name: &str, mut schema: Value, required: bool) -> Value {
    let mut parameter = json!({"name": name, "in": "query", "required": required});
    if let Some(fields) = schema.as_object_mut() {
        if let Some(says) = fields.remove("description") {
            parameter["description"] = says;
        }
        // A query has no null: what is not given is missing.
        if let Some(Value::Array(kinds)) = fields.get_mut("type") {
            kinds.retain(|kind| kind != "null");
            if let [kind] = kinds.as_slice() {
                let kind = kind.clone();
                fields.insert("type".to_owned(), kind);
            }
        }
        if let Some(Value::Array(options)) = fields.get("anyOf") {
            let option = options.iter().find(|option| option["type"] != "null").cloned();
            if let Some(option) = option {
                schema = option;
            }
        }
    }
    parameter["schema"] = schema;
    parameter
}

/// The description of a call.
#[derive(Clone, Copy)]
pub(super) struct Described {
    /// Effect of the call, in a sentence.
    pub(super) says: &'static str,
    /// Headers that it reads: name, whether it must be there, description.
    pub(super) headers: &'static [(&'static str, bool, &'static str)],
    pub(super) query: fn(&mut SchemaGenerator) -> Vec<Value>,
    pub(super) body: fn(&mut SchemaGenerator) -> Option<Value>,
    pub(super) answer: fn(&mut SchemaGenerator) -> Option<Value>,
}

impl Described {
    /// The same call, which also reads headers.
    pub(super) fn with(self, headers: &'static [(&'static str, bool, &'static str)]) -> Self {
        Self { headers, ..self }
    }
}

/// Describes a call with query `Q` and body `B`, which is answered with `A`.
pub(super) fn described<Q: Parameters, B: Content, A: Content>(says: &'static str) -> Described {
    Described { says, headers: &[], query: Q::parameters, body: B::content, answer: A::content }
}
