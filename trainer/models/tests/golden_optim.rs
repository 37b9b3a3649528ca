//! AdamW, learning rates, clipping and the moving average against trajectories of PyTorch.

mod common;

use common::{Gates, json, relative, shared};
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

/// What a trajectory's name says: the weight decay (not stored; it follows from the first moves), the schedule if it is
/// ours, the clip, the average's decay.
fn setting(name: &str, stored: &[f64]) -> (f64, Option<LrSchedule>, f64, f64) {
    let (peak, steps) = (0.01, stored.len() as u64);
    let cosine = |warmup| Some(LrSchedule { peak, warmup, steps, decay: Decay::Cosine });
    match name {
        "adamw_cosine_annealing_T60_ema099" => (0.01, cosine(0), 0.0, 0.99),
        "adamw_hf_cosine_warmup10_60_ema099" => (0.0, cosine(10), 0.0, 0.99),
        "adamw_constant_clip0.5" => {
            (0.01, Some(LrSchedule { peak, warmup: 0, steps, decay: Decay::Constant }), 0.5, 0.99)
        }
        // Plain Adam with a schedule that no recipe here has: the stored rates are used.
        "adam_multistep_20_40_g0.1" => (0.0, None, 0.0, 0.99),
        other => panic!("trajectory `{other}`: what optimizer is this?"),
    }
}

#[test]
fn golden_optim() {
    let Some(root) = shared("golden/optim") else { return };
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
        let (weight_decay, schedule, clip, decay) = setting(name, &rates);
        let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay };
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
            ema(&mut average, &p, decay);
            gates.check("weights", format!("{name} {i}"), common::error(&p, &numbers(&run["p"][i])), GATE);
            gates.check("average", format!("{name} {i}"), common::error(&average, &numbers(&run["ema"][i])), GATE);
        }
    }
    assert_eq!(seen, 4, "four trajectories are stored");
    gates.close("golden/optim");
}
