//! The document of OpenAPI 3.1 that describes all calls, made from the table of calls.

use std::collections::BTreeMap;

use protocol::message::Problem;
use schemars::SchemaGenerator;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::described::Described;
use super::route::Route;

/// The place of types' schemas in the document.
const SCHEMAS: &str = "/components/schemas";

/// Makes the document of calls that need a token, and of `open` calls, which need none.
pub(super) fn document(calls: &[(Route, Described)], open: &[(&str, Described)]) -> Value {
    let settings = SchemaSettings::draft2020_12().with(|settings| settings.definitions_path = SCHEMAS.into());
    let mut generator = settings.into_generator();
    let problem = json!({(Problem::CONTENT_TYPE): {"schema": generator.subschema_for::<Problem>()}});
    let mut paths: BTreeMap<&str, Map<String, Value>> = BTreeMap::new();
    for (route, described) in calls {
        let scopes: Vec<Value> = route.scopes.iter().map(|scope| json!({"token": [scope.name()]})).collect();
        let mut call = operation(route.method, route.path, described, &mut generator);
        call["security"] = json!(scopes);
        call["x-time-limit-s"] = json!(route.time.as_secs());
        call["x-body-limit-bytes"] = json!(route.body);
        paths.entry(route.path).or_default().insert(route.method.to_lowercase(), call);
    }
    for (path, described) in open {
        let mut call = operation("GET", path, described, &mut generator);
        call["security"] = json!([]);
        paths.entry(*path).or_default().insert("get".to_owned(), call);
    }
    for call in paths.values_mut().flat_map(|path| path.values_mut()) {
        for status in ["4XX", "5XX"] {
            let description = if status == "4XX" { "The call is refused." } else { "The server cannot do it now." };
            call["responses"][status] = json!({"description": description, "content": problem});
        }
    }
    let schemas: BTreeMap<String, Value> = generator.take_definitions(true).into_iter().collect();
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "Stride",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "Calls of a Stride server. A refusal is a problem of RFC 9457 with a `code` and a `hint`.",
            "license": {"name": "MIT OR Apache-2.0", "identifier": "MIT OR Apache-2.0"},
        },
        "paths": paths,
        "components": {
            "schemas": schemas,
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "A token with one of the scopes that the call names.",
                },
            },
        },
    })
}

fn operation(method: &str, path: &str, described: &Described, generator: &mut SchemaGenerator) -> Value {
    let mut parameters: Vec<Value> = names(path)
        .map(|name| json!({"name": name, "in": "path", "required": true, "schema": {"type": "string", "minLength": 1}}))
        .collect();
    parameters.extend((described.query)(generator));
    parameters.extend(described.headers.iter().map(|(name, required, says)| {
        json!({"name": name, "in": "header", "required": required, "description": says, "schema": {"type": "string"}})
    }));
    let mut call = json!({
        "operationId": id(method, path),
        "summary": described.says,
        "responses": {"200": {"description": "The call is done."}},
    });
    if !parameters.is_empty() {
        call["parameters"] = json!(parameters);
    }
    if let Some(content) = (described.body)(generator) {
        call["requestBody"] = json!({"required": true, "content": content});
    }
    if let Some(content) = (described.answer)(generator) {
        call["responses"]["200"]["content"] = content;
    }
    call
}

/// The parameters of a path.
fn names(path: &str) -> impl Iterator<Item = &str> {
    path.split('/').filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'))
}

/// A name of the call for programs, such as `get_run_logs`.
fn id(method: &str, path: &str) -> String {
    let path = path.strip_prefix("/v1").map_or_else(|| format!("/server{path}"), str::to_owned);
    let parts = path.trim_start_matches('/').split('/');
    let words: Vec<String> = parts.map(|part| part.replace(['{', '}'], "").replace(['.', '-'], "_")).collect();
    format!("{}_{}", method.to_lowercase(), words.join("_"))
}
