//! The examples of every `--help`, run in one folder with a small pipeline in place of the quickstart. An example that
//! needs a network, a scheduler or a live server names the test that runs its command.

use std::collections::BTreeSet;
use std::fs;

use cluster_tests::{Bench, Running};

use crate::documented::{bash, programs};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Beginnings of examples that this test leaves out: the reason, and the test that runs the command.
const ELSEWHERE: [(&str, &str, &str); 19] = [
    ("trainer data fetch", "a network", "tests/process/bandai.rs"),
    ("trainer data push", "a live server", "tests/process/push.rs"),
    ("trainer demo", "models of its own", "tests/process/demo.rs"),
    ("trainer doctor", "a server that is away", "tests/process/documented.rs"),
    ("trainer import", "weights of others", "tests/process/released.rs"),
    ("trainer launch", "a scheduler", "tests/process/launch.rs"),
    ("trainer worker join", "a live server", "tests/process/documented.rs"),
    ("trainer worker list", "a live server", "tests/process/documented.rs"),
    ("trainer serve", "it does not end", "tests/process/documented.rs"),
    ("trainer submit", "a live server", "tests/process/documented.rs"),
    ("trainer pause", "a run at work", "tests/process/cluster.rs"),
    ("trainer resume", "a paused run", "tests/process/cluster.rs"),
    ("trainer cancel", "a run at work", "tests/process/running.rs"),
    ("trainer sweep", "a run with a sweep", "tests/process/sweeps.rs"),
    ("trainer completions", "a shell's folders", "tests/process/documented.rs"),
    ("trainer man", "a manual's folder", "tests/process/documented.rs"),
    ("registry rollback", "an alias that moved twice", "tests/process/registry.rs"),
    ("registry adopt", "a copied bucket", "tests/process/buckets.rs"),
    ("registry migrate", "a PostgreSQL", "registry/tests/migrate.rs"),
];

/// Beginnings of examples whose results others need, in this order. The last run is the one with models.
const FIRST: [&str; 5] =
    ["trainer run configs/smoke", "trainer run", "trainer data sample", "registry export", "registry backup"];

/// Examples in the help of a command and of those below it.
fn examples(bench: &Bench, command: &[&str], found: &mut BTreeSet<String>) {
    let help = bench.run(&[command, &["--help"]].concat()).expect_code(0).stdout;
    if let Some((_, listed)) = help.split_once("\nExample") {
        let mut examples: Vec<String> = Vec::new();
        for line in listed.lines().skip(1).take_while(|line| !line.is_empty()) {
            let begins = ["trainer ", "registry "].iter().any(|program| line.trim_start().starts_with(program));
            match examples.last_mut().filter(|_| !begins) {
                // The help is wrapped to the width of a terminal.
                Some(example) => *example = format!("{example} {}", line.trim()),
                None => examples.push(line.trim().to_owned()),
            }
        }
        found.extend(examples);
    }
    let Some((_, below)) = help.split_once("\nCommands:\n") else { return };
    let names = below.lines().take_while(|line| !line.is_empty()).filter_map(|line| {
        // A further line of a description is indented more.
        let name = line.strip_prefix("  ").filter(|rest| !rest.starts_with(' '))?;
        name.split_whitespace().next()
    });
    for name in names.filter(|name| *name != "help") {
        examples(bench, &[command, &[name]].concat(), found);
    }
}

/// A folder in which the examples work: pipelines below `configs/`, a motion, a recording by its documented name.
fn folder() -> Bench {
    let bench = Bench::new(TRAINER);
    programs(bench.path());
    let configs = bench.path().join("configs");
    fs::create_dir_all(&configs).expect("a folder");
    let smoke = fs::read_to_string(Bench::config("smoke.yaml")).expect("a pipeline");
    fs::write(configs.join("quickstart.yaml"), smoke.replace("smoke", "quickstart")).expect("written");
    for name in ["smoke.yaml", "motionpcm.yaml"] {
        std::os::unix::fs::symlink(Bench::config(name), configs.join(name)).expect("a link");
    }
    bench
}

#[test]
fn the_examples_of_every_help_run() {
    let bench = folder();
    let mut all = BTreeSet::new();
    examples(&bench, &[], &mut all);
    assert!(all.len() >= 60, "{all:#?}");
    for (begin, why, test) in ELSEWHERE {
        assert!(all.iter().any(|example| example.starts_with(begin)), "`{begin}` ({why}) is no example any more");
        let text = fs::read_to_string(Bench::repository().join(test)).expect("the test");
        let verb = begin.split(' ').next_back().expect("a verb");
        assert!(text.contains(&format!("\"{verb}\"")) || text.contains(verb), "{test} does not run `{begin}`");
    }
    let here = |example: &&String| ELSEWHERE.iter().all(|(begin, ..)| !example.starts_with(begin));
    let mut order: Vec<&String> = all.iter().filter(here).collect();
    order.sort_by_key(|example| FIRST.iter().position(|begin| example.starts_with(begin)).unwrap_or(FIRST.len()));
    let mut ran = 0;
    for example in order {
        if example.starts_with("trainer export") {
            let walk = ["generate", "a person walks", "--model", "quickstart@staging", "-o", "walk.npy"];
            bench.run(&walk).expect_code(0);
        }
        let line = example
            .replace("/backups/", "backups/")
            // A video needs a program that may be missing here.
            .replace("walk.mp4", "walk.gif")
            .replace(" --follow", "");
        println!("$ {line}");
        let said = Running::start(bash(bench.path(), "mkdir -p backups", &line)).wait();
        assert_eq!(said.code, Some(0), "{line}\n{}\n{}", said.stdout, said.stderr);
        assert!(!said.stdout.trim().is_empty() || line.contains('>'), "`{line}` prints nothing");
        ran += 1;
    }
    assert!(ran >= 30, "{ran} of {} examples", all.len());
}
