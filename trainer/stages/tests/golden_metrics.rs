//! The metrics against values computed with the reference code, `golden/metrics` and the parity fixture `06_sjpe`.

use std::path::Path;

use serde_json::Value;
use stages::metrics::control::ControlErrors;
use stages::metrics::frechet::Gaussian;
use stages::metrics::jerk::{JerkError, jerk};
use stages::metrics::{joints, retrieval, skating, spread};

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

/// The largest of the differences, each relative to its own scale.
fn worst(pairs: &[(f64, f64)]) -> f64 {
    pairs.iter().map(|(found, expected)| (found - expected).abs() / expected.abs().max(1e-12)).fold(0.0, f64::max)
}

#[test]
fn golden_metrics() {
    for folder in fixtures::golden("metrics") {
        check_metrics(&folder);
    }
}

#[expect(clippy::print_stdout, reason = "part of a test")]
fn check_metrics(folder: &Path) {
    let text = std::fs::read_to_string(folder.join("expected.json")).expect("expected.json");
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
        } else if name.starts_with("sjpe") {
            // The arrays are those of the MPJPE, which all items with joints share.
            let item_of = |key: &str| folder.join(expected["mpjpe"][key].as_str().expect("a file"));
            let ((shape, truth), (_, guess)) = (array(&item_of("gt")), array(&item_of("pred")));
            let count = shape[shape.len() - 2] as usize;
            let of = indices(&item["joints"]);
            let jerks = |motion: Vec<f32>| jerk(&widen(motion), count, &of, number("fps"));
            let (truth, guess) = (jerks(truth), jerks(guess));
            let error = JerkError::between(&truth, &guess);
            let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
            // The stored values are sums over joints.
            let joints = of.len() as f64;
            worst(&[
                (mean(&guess), number("pred_jerk_mean")),
                (mean(&truth), number("gt_jerk_mean")),
                (error.statics * joints, number("static_v1")),
                (error.noise * joints, number("noise_v1")),
                (error.weighted_static, number("static_v2")),
                (error.weighted_noise, number("noise_v2")),
            ])
        } else if name.starts_with("diversity") {
            let (dim, rows) = wide(&path("emb"));
            worst(&[(spread::diversity(&rows, dim, &whole(&path("first")), &whole(&path("second"))), number("value"))])
        } else if name == "multimodality" {
            let (shape, rows) = array(&path("emb"));
            let (samples, dim) = (shape[1] as usize, shape[2] as usize);
            let (first, second) = (whole(&path("first")), whole(&path("second")));
            worst(&[(spread::multimodality(&widen(rows), samples, dim, &first, &second), number("value"))])
        } else if name == "skating_ratio" {
            let (shape, motions) = array(&path("motions"));
            let size = shape[1..].iter().product::<u64>() as usize;
            let ratios = motions
                .chunks_exact(size)
                .map(|motion| skating::ratio(&widen(motion.to_vec()), shape[2] as usize, [10, 11], 20.0));
            let stored = item["per_sequence"].as_array().expect("a value a sequence");
            worst(&ratios.zip(stored).map(|(r, e)| (r, e.as_f64().expect("a number"))).collect::<Vec<_>>())
        } else if name == "control" {
            let (_, motion) = array(&path("motion"));
            let (shape, hint) = array(&path("hint"));
            let told: Vec<bool> = mask(&path("mask"), shape.iter().product::<u64>() as usize / 3);
            let (motion, hint) = (widen(motion), widen(hint));
            let at = |threshold: f64| ControlErrors::of(&motion, &hint, &told, threshold).expect("told positions");
            worst(&[
                (at(0.2).trajectory, number("traj_fail_20cm")),
                (at(0.5).trajectory, number("traj_fail_50cm")),
                (at(0.2).location, number("kps_fail_20cm")),
                (at(0.5).location, number("kps_fail_50cm")),
                (at(0.5).average, number("mean_l2")),
                (at(0.5).average, number("kps_mean_err")),
            ])
        } else {
            panic!("metrics/{name}: no metric of this crate");
        };
        println!("metrics/{name}: worst relative error {error:.1e}");
        assert!(error < 1e-4, "metrics/{name}: worst relative error {error:e}, expected below 1e-4");
        checked += 1;
    }
    assert_eq!(checked, expected.len(), "every item of expected.json is checked");
    assert!(checked > 0, "expected.json is empty");
}

fn widen(values: Vec<f32>) -> Vec<f64> {
    values.into_iter().map(f64::from).collect()
}

fn indices(list: &Value) -> Vec<usize> {
    list.as_array().expect("a list").iter().map(|v| v.as_u64().expect("an index") as usize).collect()
}

/// Stored indices of any integer type.
fn whole(path: &Path) -> Vec<usize> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let read = || npyz::NpyFile::new(&bytes[..]).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    match read().into_vec::<i64>() {
        Ok(values) => values.into_iter().map(|v| v as usize).collect(),
        Err(_) => read().into_vec::<i32>().expect("integers").into_iter().map(|v| v as usize).collect(),
    }
}

/// A stored mask of `count` positions, with or without a repeated last axis.
fn mask(path: &Path, count: usize) -> Vec<bool> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let read = || npyz::NpyFile::new(&bytes[..]).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let values: Vec<bool> = match read().into_vec::<u8>() {
        Ok(values) => values.into_iter().map(|v| v != 0).collect(),
        Err(_) => read().into_vec::<f32>().expect("u8 or f32").into_iter().map(|v| v != 0.0).collect(),
    };
    assert!(values.len() == count || values.len() == 3 * count, "{}: {} values", path.display(), values.len());
    values.iter().step_by(values.len() / count).copied().collect()
}

#[test]
fn parity_sjpe() {
    let Some(folder) = fixtures::data("parity/06_sjpe") else { return };
    let read = |name: &str| std::fs::read(folder.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    let json = |name: &str| serde_json::from_slice::<Value>(&read(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    let (config, expected, io) = (json("config.json"), json("expected.json"), read("io.safetensors"));
    let io = safetensors::SafeTensors::deserialize(&io).expect("io.safetensors");
    let stored = |name: String| -> (Vec<usize>, Vec<f64>) {
        let view = io.tensor(&name).unwrap_or_else(|e| panic!("{name}: {e}"));
        let values = match view.dtype() {
            safetensors::Dtype::F64 => view.data().as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            _ => view.data().as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        };
        (view.shape().to_vec(), values)
    };
    let mut cases = 0;
    for (case, skeleton, unit) in [("j22", "22", 1.0), ("j21", "21", 1e-3)] {
        let of = indices(&config[format!("joints_{skeleton}")]);
        let fps = config[format!("fps_{skeleton}")].as_f64().expect("frames a second");
        let (shape, truth) = stored(format!("{case}/gt"));
        let (_, guess) = stored(format!("{case}/pred"));
        let jerks = |motion: &[f64]| jerk(&motion.iter().map(|v| v * unit).collect::<Vec<_>>(), shape[1], &of, fps);
        let (true_jerks, jerks) = (jerks(&truth), jerks(&guess));
        for (found, name) in [(&true_jerks, "gt_jerk_f64"), (&jerks, "pred_jerk_f64")] {
            let (_, wanted) = stored(format!("{case}/{name}"));
            let scale = wanted.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            let off = found.iter().zip(&wanted).fold(0.0_f64, |m, (f, e)| m.max((f - e).abs())) / scale;
            assert!(found.len() == wanted.len() && off < 1e-9, "{case}/{name}: {off:e}");
        }
        let error = JerkError::between(&true_jerks, &jerks);
        let wanted = &expected[format!("{case}/f64")];
        for (found, name) in [
            (error.statics * of.len() as f64, "static_v1"),
            (error.noise * of.len() as f64, "noise_v1"),
            (error.weighted_static, "static_v2"),
            (error.weighted_noise, "noise_v2"),
        ] {
            let wanted = wanted[name].as_f64().expect("a number");
            assert!((found - wanted).abs() <= 1e-9 * wanted.abs().max(1e-3), "{case}/{name}: {found} against {wanted}");
        }
        let narrow = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<_>>();
        let found = joints::root_aligned(&narrow(&truth), &narrow(&guess), shape[1]);
        let (_, wanted) = stored(format!("{case}/mpjpe_per_frame_f64"));
        let off = worst(&found.iter().copied().zip(wanted).collect::<Vec<_>>());
        assert!(off < 1e-6, "{case}/mpjpe: {off:e}");
        cases += 1;
    }
    assert_eq!(cases, 2);
}
