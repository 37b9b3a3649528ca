//! Noising, targets and deterministic moves along the schedules of other models: the cosine of MDM, the linear schedule
//! of StableMoFusion, the flow of DisCoRD (fixtures `07_*`, `06_discord_train`).

use models::diffusion::{Schedule, affine, affine_one, flow, unzip};
use protocol::stage::{Diffusion, NoiseSchedule, Prediction};
use serde_json::Value;

use crate::FORWARD;
use crate::common::{Array, Arrays, Gates, device, folders, json, name, shared};

/// Views [B, ...] as [B, 1, n].
fn rows(array: &Array) -> Array {
    let batch = array.shape[0];
    Array { shape: vec![batch, 1, array.values.len() / batch], ..array.clone() }
}

/// Checks `x_t` of every case that stores a sample, its noise, its timestep and the result.
fn noised(schedule: &Schedule, io: &Arrays, gates: &mut Gates) {
    let device = device();
    let mut found = 0;
    for case in io.cases() {
        let part = |part: &str| io.find(&format!("{case}/{part}"));
        let (Some(times), Some(x0), Some(noise), Some(expected)) = (part("t"), part("x0"), part("noise"), part("x_t"))
        else {
            continue;
        };
        found += 1;
        let (a, e) = unzip(times.usizes().into_iter().map(|t| schedule.add_noise(t)));
        let x_t = affine(rows(x0).tensor(&device), rows(noise).tensor(&device), &a, &e);
        gates.tensor("noised", case, x_t, &rows(expected), FORWARD);
    }
    assert!(found > 0, "{}: no case with a noised sample", io.file.display());
}

fn settings(schedule: NoiseSchedule, prediction: Prediction) -> Diffusion {
    Diffusion { schedule, prediction, beta_first: 1e-4, beta_last: 0.02 }
}

#[test]
fn parity_noising() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["07_mdm", "07_stablemofusion_train"]) {
        let config = json(&folder.join("config.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let (kind, steps) = match config["diffusion"].as_object() {
            Some(mdm) => {
                assert_eq!(mdm["schedule"], "cosine");
                (NoiseSchedule::Cosine, mdm["steps"].as_u64())
            }
            None => {
                let stored = &config["schedule"];
                assert_eq!(
                    (&stored["beta_schedule"], &stored["beta_end"]),
                    (&Value::from("linear"), &Value::from(0.02))
                );
                (NoiseSchedule::Linear, stored["num_train_timesteps"].as_u64())
            }
        };
        let mut gates = Gates::default();
        let schedule = Schedule::new(&settings(kind, Prediction::Sample), steps.expect("timesteps") as usize);
        noised(&schedule, &io, &mut gates);
        gates.close(&name(&folder));
    }
}

/// DDIM with sample prediction on the linear schedule, each move from the stored latent before it.
#[test]
fn parity_sample_moves() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["07_stablemofusion_sampler"]) {
        let io = Arrays::read(&folder.join("io.safetensors"));
        let (device, mut gates) = (device(), Gates::default());
        let schedule = Schedule::new(&settings(NoiseSchedule::Linear, Prediction::Sample), 1000);
        let times = io.get("ddim10/timesteps").usizes();
        let latent = |j: usize| io.get(&format!("ddim10/latents_after_step/{j}"));
        for (j, t) in times.iter().enumerate().skip(1) {
            let out = io.get(&format!("ddim10/prediction/{j}")).tensor::<3>(&device);
            // The last move ends at the sample itself.
            let rule = times.get(j + 1).map_or_else(|| schedule.clean(*t), |s| schedule.jump(*t, *s));
            let next = affine_one(latent(j - 1).tensor(&device), out, rule);
            gates.tensor("move", format!("t {t}"), next, latent(j), 1e-5);
        }
        gates.close(&name(&folder));
    }
}

/// DisCoRD's time runs from noise (0) to data (1), so its share of noise is `1 - t` and its velocity the opposite of ours.
#[test]
fn parity_flow() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["06_discord_train"]) {
        let io = Arrays::read(&folder.join("io.safetensors"));
        let (device, mut gates) = (device(), Gates::default());
        let schedule = Schedule::new(&settings(NoiseSchedule::Flow, Prediction::Velocity), 1000);
        for case in io.cases().into_iter().filter(|case| io.find(&format!("{case}/x_t")).is_some()) {
            let load = |part: &str| io.get(&format!("{case}/{part}")).tensor::<3>(&device);
            let times = io.get(&format!("{case}/t")).values.clone();
            let (a, e) = unzip(times.iter().map(|t| flow(1.0 - t)));
            let x_t = affine(load("motion"), load("noise"), &a, &e);
            gates.tensor("noised", format!("{case}/x_t"), x_t, io.get(&format!("{case}/x_t")), FORWARD);
            let target = schedule.target(load("motion"), load("noise"), &vec![500; times.len()]) * -1.0;
            gates.tensor("target", format!("{case}/target"), target, io.get(&format!("{case}/target")), FORWARD);
        }
        gates.close(&name(&folder));
    }
}
