//! Promise 19: the decisions of a sweep depend neither on its workers nor on killed processes, and its best trial
//! equals the stage with the trial's values.

use std::collections::BTreeSet;

use cluster_tests::{Bench, digests, states, wait_for};
use serde_json::Value;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const CONFIG: &str = "smoke.yaml";
const SWEEP: &str = "stages.pcm.sweep={metric: latent_fid, trials: 8, parallel: 3, rungs: {first: 6, factor: 2}, \
    space: {adversarial: {choice: [0, 0.1]}, skip: {choice: [50, 100]}, ema: {uniform: [0.8, 0.99]}}, \
    evaluate: {kind: evaluate.latent_fid, sampler: {steps: 1, guidance: 2}, repeats: 1, components: 8, shards: 2}}";
/// A budget of three rungs: 6, 12 and 24 steps.
const STEPS: [&str; 4] = ["--set", "stages.pcm.steps=24", "--until", "pcm"];

fn swept(workers: &str) -> Vec<&str> {
    [&["--workers", workers, "--set", SWEEP][..], &STEPS].concat()
}

/// All decisions of a sweep, without times and workers.
fn decided(report: &Value) -> (Value, Value, Value) {
    let sweep = &report["sweeps"][0];
    assert_eq!(sweep["over"], true, "{report:#}");
    (sweep["trials"].clone(), sweep["best"].clone(), digests(report)["pcm"].clone())
}

#[test]
fn p19_a_sweep_decides_the_same_with_other_workers_and_when_it_is_killed() {
    let bench = Bench::new(TRAINER);
    let report = bench.pipeline(CONFIG, &swept("2"));
    let reference = decided(&report);
    let trials = reference.0.as_array().expect("trials");
    let steps: Vec<u64> = trials.iter().filter_map(|trial| trial["steps"].as_u64()).collect();
    // 8 trials at the first rung, 4 at the second, 2 at the last.
    assert_eq!((steps.len(), steps.iter().filter(|s| **s == 24).count()), (8, 2), "{steps:?}");
    assert_eq!(steps.iter().sum::<u64>(), 8 * 6 + 4 * 6 + 2 * 12);
    let values: BTreeSet<String> = trials.iter().map(|trial| trial["values"].to_string()).collect();
    assert_eq!(values.len(), 8, "no trial is tried twice");

    // The plain stage with the best trial's values gives the same bits.
    let best = &trials[reference.1.as_u64().expect("a best trial") as usize];
    let sets: Vec<String> = best["values"]
        .as_object()
        .expect("values")
        .iter()
        .map(|(path, value)| format!("stages.pcm.{path}={value}"))
        .collect();
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set.as_str()]).collect();
    let alone = Bench::new(TRAINER);
    let plain = alone.pipeline(CONFIG, &[&["--workers", "2"][..], &sets, &STEPS].concat());
    assert_eq!(digests(&plain)["pcm"], reference.2, "trained in rungs against trained in one go");

    // One worker; the trainer is killed during several trials.
    let killed = Bench::new(TRAINER);
    let config = Bench::config(CONFIG);
    for trial in ["pcm.t01.r0", "pcm.t04.r0", "pcm.t07.r0.eval", "r1", "r2"] {
        let arguments = [&["run", &config, "-o", "json"][..], &swept("1")].concat();
        let mut running = killed.spawn(&arguments);
        wait_for(&format!("{trial} to begin, or the end"), || {
            let logs = std::fs::read_dir(killed.store().join("workers")).into_iter().flatten().flatten();
            let text: String = logs.filter_map(|entry| std::fs::read_to_string(entry.path()).ok()).collect();
            let begun = text.contains(&format!("{trial} attempt=")) || text.contains(&format!("{trial}/0 attempt="));
            (begun || !running.alive()).then_some(())
        });
        running.kill();
        running.wait();
    }
    assert_eq!(decided(&killed.pipeline(CONFIG, &swept("1"))), reference);

    // Repeat it: nothing runs, and the commands show the finished sweep.
    let again = bench.pipeline(CONFIG, &swept("2"));
    assert_eq!(decided(&again), reference);
    assert!(states(&again).values().all(|state| state == "cached" || state == "skipped"), "{:?}", states(&again));
    let plan = bench.run(&["plan", &config, "--set", SWEEP, STEPS[0], STEPS[1], "-o", "json"]).expect_code(0).json();
    let planned = plan["stages"].as_array().and_then(|stages| stages.iter().find(|stage| stage["stage"] == "pcm"));
    assert_eq!(planned.expect("the swept stage")["action"], "cached", "{plan:#}");
    let plot = bench.path().join("sweep.svg");
    let shown = bench.run(&["sweep", "status", &config, "-o", "json", "--plot", &plot.display().to_string()]);
    let shown = shown.expect_code(0).json();
    assert_eq!(shown["sweeps"][0]["trials"], reference.0);
    let picture = std::fs::read_to_string(&plot).expect("the picture");
    assert_eq!(picture.matches("<polyline").count(), 8);
    let table = bench.run(&["sweep", "status"]).expect_code(0).stdout;
    assert!(
        table.contains("stopped at 6") && table.contains("stopped at 12") && table.contains("of 192 steps"),
        "{table}"
    );
    let best_said = bench.run(&["sweep", "best", "-o", "json"]).expect_code(0).json();
    assert_eq!(best_said["best"][0]["values"], best["values"]);
    bench.run(&["sweep", "best", "--stage", "lcm"]).expect_code(7);
}

#[test]
fn a_metric_that_nobody_reports_is_refused_before_anything_runs_and_says_what_there_is() {
    let bench = Bench::new(TRAINER);
    let config = Bench::config(CONFIG);
    let sweep = SWEEP.replace("metric: latent_fid", "metric: fdi");
    let said = bench.run(&[&["run", &config, "--workers", "2", "--set", &sweep][..], &STEPS].concat()).expect_code(2);
    assert!(!bench.store().exists(), "nothing was stored");
    assert!(said.stderr.contains("`fdi`") && said.stderr.contains("latent_fid"), "{}", said.stderr);
}

#[test]
fn a_trial_that_diverges_is_stopped_and_the_sweep_goes_on() {
    let bench = Bench::new(TRAINER);
    let sweep = "stages.pcm.sweep={search: grid, metric: latent_fid, space: {lr: {choice: [5e-4, 1000]}}, \
        evaluate: {kind: evaluate.latent_fid, sampler: {steps: 1, guidance: 2}, repeats: 1, components: 8, shards: 1}}";
    let report = bench.pipeline(CONFIG, &["--workers", "2", "--set", sweep, "--until", "pcm"]);
    let sweep = &report["sweeps"][0];
    assert_eq!((&sweep["best"], &sweep["trials"][1]["state"]), (&0.into(), &"failed".into()), "{sweep:#}");
    let why = sweep["trials"][1]["message"].as_str().expect("a reason");
    assert!(why.contains("diverged"), "{why}");
    assert_eq!(states(&report)["pcm"], "ran");
}

/// Figures over a setting of generation, such as DisCoRD's quality over network evaluations, are a sweep over its
/// evaluation, with one training.
#[test]
fn an_evaluation_is_swept_over_one_training_and_drawn_by_its_setting() {
    let bench = Bench::new(TRAINER);
    let config = Bench::repository().join("tests/process/kinds.yaml").display().to_string();
    let sweep = "stages.discord.sweep={search: grid, metric: sjpe, space: {evaluate: {decoder_steps: {choice: [1, 2, 3]}, \
        split: {choice: [test, train]}}}, evaluate: {kind: evaluate.reconstruction, tokenizer: tokenizer, shards: 1}}";
    let report = bench.run(&["run", &config, "-o", "json", "--set", sweep, "--until", "discord"]).expect_code(0).json();
    let trials = report["sweeps"][0]["trials"].as_array().expect("trials");
    let values: BTreeSet<String> = trials.iter().map(|trial| trial["results"][0].to_string()).collect();
    assert_eq!((trials.len(), values.len()), (6, 6), "{trials:#?}");
    let logs = std::fs::read_dir(bench.store().join("workers")).expect("logs").flatten();
    let text: String = logs.filter_map(|entry| std::fs::read_to_string(entry.path()).ok()).collect();
    assert_eq!(text.matches("kind=\"train.discord\"").count(), 1, "trials share one training");

    let plot = |more: &[&str]| bench.run(&[&["sweep", "status", "--plot", "p.svg"][..], more].concat());
    let points = || {
        let picture = std::fs::read_to_string(bench.path().join("p.svg")).expect("the picture");
        (picture.matches("<polyline").count(), picture.matches("<circle").count())
    };
    plot(&[]).expect_code(0);
    assert_eq!(points(), (2, 6), "a line for each split, by the one searched number");
    plot(&["--by", "decoder_steps", "--metric", "sjpe,mpjpe_mm"]).expect_code(0);
    assert_eq!(points(), (4, 12));
    plot(&["--by", "seconds"]).expect_code(0);
    assert_eq!(points(), (2, 6));
    for (more, words) in [
        (["--by", "lr"], "evaluate.decoder_steps, seconds, steps"),
        (["--metric", "mpjpe"], "mpjpe_mm"),
        (["--metric", "fid"], "`fid`"),
    ] {
        let said = plot(&more).expect_code(2);
        assert!(said.stderr.contains(words), "{more:?}: {}", said.stderr);
    }
    let best = bench.run(&["sweep", "best"]).expect_code(0);
    assert!(!best.stdout.contains("--set"), "nothing of the training was searched: {}", best.stdout);
}
