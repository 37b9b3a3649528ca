//! The metrics against values computed with the reference code, `golden/metrics`.

use std::path::{Path, PathBuf};

use serde_json::Value;
use stages::evaluation::frechet::Gaussian;
use stages::evaluation::{joints, retrieval};

/// `$STRIDE_SHARED`, or `../shared` beside the workspace.
fn shared() -> PathBuf {
    match std::env::var_os("STRIDE_SHARED") {
        Some(path) => PathBuf::from(path),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"),
    }
}

fn array(path: &Path) -> (Vec<u64>, Vec<f32>) {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let npy = npyz::NpyFile::new(&bytes[..]).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let shape = npy.shape().to_vec();
    (shape, npy.into_vec::<f32>().unwrap_or_else(|e| panic!("{}: {e}", path.display())))
}

fn wide(path: &Path) -> (usize, Vec<f64>) {
    let (shape, values) = array(path);
    (shape[1] as usize, values.into_iter().map(f64::from).collect())
}

/// The worst of the differences, each relative to its own scale.
fn worst(pairs: &[(f64, f64)]) -> f64 {
    pairs.iter().map(|(found, expected)| (found - expected).abs() / expected.abs().max(1e-12)).fold(0.0, f64::max)
}

#[test]
fn golden_metrics() {
    let folder = shared().join("data/golden/metrics");
    let Ok(text) = std::fs::read_to_string(folder.join("expected.json")) else {
        eprintln!("SKIPPED: no {}; set STRIDE_SHARED to the folder with the golden data", folder.display());
        return;
    };
    let expected: serde_json::Map<String, Value> = serde_json::from_str(&text).expect("expected.json");
    let mut checked = 0;
    for (name, item) in &expected {
        let path = |key: &str| folder.join(item[key].as_str().unwrap_or_else(|| panic!("{name}: no `{key}`")));
        let number = |key: &str| item[key].as_f64().unwrap_or_else(|| panic!("{name}: no `{key}`"));
        let error = if name.starts_with("fid") {
            let ((dim, truth), (_, made)) = (wide(&path("gt")), wide(&path("gen")));
            let (truth, made) = (Gaussian::fit(&truth, dim), Gaussian::fit(&made, dim));
            let distance = truth.distance(&made);
            if number("value").abs() < 1e-6 {
                distance.abs() / truth.total_variance()
            } else {
                worst(&[(distance, number("value"))])
            }
        } else if name.starts_with("r_precision") {
            let ((dim, text), (_, motion)) = (wide(&path("text")), wide(&path("motion")));
            let found = retrieval::in_groups(&text, &motion, dim, number("group") as usize);
            worst(&[
                (found.top[0], number("top1")),
                (found.top[1], number("top2")),
                (found.top[2], number("top3")),
                (found.matching_score, number("matching_score")),
            ])
        } else if name == "mpjpe" {
            let ((shape, truth), (_, guess)) = (array(&path("gt")), array(&path("pred")));
            let count = shape[shape.len() - 2] as usize;
            let aligned = joints::root_aligned(&truth, &guess, count);
            let global = joints::global(&truth, &guess, count);
            let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
            let mut pairs =
                vec![(mean(&aligned), number("root_aligned_mean")), (mean(&global), number("unaligned_mean"))];
            let frames = item["per_frame_root_aligned"].as_array().expect("per-frame values");
            assert_eq!(frames.len(), aligned.len(), "{name}: frames");
            pairs.extend(aligned.iter().zip(frames).map(|(a, e)| (*a, e.as_f64().expect("a number"))));
            worst(&pairs)
        } else {
            println!("metrics/{name}: not a metric of this crate yet");
            continue;
        };
        println!("metrics/{name}: worst relative error {error:.1e}");
        assert!(error < 1e-4, "metrics/{name}: worst relative error {error:e}, expected below 1e-4");
        checked += 1;
    }
    assert!(checked >= 6, "only {checked} of the items of expected.json were checked");
}
