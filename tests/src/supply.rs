//! Dependencies of the workspace, from `cargo metadata` without a network.

use std::collections::BTreeSet;
use std::process::Command;

use serde_json::Value;

use crate::Bench;

/// Runs `cargo metadata` for this machine's platform; crates of other platforms may not have been fetched.
pub fn metadata() -> Value {
    let version = Command::new("rustc").arg("-vV").output().expect("rustc -vV runs");
    let version = String::from_utf8_lossy(&version.stdout).into_owned();
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).expect("rustc names its host");
    let json = cargo(&["metadata", "--format-version", "1", "--filter-platform", host]);
    serde_json::from_slice(&json).expect("JSON")
}

/// Names and versions of the packages that a build of this package with its default features compiles.
pub fn built(package: &str) -> BTreeSet<String> {
    let tree = cargo(&["tree", "--package", package, "--edges", "normal,build", "--prefix", "none"]);
    let tree = String::from_utf8_lossy(&tree);
    tree.lines().filter_map(|line| line.split(" (").next()).map(str::to_owned).collect()
}

/// Returns what `cargo` prints, without a network.
fn cargo(args: &[&str]) -> Vec<u8> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned());
    let output = Command::new(cargo)
        .args(args)
        .args(["--locked", "--offline"])
        .current_dir(Bench::repository())
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Returns true if the licences that `is_allowed` accepts satisfy an SPDX expression. A slash is the old form of `OR`.
pub fn is_licensed(expression: &str, is_allowed: &dyn Fn(&str) -> bool) -> bool {
    let spaced = expression.replace('/', " OR ").replace('(', " ( ").replace(')', " ) ");
    let words: Vec<&str> = spaced.split_whitespace().collect();
    let mut at = 0;
    let met = any(&words, &mut at, is_allowed);
    met && at == words.len()
}

fn any(words: &[&str], at: &mut usize, is_allowed: &dyn Fn(&str) -> bool) -> bool {
    let mut met = all(words, at, is_allowed);
    while words.get(*at) == Some(&"OR") {
        *at += 1;
        met |= all(words, at, is_allowed);
    }
    met
}

fn all(words: &[&str], at: &mut usize, is_allowed: &dyn Fn(&str) -> bool) -> bool {
    let mut met = one(words, at, is_allowed);
    while words.get(*at) == Some(&"AND") {
        *at += 1;
        met &= one(words, at, is_allowed);
    }
    met
}

fn one(words: &[&str], at: &mut usize, is_allowed: &dyn Fn(&str) -> bool) -> bool {
    let Some(word) = words.get(*at) else { return false };
    *at += 1;
    if *word == "(" {
        let met = any(words, at, is_allowed);
        *at += 1;
        return met;
    }
    if words.get(*at) == Some(&"WITH") {
        let with = words.get(*at + 1).map(|exception| format!("{word} WITH {exception}"));
        *at += 2;
        return with.is_some_and(|licence| is_allowed(&licence));
    }
    is_allowed(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_expression_is_met_by_one_of_its_alternatives() {
        let is_allowed = |licence: &str| matches!(licence, "MIT" | "ISC" | "Apache-2.0 WITH LLVM-exception");
        for (expression, expected) in [
            ("MIT", true),
            ("GPL-3.0", false),
            ("GPL-3.0 OR MIT", true),
            ("GPL-3.0/MIT", true),
            ("MIT AND GPL-3.0", false),
            ("MIT AND ISC", true),
            ("(GPL-3.0 OR ISC) AND MIT", true),
            ("Apache-2.0 WITH LLVM-exception OR GPL-3.0", true),
            ("Apache-2.0 WITH Classpath", false),
            ("Apache-2.0", false),
            ("", false),
            ("MIT MIT", false),
        ] {
            assert_eq!(is_licensed(expression, &is_allowed), expected, "{expression}");
        }
    }
}
