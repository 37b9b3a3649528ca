//! Every selection of packages compiles third-party crates with the same features: `cargo test -p X` after `cargo test`
//! does not compile Burn again.

use std::collections::BTreeSet;
use std::process::Command;

use serde_json::Value;

/// Runs cargo on the workspace and returns its output.
fn cargo(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO"))
        .args(arguments)
        .args(["--locked", "--offline"])
        .current_dir(cluster_tests::Bench::repository())
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// Every third-party crate with its features, for a selection of packages and their tests.
fn features(selection: &[&str]) -> BTreeSet<String> {
    let how = ["--edges", "normal,build,dev", "--prefix", "none", "--format", "{p}|{f}"];
    let tree = cargo(&[&["tree"], selection, &how].concat());
    // Our own packages have their path behind the version.
    let third_parties = tree.lines().filter(|line| line.contains('|') && !line.contains(" (/"));
    // A star marks a crate whose dependencies were listed before. Listing them again takes minutes.
    third_parties.map(|line| line.replace(" (proc-macro)", "").trim_end_matches(" (*)").to_owned()).collect()
}

#[test]
fn one_selection_compiles_what_all_do() {
    let metadata: Value =
        serde_json::from_str(&cargo(&["metadata", "--format-version", "1", "--no-deps"])).expect("JSON");
    let all = features(&["--workspace"]);
    for package in metadata["packages"].as_array().expect("packages") {
        let name = package["name"].as_str().expect("a name");
        let others: Vec<_> = features(&["-p", name]).difference(&all).cloned().collect();
        assert!(
            others.is_empty() || name == "feature-set",
            "`cargo test -p {name}` compiles these anew; add what the whole workspace has to tests/features/Cargo.toml: {others:#?}"
        );
    }
}
