//! The document of all calls: complete, whole, and as committed in `docs/openapi.json`.

use std::collections::BTreeSet;
use std::path::Path;

use coordinator::shell::{openapi, routes};
use serde_json::Value;

#[test]
fn every_call_is_described_with_its_scopes() {
    let document = openapi();
    for route in routes() {
        let call = &document["paths"][route.path][route.method.to_lowercase()];
        assert!(call["summary"].is_string(), "{} {}", route.method, route.path);
        let scopes = call["security"].as_array().into_iter().flatten().map(|one| one["token"][0].as_str());
        assert!(scopes.eq(route.scopes.iter().map(|scope| Some(scope.name()))), "{} {}", route.method, route.path);
        assert_eq!(call["requestBody"].is_null(), route.method == "GET" || call["requestBody"].is_null());
        for status in ["4XX", "5XX"] {
            let problem = &call["responses"][status]["content"]["application/problem+json"]["schema"]["$ref"];
            assert_eq!(problem, "#/components/schemas/Problem", "{} {}", route.method, route.path);
        }
    }
    let mut ids = BTreeSet::new();
    let calls = document["paths"].as_object().into_iter().flatten().flat_map(|(_, path)| path.as_object()).flatten();
    for (_, call) in calls {
        assert!(ids.insert(call["operationId"].to_string()), "{} is there twice", call["operationId"]);
    }
}

/// Calls `see` with each reference in a document.
fn references<'a>(value: &'a Value, see: &mut impl FnMut(&'a str)) {
    match value {
        Value::Object(fields) => fields.iter().for_each(|(name, field)| match field.as_str() {
            Some(target) if name == "$ref" => see(target),
            _ => references(field, see),
        }),
        Value::Array(items) => items.iter().for_each(|item| references(item, see)),
        _ => {}
    }
}

#[test]
fn every_reference_leads_somewhere() {
    let document = openapi();
    let mut count = 0;
    references(&document, &mut |target| {
        count += 1;
        let found = target.strip_prefix('#').and_then(|pointer| document.pointer(pointer));
        assert!(found.is_some(), "{target}");
    });
    assert!(count > 100, "{count}");
}

#[test]
fn the_committed_document_is_that_of_this_build() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/openapi.json");
    let text = format!("{:#}\n", openapi());
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(committed == text, "run `UPDATE_DOCS=1 cargo test -p coordinator --test server openapi`");
}
