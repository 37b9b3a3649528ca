//! Dependencies are licensed, come from crates.io and are not banned: checks `deny.toml` without a network or another
//! tool.

use std::collections::BTreeSet;
use std::fs;
use std::process::Command;

use cluster_tests::{Bench, supply};
use serde_json::Value;

/// Largest number of packages in a build of the trainer. Each costs time in every build and may bring faults (decision
/// 0033).
const MOST_PACKAGES: usize = 430;

/// The texts of `key = [...]` in `deny.toml`, or of a field of its tables.
fn listed<'a>(deny: &'a str, begin: &str, before: &str) -> BTreeSet<&'a str> {
    let list = deny.split_once(begin).and_then(|(_, rest)| rest.split_once("\n]")).expect("deny.toml has the list").0;
    let entry = |line: &'a str| line.split_once(before)?.1.split_once('"').map(|(name, _)| name);
    list.lines().filter_map(entry).collect()
}

#[test]
fn every_crate_is_allowed() {
    let deny = fs::read_to_string(Bench::repository().join("deny.toml")).expect("deny.toml is there");
    let allowed = listed(&deny, "allow = [", "\"");
    let banned = listed(&deny, "deny = [", "crate = \"");
    assert!(allowed.contains("MIT") && banned.contains("openssl-sys"), "{allowed:?} {banned:?}");
    let clarified =
        |name: &str| deny.contains(&format!("[[licenses.clarify]]\ncrate = \"{name}\"\nexpression = \"Apache-2.0\""));
    let metadata = supply::metadata();
    let packages = metadata["packages"].as_array().expect("packages");
    let (mut wrong, mut foreign) = (Vec::new(), 0);
    for package in packages.iter().filter(|package| !package["source"].is_null()) {
        let name = package["name"].as_str().expect("a name");
        foreign += 1;
        if package["source"] != "registry+https://github.com/rust-lang/crates.io-index" {
            wrong.push(format!("{name} comes from {}", package["source"]));
        }
        match package["license"].as_str() {
            Some(licence) if supply::is_licensed(licence, &|licence| allowed.contains(licence)) => {}
            None if clarified(name) => {}
            licence => wrong.push(format!("{name} is licensed as {licence:?}")),
        }
        if banned.contains(name) {
            wrong.push(format!("{name} is banned"));
        }
    }
    assert!(foreign > 300 && wrong.is_empty(), "of {foreign} crates: {wrong:#?}");
}

#[test]
fn a_build_of_the_trainer_needs_few_packages() {
    let packages = supply::built("trainer");
    let has =
        |package: &str| packages.iter().any(|name| name.strip_prefix(package).is_some_and(|v| v.starts_with(" v")));
    assert!(has("burn-flex") && !has("s3s"), "not a list of what is built: {packages:?}");
    let many = packages.len();
    assert!(
        many <= MOST_PACKAGES,
        "{many} packages are built, expected {MOST_PACKAGES} at most; `cargo tree -e normal,build` shows what needs \
         them, and `cargo update -p idna_adapter --precise 1.1.0` saves twenty if an update brought icu_*"
    );
}

#[test]
fn the_bill_of_materials_has_every_crate_with_its_checksum() {
    let said = Command::new(env!("CARGO_BIN_EXE_sbom")).output().expect("it runs");
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let bom: Value = serde_json::from_slice(&said.stdout).expect("JSON");
    let components = bom["components"].as_array().expect("components");
    let metadata = supply::metadata();
    assert_eq!(Some(components.len()), metadata["packages"].as_array().map(Vec::len));
    let rustls = components.iter().find(|component| component["name"] == "rustls").expect("rustls");
    assert_eq!(rustls["hashes"][0]["content"].as_str().map(str::len), Some(64), "{rustls}");
    assert_eq!(rustls["purl"], format!("pkg:cargo/rustls@{}", rustls["version"].as_str().expect("a version")));
}
