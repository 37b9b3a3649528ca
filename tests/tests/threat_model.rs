//! Each row of `docs/threat-model.md` names its tests, and these tests exist.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use cluster_tests::Bench;

/// Adds the names of all functions in the Rust files below `folder`.
fn functions(folder: &Path, found: &mut BTreeSet<String>) {
    for entry in fs::read_dir(folder).expect("a folder of ours").flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        if path.is_dir() {
            if name != "target" && !name.to_string_lossy().starts_with('.') {
                functions(&path, found);
            }
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).expect("UTF-8");
            let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
            for (at, _) in text.match_indices("fn ") {
                let rest = &text[at + 3..];
                found.insert(rest[..rest.find(|c| !is_name(c)).unwrap_or(rest.len())].to_owned());
            }
        }
    }
}

/// The texts between backquotes.
fn quoted(cell: &str) -> impl Iterator<Item = &str> {
    cell.split('`').skip(1).step_by(2)
}

#[test]
fn every_line_of_the_threat_model_has_a_test() {
    let root = Bench::repository();
    let text = fs::read_to_string(root.join("docs/threat-model.md")).expect("the threat model");
    let mut known = BTreeSet::new();
    functions(&root, &mut known);
    let is_known = |name: &str| match name.strip_suffix('*') {
        Some(begin) => known.iter().any(|known| known.starts_with(begin)),
        None => known.contains(name),
    };
    let rows: Vec<&str> = text.lines().filter(|line| line.starts_with("| ")).collect();
    // The first row of each table is its header.
    let rows = rows.iter().filter(|row| !row.ends_with("| test |"));
    let mut wrong = Vec::new();
    let mut count = 0;
    for row in rows {
        count += 1;
        let cell = row.trim_end_matches(['|', ' ']).rsplit("| ").next().unwrap_or_default();
        // Names of crates and of groups of tests are single words.
        let tests: Vec<&str> = quoted(cell).filter(|name| name.contains('_')).collect();
        let missing: Vec<&&str> = tests.iter().filter(|name| !is_known(name)).collect();
        if tests.is_empty() || !missing.is_empty() {
            wrong.push(format!("{row}\n  not found: {missing:?}"));
        }
    }
    assert!(count > 50 && wrong.is_empty(), "of {count} rows:\n{}", wrong.join("\n"));
}
