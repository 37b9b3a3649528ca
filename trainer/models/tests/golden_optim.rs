//! AdamW, learning rates, clipping and the moving average against trajectories of PyTorch.

mod common;

use std::path::Path;

use common::{Gates, golden, json, relative};
use models::optim::{AdamW, LrSchedule, clip_factor, ema, global_norm};
use protocol::stage::Decay;
use serde_json::Value;

const GATE: f64 = 1e-5;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("a list").iter().map(|v| v.as_f64().expect("a number")).collect()
}

fn singles(value: &Value) -> Vec<f32> {
    numbers(value).into_iter().map(|v| v as f32).collect()
}

/// Settings in a trajectory's name: optimizer, schedule if it is ours, clip. The file stores neither weight decay nor
/// second beta. 0.01 and 0.99 (plain Adam: 0 and 0.999) are the only round values that reproduce the weights to 1e-6.
fn setting(name: &str, stored: &[f64]) -> (AdamW, Option<LrSchedule>, f64) {
    let adamw = AdamW { beta1: 0.9, beta2: 0.99, eps: 1e-8, weight_decay: 0.01 };
    let ours = |warmup, decay| Some(LrSchedule { peak: 0.01, warmup, steps: stored.len() as u64, decay });
    match name {
        // Ends at a hundredth of the peak, unlike any recipe here: the stored rates are used.
        "adamw_cosine_annealing_T60_ema099" => (adamw, None, 0.0),
        "adamw_hf_cosine_warmup10_60_ema099" => (adamw, ours(10, Decay::Cosine), 0.0),
        "adamw_constant_clip0.5" => (adamw, ours(0, Decay::Constant), 0.5),
        // Steps down twice: the stored rates are used as well.
        "adam_multistep_20_40_g0.1" => (AdamW { beta2: 0.999, weight_decay: 0.0, ..adamw }, None, 0.0),
        other => panic!("trajectory `{other}`: what optimizer is this?"),
    }
}

#[test]
fn golden_optim() {
    for root in golden("optim") {
        check_trajectories(&root);
    }
}

fn check_trajectories(root: &Path) {
    let file = json(&root.join("trajectories.json"));
    let (a, target, start) = (singles(&file["a"]), singles(&file["target"]), singles(&file["p0"]));
    let mut gates = Gates::default();
    let mut seen = 0;
    for (name, run) in file.as_object().expect("an object") {
        if !run.is_object() {
            continue;
        }
        seen += 1;
        let rates = numbers(&run["lr"]);
        let (adam, schedule, clip) = setting(name, &rates);
        let (mut p, mut average) = (start.clone(), start.clone());
        let (mut m, mut v) = (vec![0.0; p.len()], vec![0.0; p.len()]);
        for (i, rate) in rates.iter().enumerate() {
            let lr = schedule.map_or(*rate, |s| s.at(i as u64));
            gates.check("rate", format!("{name} {i}"), (lr - rate).abs() / 0.01, 1e-12);
            let loss: f64 = (0..p.len()).map(|k| 0.5 * f64::from(a[k] * (p[k] - target[k]).powi(2))).sum();
            gates.check("loss", format!("{name} {i}"), relative(loss, run["loss"][i].as_f64().expect("a loss")), 1e-4);
            let mut grads: Vec<f32> = (0..p.len()).map(|k| a[k] * (p[k] - target[k])).collect();
            let factor = clip_factor(global_norm(&grads), clip) as f32;
            grads.iter_mut().for_each(|g| *g *= factor);
            adam.step(i as u64 + 1, lr, &mut p, &grads, &mut m, &mut v);
            ema(&mut average, &p, 0.99);
            gates.check("weights", format!("{name} {i}"), common::error(&p, &numbers(&run["p"][i])), GATE);
            gates.check("average", format!("{name} {i}"), common::error(&average, &numbers(&run["ema"][i])), GATE);
        }
    }
    assert_eq!(seen, 4, "four trajectories are stored");
    gates.close("golden/optim");
}
