//! Promotion, rollback, history, and motion out of the promoted model.

use cluster_tests::Bench;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

fn aliases(bench: &Bench) -> String {
    bench.run(&["registry", "show", "smoke", "-o", "json"]).expect_code(0).json()["aliases"].to_string()
}

#[test]
fn p10_promote_refuse_roll_back_and_generate() {
    let bench = Bench::new(TRAINER);
    bench.pipeline("smoke.yaml", &[]);
    let before = aliases(&bench);

    let refused = bench.run(&[
        "registry",
        "promote",
        "smoke@best",
        "--to",
        "prod",
        "--require",
        "latent_fid<=0",
        "--reason",
        "too good",
    ]);
    let refused = refused.expect_code(10);
    assert!(refused.stderr.contains("latent_fid"), "{}", refused.stderr);
    assert_eq!(aliases(&bench), before, "a gate that does not hold changes nothing");

    for (version, reason) in [("smoke:1", "first"), ("smoke:2", "second")] {
        bench
            .run(&["registry", "promote", version, "--to", "prod", "--require", "latent_fid<=1000", "--reason", reason])
            .expect_code(0);
    }
    bench.run(&["registry", "rollback", "smoke", "--alias", "prod", "--reason", "worse"]).expect_code(0);
    let history = bench.run(&["registry", "history", "smoke", "-o", "json"]).expect_code(0).stdout;
    for reason in ["first", "second", "worse"] {
        assert!(history.contains(reason), "`{reason}` is missing in {history}");
    }
    bench.run(&["registry", "fsck"]).expect_code(0);

    for file in ["walk.gif", "walk.npy"] {
        let said = bench.run(&["generate", "a person walks in a circle", "--model", "smoke@staging", "-o", file]);
        said.expect_code(0);
        assert!(std::fs::metadata(bench.path().join(file)).expect("the motion is written").len() > 1000);
    }
    crate::motions::are_written(&bench);
    let unknown = bench.run(&["generate", "a person walks", "--model", "smoke@nobody", "-o", "x.gif"]);
    assert_ne!(unknown.code, Some(0));
    assert!(unknown.stderr.contains("nobody"), "{}", unknown.stderr);
}
