//! The schedule and the two published samplers against stored steps of the reference schedulers.

mod common;

use std::path::Path;

use common::{Arrays, Gates, golden, json};
use models::diffusion::{Schedule, TIMESTEPS, affine, affine_one, boundary, consistency, ddim_timesteps, unzip};
use protocol::stage::{Diffusion, Prediction};

const GATE: f64 = 1e-5;

#[test]
fn golden_schedulers() {
    for root in golden("schedulers") {
        check_schedulers(&root);
    }
}

fn check_schedulers(root: &Path) {
    let info = json(&root.join("info.json"));
    let steps = Arrays::read(&root.join("steps.safetensors"));
    let (device, schedule, mut gates) = (common::device(), Schedule::published(), Gates::default());

    let betas = npy_f32(&root.join("betas.npy"));
    let bars = npy_f32(&root.join("alphas_cumprod.npy"));
    assert_eq!((betas.len(), bars.len()), (1000, 1000));
    for t in 0..1000 {
        assert_eq!(schedule.beta(t) as f32, betas[t], "beta {t}, bit for bit");
        assert_eq!(schedule.alpha_bar(t) as f32, bars[t], "cumulative alpha {t}, bit for bit");
    }

    for (key, expected) in info.as_object().expect("as the README says") {
        if let Some(n) = key.strip_prefix("ddim_timesteps_") {
            let expected: Vec<usize> = serde_json::from_value(expected.clone()).expect("as the README says");
            assert_eq!(ddim_timesteps(n.parse().expect("as the README says")), expected, "{key}");
        }
    }

    let b = &info["lcm_boundary"];
    for (i, t) in b["t"].as_array().expect("as the README says").iter().enumerate() {
        let (skip, out) = boundary(t.as_u64().expect("as the README says") as usize);
        gates.check(
            "boundary",
            format!("c_skip {t}"),
            common::relative(skip, b["c_skip"][i].as_f64().expect("as the README says")),
            1e-12,
        );
        gates.check(
            "boundary",
            format!("c_out {t}"),
            common::relative(out, b["c_out"][i].as_f64().expect("as the README says")),
            1e-12,
        );
    }

    let times = steps.get("addnoise_t").usizes();
    let (a, e) = unzip(times.iter().map(|t| schedule.add_noise(*t)));
    let (x, noise) = (steps.get("addnoise_x").tensor(&device), steps.get("addnoise_noise").tensor(&device));
    gates.tensor("add_noise", "all", affine(x, noise, &a, &e), steps.get("addnoise_out"), GATE);

    let (x, noise) = (steps.get("addnoise_x").tensor(&device), steps.get("addnoise_noise").tensor(&device));
    let velocity = predicting(Prediction::Velocity).target(x, noise, &times);
    gates.tensor("velocity", "all", velocity, steps.get("velocity_out"), GATE);

    for (word, prediction) in
        [("epsilon", Prediction::Noise), ("sample", Prediction::Sample), ("v_prediction", Prediction::Velocity)]
    {
        ddim(word, &predicting(prediction), &info, &steps, &mut gates);
    }
    lcm(&info, &steps, &mut gates);
    gates.close("golden/schedulers");
}

/// The published schedule for a network with this prediction.
fn predicting(prediction: Prediction) -> Schedule {
    Schedule::new(&Diffusion { prediction, ..Diffusion::default() }, TIMESTEPS)
}

/// Chained steps of the 50-step sampler with one kind of prediction, each from the stored latent before it.
fn ddim(word: &str, schedule: &Schedule, info: &serde_json::Value, steps: &Arrays, gates: &mut Gates) {
    let device = common::device();
    let stored = |part: &str| steps.get(&format!("ddim_{word}_{part}"));
    let (out, clean, prev) = (stored("model_out"), stored("pred_x0"), stored("prev"));
    let mut z = stored("x0").clone();
    for (j, t) in info["ddim_steps_t"].as_array().expect("as the README says").iter().enumerate() {
        let t = t.as_u64().expect("as the README says") as usize;
        let eps = common::row(out, j);
        let (zt, eps) = (z.tensor::<3>(&device), eps.tensor::<3>(&device));
        let x0 = affine_one(zt.clone(), eps.clone(), schedule.clean(t));
        gates.tensor("ddim x0", format!("{word} t {t}"), x0, &common::row(clean, j), GATE);
        let s = models::diffusion::ddim::ddim_previous(50, t);
        let next = affine_one(zt, eps, schedule.jump(t, s));
        gates.tensor("ddim step", format!("{word} t {t}"), next, &common::row(prev, j), GATE);
        z = common::row(prev, j);
    }
}

/// Checks every `lcm_*` entry: the timesteps by our rules, then each step from the stored latent before it.
fn lcm(info: &serde_json::Value, steps: &Arrays, gates: &mut Gates) {
    use models::diffusion::{Grid, LcmTimesteps, lcm_timesteps};
    let (device, schedule) = (common::device(), Schedule::published());
    let mut entries = 0;
    for (key, entry) in info.as_object().expect("as the README says") {
        if !key.starts_with("lcm_") || key == "lcm_boundary" {
            continue;
        }
        entries += 1;
        let times: Vec<usize> = serde_json::from_value(entry["timesteps"].clone()).expect("as the README says");
        let grid = Grid::new(1000 / entry["original_inference_steps"].as_u64().expect("as the README says") as usize);
        let rule = if key.contains("motionlcm") { LcmTimesteps::Tuned(grid) } else { LcmTimesteps::Even(grid) };
        assert_eq!(lcm_timesteps(rule, times.len()), times, "{key}");

        let stored = |part: &str| steps.get(&format!("{key}_{part}"));
        let mut z = stored("x0").clone();
        for (j, t) in times.iter().enumerate() {
            let eps = common::row(stored("model_out"), j).tensor::<3>(&device);
            let mut next = affine_one(z.tensor::<3>(&device), eps, consistency(&schedule, *t));
            gates.tensor("lcm denoised", format!("{key} {t}"), next.clone(), &common::row(stored("denoised"), j), GATE);
            if let Some(s) = times.get(j + 1) {
                let fresh = common::row(stored("noise"), j).tensor::<3>(&device);
                next = affine_one(next, fresh, schedule.add_noise(*s));
            }
            gates.tensor("lcm step", format!("{key} {t}"), next, &common::row(stored("prev"), j), GATE);
            z = common::row(stored("prev"), j);
        }
    }
    assert!(entries > 0, "info.json describes LCM samplers");
}

fn npy_f32(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("as the README says");
    let header = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
    assert!(String::from_utf8_lossy(&bytes[..header]).contains("'<f4'"), "{} is f32", path.display());
    bytes[header..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}
