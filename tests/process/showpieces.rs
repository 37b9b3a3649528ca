//! The pipelines of the procedural showpieces at their real widths with a few updates, and the commands of the book that
//! use their models: a path to follow, and an edit.

use cluster_tests::documented::run_by;
use cluster_tests::{Bench, Running, states};

use crate::documented::{bash, programs};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Runs a shipped pipeline with fewer clips and a few updates of each `training` stage.
fn train(bench: &Bench, config: &str, clips: usize, training: &[&str]) {
    let mut arguments = vec!["run".to_owned(), Bench::config(config), "-o".into(), "json".into()];
    let mut sets = vec![format!("dataset.clips={clips}")];
    for stage in training {
        sets.extend(["steps=4", "warmup=1"].map(|set| format!("stages.{stage}.{set}")));
    }
    // After a few updates no motion shows its sentence.
    sets.push("stages.release.promote.require=[]".to_owned());
    arguments.extend(sets.into_iter().flat_map(|set| ["--set".to_owned(), set]));
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let report = bench.run(&arguments).expect_code(0).json();
    let states = states(&report);
    assert!(states.len() > training.len() && states.values().all(|state| state == "ran"), "{states:?}");
}

/// Runs the commands of a block of the book, without those that train, and returns their output.
fn commands(bench: &Bench, block: &str) -> String {
    let lines = run_by(&Bench::repository(), &format!("tests/process/showpieces.rs, {block}"));
    programs(bench.path());
    let mut said = String::new();
    for line in lines.iter().filter(|line| !line.starts_with("trainer run ")) {
        said += &Running::start(bash(bench.path(), "", line)).wait().expect_code(0).stdout;
    }
    said
}

#[test]
fn control_follows_a_path_without_data_of_others() {
    let bench = Bench::new(TRAINER);
    train(&bench, "control-quickstart.yaml", 60, &["vae", "mld", "lcm", "first", "control", "evaluator"]);
    let said = commands(&bench, "control");
    assert!(said.contains("3 target positions: ") && said.contains("walk.png"), "{said}");
    assert!(bench.path().join("walk.png").metadata().is_ok_and(|file| file.len() > 10_000));
}

#[test]
fn tokens_edit_a_motion_without_data_of_others() {
    let bench = Bench::new(TRAINER);
    train(&bench, "tokens-quickstart.yaml", 300, &["tokenizer", "momask"]);
    let said = commands(&bench, "tokens");
    assert!(said.contains("0-19, 80-99 stay"), "{said}");
    for file in ["edited.gif", "edit.png"] {
        assert!(bench.path().join(file).metadata().is_ok_and(|file| file.len() > 10_000), "{file}");
    }
}

/// Control continues from the quickstart's results, because the same seed and settings give the same keys.
#[test]
fn the_quickstarts_share_their_first_stages() {
    let lines = |config: &str, begin: &str| -> Vec<String> {
        let text = std::fs::read_to_string(Bench::config(config)).expect("a pipeline");
        let mut lines = text.lines().skip_while(|line| !line.starts_with(begin)).map(str::to_owned);
        let first = lines.next().unwrap_or_else(|| panic!("{config} has no `{begin}`"));
        std::iter::once(first).chain(lines.take_while(|line| line.starts_with("    "))).collect()
    };
    for begin in ["seed:", "dataset:", "  vae:", "  latents:", "  mld:", "  lcm:"] {
        assert_eq!(lines("quickstart.yaml", begin), lines("control-quickstart.yaml", begin));
    }
}
