//! Dependencies point one way: the control plane builds without Burn, the training library without a database, and no
//! two files of a crate import each other.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use cluster_tests::{Bench, imports};
use serde_json::Value;

/// Runs `cargo metadata` on the workspace.
fn metadata(options: &[&str]) -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version", "1", "--locked", "--offline"])
        .args(options)
        .current_dir(Bench::repository())
        .output()
        .expect("cargo metadata runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn closure(metadata: &Value) -> BTreeMap<String, BTreeSet<String>> {
    let nodes = metadata["resolve"]["nodes"].as_array().expect("nodes");
    let name_of: BTreeMap<&str, &str> = metadata["packages"]
        .as_array()
        .expect("packages")
        .iter()
        .map(|p| (p["id"].as_str().expect("id"), p["name"].as_str().expect("name")))
        .collect();
    let direct: BTreeMap<&str, Vec<&str>> = nodes
        .iter()
        .map(|node| {
            let needed = node["deps"].as_array().expect("deps").iter().filter(|dep| {
                dep["dep_kinds"].as_array().expect("dep_kinds").iter().any(|kind| kind["kind"].is_null())
            });
            (node["id"].as_str().expect("id"), needed.map(|dep| dep["pkg"].as_str().expect("pkg")).collect())
        })
        .collect();
    let mut all = BTreeMap::new();
    for id in direct.keys() {
        let mut seen = BTreeSet::new();
        let mut next = vec![*id];
        while let Some(id) = next.pop() {
            for dep in &direct[id] {
                if seen.insert(name_of[dep].to_owned()) {
                    next.push(dep);
                }
            }
        }
        all.entry(name_of[id].to_owned()).or_insert_with(BTreeSet::new).extend(seen);
    }
    all
}

#[test]
fn dependencies_point_one_way() {
    // Only dependencies of this machine's platform; other platforms have more, such as an async runtime for wasm.
    let version = Command::new("rustc").arg("-vV").output().expect("rustc -vV runs");
    let version = String::from_utf8_lossy(&version.stdout).into_owned();
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).expect("rustc names its host");
    let needs = closure(&metadata(&["--filter-platform", host]));

    let never = |package: &str, forbidden: &[&str]| {
        for name in &needs[package] {
            let hit = forbidden.iter().find(|f| name == *f || name.starts_with(&format!("{f}-")));
            assert!(hit.is_none(), "`{package}` must not need `{name}`");
        }
    };
    never("protocol", &["burn", "tokio", "sqlx", "axum", "reqwest", "registry", "stages", "models", "motion"]);
    never("protocol", &["pipeline", "saphyr"]);
    never("pipeline", &["burn", "tokio", "sqlx", "axum", "reqwest", "registry", "stages", "models", "motion"]);
    never("checkpoint", &["burn", "tokio", "sqlx", "axum", "registry", "stages", "pipeline"]);
    never("registry", &["burn", "coordinator", "stages", "models", "worker"]);
    never("coordinator", &["burn", "stages", "models", "worker"]);
    never("launcher", &["burn", "stages", "models", "worker", "registry", "coordinator", "sqlx", "axum"]);
    never("page", &["burn", "tokio", "sqlx", "axum", "hyper", "registry", "coordinator", "access"]);
    never("book", &["burn", "tokio", "sqlx", "axum", "hyper", "registry", "coordinator", "pulldown-cmark"]);
    never("telemetry", &["burn", "axum", "sqlx", "coordinator", "stages", "worker", "opentelemetry"]);
    never("webhooks", &["burn", "axum", "coordinator", "stages", "worker"]);
    never("motion", &["burn", "tokio", "sqlx", "axum", "registry", "checkpoint"]);
    never("mocap", &["burn", "tokio", "sqlx", "axum", "registry", "checkpoint"]);
    never("text-models", &["burn", "tokio", "sqlx", "axum", "reqwest", "hf-hub", "onig", "registry", "checkpoint"]);
    never(
        "hub",
        &["burn", "sqlx", "axum", "hf-hub", "aws-lc", "openssl-sys", "native-tls", "ureq", "registry", "checkpoint"],
    );
    never("hostile", &["burn", "tokio", "sqlx", "axum", "reqwest"]);
    never("models", &["tokio", "sqlx", "axum", "reqwest", "registry", "checkpoint", "stages"]);
    never("stages", &["sqlx", "axum", "reqwest", "registry", "coordinator", "worker"]);
    never("worker", &["sqlx", "coordinator", "registry"]);
}

/// The code of a crate's files without their tests.
fn sources(folder: &Path) -> Vec<(PathBuf, String)> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    let found = entries.flat_map(|path| match path.is_dir() {
        true => sources(&path),
        false if path.extension().is_none_or(|end| end != "rs") => Vec::new(),
        false => {
            let text = std::fs::read_to_string(&path).expect("a source file");
            let code = text.split("#[cfg(test)]").next().unwrap_or_default().to_owned();
            vec![(path, code)]
        }
    });
    found.collect()
}

/// A stage reads files of its settings only through `stages::external`, which checks the worker's data roots and the
/// digests. Parsers open files only through `motion::DataPath`.
#[test]
fn stages_and_parsers_open_no_path_of_their_own() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let opens =
        ["File::open(", "OpenOptions", "fs::read", "fs::metadata", "read_dir(", "symlink_metadata", ".is_dir()"];
    let makes = ["DataPath::local", "Path::new(", "PathBuf::from"];
    let at = |folder: &str| sources(&root.join(folder));
    let expect_none = |folder: &str, words: &[&str], but: &[&str]| {
        let files = at(folder);
        assert!(files.len() > 3, "{folder}");
        for (path, code) in files.iter().filter(|(path, _)| !but.iter().any(|but| path.ends_with(but))) {
            // `WeightsFile::open(` opens no file of the system.
            let is_whole =
                |word: &str, at: usize| word.starts_with('.') || !code[..at].ends_with(char::is_alphanumeric);
            let found = words.iter().find(|word| code.match_indices(**word).any(|(at, _)| is_whole(word, at)));
            assert!(found.is_none(), "{}: `{}`", path.display(), found.unwrap_or(&""));
        }
    };
    expect_none("trainer/stages/src", &[&opens[..], &makes].concat(), &[]);
    expect_none("trainer/text/src", &[&opens[..], &makes[..1]].concat(), &[]);
    // Files for a user's own commands.
    expect_none("trainer/mocap/src", &opens, &["sample.rs"]);
    expect_none("trainer/motion/src", &opens, &["files.rs", "synthetic.rs"]);
    for parser in ["listing.rs", "captions.rs", "corpus.rs", "arrays.rs", "bvh.rs", "parse.rs", "take.rs"] {
        let file = at("trainer/mocap/src").into_iter().find(|(path, _)| path.ends_with(parser)).expect(parser);
        assert!(!file.1.contains("DataPath::local"), "{parser}");
    }
}

/// Root files of the libraries and programs of the workspace.
fn roots() -> Vec<PathBuf> {
    let metadata = metadata(&["--no-deps"]);
    let packages = metadata["packages"].as_array().expect("packages");
    let targets = packages.iter().flat_map(|p| p["targets"].as_array().expect("targets"));
    let roots = targets.filter(|target| target["kind"][0] == "lib" || target["kind"][0] == "bin");
    let roots: Vec<PathBuf> = roots.map(|target| target["src_path"].as_str().expect("src_path").into()).collect();
    assert!(roots.len() >= 11, "{roots:?}");
    roots
}

#[test]
fn no_files_import_each_other_in_a_loop() {
    let loops: Vec<String> = roots().iter().flat_map(|root| imports::loops(root)).collect();
    assert!(
        loops.is_empty(),
        "files that import each other are read as one; move what both need into a file of its own:\n{}",
        loops.join("\n")
    );
}

/// Folders may import each other although no two of their files do.
#[test]
fn no_folders_import_each_other_in_a_loop() {
    // This crate has such folders today.
    let but = ["trainer/coordinator/src/lib.rs"];
    let held = roots().into_iter().filter(|root| !but.iter().any(|but| root.ends_with(but)));
    let loops: Vec<String> = held.flat_map(|root| imports::folder_loops(&root)).collect();
    assert!(loops.is_empty(), "move what both folders need into one below both:\n{}", loops.join("\n"));
}

/// Settings types that are also data for other code: datasets, encoders by their folders, parts of an import. Each with
/// the places that read them.
const ALSO_IN: [(&str, &[&str]); 7] = [
    (
        "DataSynthetic",
        &[
            "mocap/src/sample.rs",
            "motion/src/synthetic.rs",
            "pipeline/src/read.rs",
            "pipeline/src/reference.rs",
            "local/cost.rs",
            "stages/src/generate/timing.rs",
        ],
    ),
    // The papers' rows stand beside models of published data only.
    (
        "DataOpen",
        &["pipeline/src/read.rs", "pipeline/src/reference.rs", "local/cost.rs", "registry/src/cli/ranking.rs"],
    ),
    ("DataFeatures", &["local/cost.rs"]),
    (
        "TextEmbed",
        &[
            "pipeline/src/read.rs",
            "pipeline/src/reference.rs",
            "local/hub_names.rs",
            "local/plan.rs",
            "parts/text/named.rs",
            "parts/text/published.rs",
        ],
    ),
    ("ImportModel", &["pipeline/src/reference.rs"]),
    // One such stage means a stage for each fold, and its splits are those of another dataset.
    ("DataFold", &["pipeline/src/check.rs", "pipeline/src/copies.rs", "local/cost.rs"]),
    // `POST /v1/draws` is a run of it.
    ("DrawMotions", &["shell/draws.rs"]),
];

/// A new kind is two files, and its lines in the lists of their folders.
#[test]
fn a_stage_kind_is_named_in_no_third_place() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let (described, run) = ("trainer/protocol/src/stage/kinds", "trainer/stages/src/kinds");
    let list = std::fs::read_to_string(root.join(described).join("mod.rs")).expect("the list of kinds");
    let list = list.split("stage_kinds! {").nth(1).expect("the list of kinds");
    // The coordinator runs `register`.
    let names = list.lines().filter_map(|line| line.trim().strip_suffix(',')?.split_once(": ")).map(|(_, name)| name);
    let names: BTreeSet<&str> = names.filter(|name| *name != "Register").collect();
    assert!(names.len() > 20, "{names:?}");
    let mut named = BTreeMap::new();
    let crates = ["trainer", "registry", "worker"].map(|folder| root.join(folder));
    for (path, code) in crates.iter().flat_map(|folder| sources(folder)) {
        let path = path.strip_prefix(&root).expect("a file of the tree").to_owned();
        let inside = path.starts_with(described) || path.starts_with(run);
        let shipped = path.iter().any(|part| part == "src");
        if inside || !shipped || path.to_string_lossy().ends_with("tests.rs") {
            continue;
        }
        let code: Vec<&str> = code.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
        let words = code.iter().flat_map(|line| line.split(|c: char| !c.is_alphanumeric()));
        for name in words.filter(|word| names.contains(word)) {
            named.insert((name.to_owned(), path.clone()), ());
        }
    }
    let known = |name: &str, path: &Path| {
        ALSO_IN.iter().any(|(also, places)| *also == name && places.iter().any(|place| path.ends_with(place)))
    };
    let third: Vec<_> = named.into_keys().filter(|(name, path)| !known(name, path)).collect();
    assert!(third.is_empty(), "give the kind a method that says what is needed here: {third:?}");
}
