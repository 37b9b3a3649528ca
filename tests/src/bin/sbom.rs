//! Prints a software bill of materials in CycloneDX's JSON. It lists every crate that the binaries of this workspace
//! may use on this machine's platform, with version, licence and checksum. `cargo metadata` and `Cargo.lock` provide
//! all data; nothing is fetched.
#![allow(clippy::print_stdout, reason = "what it is for")]

use std::collections::BTreeMap;

use cluster_tests::{Bench, supply};
use serde_json::{Value, json};

fn main() {
    let lock = std::fs::read_to_string(Bench::repository().join("Cargo.lock")).expect("Cargo.lock is there");
    let checksums = checksums(&lock);
    let component = |package: &Value| {
        let (name, version) = (text(&package["name"]), text(&package["version"]));
        let mut component = json!({
            "type": "library", "name": name, "version": version,
            "bom-ref": format!("{name}@{version}"), "purl": format!("pkg:cargo/{name}@{version}"),
        });
        if let Some(licence) = package["license"].as_str() {
            component["licenses"] = json!([{"expression": licence.replace('/', " OR ")}]);
        }
        if let Some(checksum) = checksums.get(&(name, version)) {
            component["hashes"] = json!([{"alg": "SHA-256", "content": checksum}]);
        }
        component
    };
    let metadata = supply::metadata();
    let components: Vec<Value> = metadata["packages"].as_array().into_iter().flatten().map(component).collect();
    let bom = json!({
        "bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
        "metadata": {"component": {"type": "application", "name": "stride", "version": env!("CARGO_PKG_VERSION")}},
        "components": components,
    });
    println!("{bom:#}");
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}

/// The checksums of `Cargo.lock` by name and version.
fn checksums(lock: &str) -> BTreeMap<(String, String), String> {
    let value = |block: &str, key: &str| {
        let line = block.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(" = \""))?;
        Some(line.trim_end_matches('"').to_owned())
    };
    let package = |block: &str| Some(((value(block, "name")?, value(block, "version")?), value(block, "checksum")?));
    lock.split("[[package]]").filter_map(package).collect()
}
