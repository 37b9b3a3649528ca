#![allow(clippy::unwrap_used, reason = "a test may panic")]

use serde_json::json;

use super::compare::{Verdict, compare};
use super::table::{Evaluation, evaluations, leaderboard};
use crate::versions::Version;

fn version(number: u64, metrics: &[(&str, f64)]) -> Version {
    Version {
        model: "m".into(),
        version: number,
        artifact: protocol::Digest::of(b"x"),
        metrics: metrics.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect(),
        source: json!({}),
        created_ms: 0,
        aliases: Vec::new(),
    }
}

#[test]
fn copies_of_an_evaluation_have_a_mean_with_its_interval() {
    let evaluation = |name: &str, of: Option<&str>, metrics: &[(&str, f64)]| Evaluation {
        name: name.to_owned(),
        copy_of: of.map(str::to_owned),
        metrics: metrics.iter().map(|(key, value)| ((*key).to_owned(), *value)).collect(),
    };
    let of = Some("fid");
    // Alone, one of them has another value that the others lack.
    let all = [
        evaluation("fid_1", of, &[("fid", 0.2), ("skating_ratio", 0.1)]),
        evaluation("real", None, &[("fid", 0.01)]),
        evaluation("fid_2", of, &[("fid", 0.3)]),
        evaluation("fid_3", of, &[("fid", 0.4)]),
    ];
    let table = evaluations("evaluate.t2m", &all).unwrap();
    let labels: Vec<&str> = table.rows.iter().map(|row| row.label.as_str()).collect();
    assert_eq!(labels, ["fid_1", "fid_2", "fid_3", "fid, mean of 3", "real"]);
    let mean = &table.rows[3].measures;
    assert_eq!(mean.len(), 1, "{mean:?}");
    let fid = mean["fid"];
    // Standard deviation .1, 4.303 for two degrees of freedom.
    assert!(
        (fid.value - 0.3).abs() < 1e-12 && (fid.half.unwrap() - 4.303 * 0.1 / 3.0_f64.sqrt()).abs() < 1e-9,
        "{fid:?}"
    );
}

#[test]
fn intervals_are_read_and_differences_beyond_noise_are_told() {
    let a = version(
        1,
        &[
            ("fid", 0.5),
            ("fid.lower", 0.45),
            ("fid.upper", 0.55),
            ("latent_fid", 0.1),
            ("latent_fid_sd", 0.01),
            ("x", 1.0),
        ],
    );
    let b = version(
        2,
        &[("fid", 0.3), ("fid.lower", 0.28), ("fid.upper", 0.32), ("latent_fid", 0.11), ("latent_fid_sd", 0.01)],
    );
    let found = compare(&a, &b);
    let of = |name: &str| found.metrics.iter().find(|d| d.metric == name).unwrap();
    assert_eq!(of("fid").verdict, Some(Verdict::Right));
    assert!((of("fid").difference.unwrap().half.unwrap() - 0.05_f64.hypot(0.02)).abs() < 1e-12);
    assert_eq!(of("latent_fid").verdict, Some(Verdict::Noise));
    assert_eq!(of("x").verdict, None);
    assert_eq!(found.metrics.len(), 3, "bounds are no metrics of their own");
    assert_eq!(compare(&b, &a).metrics[0].verdict, Some(Verdict::Left));
}

#[test]
fn an_evaluation_is_a_row_and_the_best_comes_first() {
    let two = version(
        2,
        &[
            ("one.fid", 0.3),
            ("four.fid", 0.2),
            ("four.fid.lower", 0.1),
            ("four.fid.upper", 0.3),
            ("fid", 0.2),
            ("aits", 0.03),
        ],
    );
    let leaderboard = leaderboard("m".into(), &[version(1, &[("fid", 0.25)]), two], Some("fid"), Some("kit"));
    let labels: Vec<_> = leaderboard.rows.iter().filter(|r| !r.published).map(|r| r.label.as_str()).collect();
    assert_eq!(labels, ["m:2 (four)", "m:1", "m:2 (one)"]);
    assert!((leaderboard.rows[0].measures["fid"].half.unwrap() - 0.1).abs() < 1e-12);
    assert_eq!(leaderboard.rows[0].measures["aits"].value, 0.03);
    assert!(leaderboard.rows.iter().any(|row| row.label == "MotionPCM, 1 step" && row.measures["fid"].value == 0.355));
}
