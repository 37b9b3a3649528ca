//! What a user is told by measures: times, and what is wrong with a metric, a split or an evaluator.

use cluster_tests::Bench;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// All on one smoke run, whose stages are cached from then on.
#[test]
fn measures_are_taken_and_misused_with_the_reason() {
    let bench = Bench::new(TRAINER);
    let report = bench.pipeline("smoke.yaml", &[]);
    let of = |stage: &str| {
        let found = report["stages"].as_array().and_then(|all| all.iter().find(|s| s["name"] == stage));
        found.unwrap_or_else(|| panic!("no stage {stage} in {report:#}"))["metrics"].clone()
    };
    let reconstruction = of("reconstruction");
    for metric in
        ["pa_mpjpe_mm", "acceleration_mm", "sjpe", "sjpe_noise", "sjpe_static", "skating_ratio", "real_skating_ratio"]
    {
        assert!(reconstruction[metric].is_number(), "{metric}: {reconstruction:#}");
    }

    // The teacher by its stage, the student by its name: a row for every number of steps that a model has.
    let time = ["time", "smoke@staging", "--stage", "mld", "--steps", "4,1", "--sentences", "3", "--frames", "40"];
    let said = bench.run(&[&time[..], &["-o", "json"]].concat()).expect_code(0).json();
    let rows = said["rows"].as_array().expect("rows");
    let steps: Vec<_> = rows.iter().map(|row| row["sampler"]["steps"].as_u64()).collect();
    assert!(rows[0]["model"].as_str().is_some_and(|m| m.starts_with("mld of ")) && rows[0]["ratio"] == 1.0, "{said}");
    assert!(steps[..2] == [Some(4), Some(1)] && steps.len() >= 3, "{said}");
    for row in rows {
        assert!(row["sentences"] == 3 && row["aits_s"].as_f64().is_some_and(|s| s > 0.0), "{said}");
    }
    let table = bench.run(&time).expect_code(0).stdout;
    println!("{table}");
    assert!(table.contains("AITS") && table.contains("3 sentences") && table.contains("threads"), "{table}");
    let unknown = bench.run(&["time", "--stage", "vae"]).expect_code(3).stderr;
    assert!(unknown.contains("no denoiser") && unknown.contains("mld"), "{unknown}");
    bench.run(&["time"]).expect_code(2);

    // What is wrong stops one stage, says why, and names the stage once.
    let config = Bench::config("smoke.yaml");
    for (stage, set, parts) in [
        ("release", "stages.release.metric=fdi", vec!["`fdi`", "latent_fid"]),
        ("release", "stages.release.promote.require=[fdi <= 1]", vec!["no metric `fdi`", "`latent_fid`"]),
        ("t2m_real", "stages.t2m_real.split=test", vec!["the split `test` has", "among 32", "split: all"]),
        ("vae", "stages.vae.checkpoint={every: 4, keep: {best: 1, metric: fdi}}", vec!["`fdi`", "loss", "joint"]),
    ] {
        // Another seed for what would be found in the store.
        let seed = if stage == "vae" { "seed=77" } else { "seed=1234" };
        let said = bench.run(&["run", &config, "--set", set, "--set", seed]).expect_code(1).stderr;
        println!("{set}\n{said}");
        assert!(parts.iter().all(|part| said.contains(part)), "{set}:\n{said}");
        let error = said.rsplit("error: ").next().expect("an error");
        assert!(error.starts_with(&format!("stage `{stage}` failed: ")), "{set}:\n{said}");
        assert_eq!(error.matches("stage `").count(), 1, "the stage is named once:\n{said}");
    }
    let kit = "stages.judge={kind: import.evaluator, format: kit, path: t2m}";
    let said = bench.run(&["plan", &config, "--set", kit, "--set", "stages.t2m_real.evaluator=judge"]).expect_code(2);
    assert!(said.stderr.contains("21 joints (kit)") && said.stderr.contains("22 joints"), "{}", said.stderr);
}
