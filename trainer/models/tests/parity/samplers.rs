//! Whole trajectories of the two published samplers, and the noise loss of the teacher (fixtures `03_sampler*`).

use burn::tensor::Tensor;
use models::diffusion::{
    Grid, LcmTimesteps, Schedule, affine, ddim_sample, ddim_timesteps, guided, lcm_sample, lcm_timesteps, unzip,
};
use models::flat;
use models::kernels::Dropout;
use models::losses;
use models::networks::Denoiser;
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, device, folders, json, name, relative, row, shared, tracked};
use crate::networks::{check_gradients, denoiser, gradients, repeated, scalar};
use crate::{FORWARD, LOSS};

/// Gate of fifty steps with guidance.
const TRAJECTORY: f64 = 1e-5;

#[test]
fn parity_samplers() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["03_sampler"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let (plain, tracked) = (device(), tracked());
        let teacher = denoiser(&config["mld_denoiser"], &weights, "mld.", &plain);
        let trained = denoiser(&config["mld_denoiser"], &weights, "mld.", &tracked);
        let student = denoiser(&config["lcm_denoiser"], &weights, "lcm.", &plain);
        let mut gates = Gates::default();
        for case in io.cases() {
            match case.as_str() {
                "ddim" => ddim(&teacher, &config, &expected, &io, &mut gates),
                case if case.starts_with("lcm") => lcm(case, &student, &config, &expected, &io, &mut gates),
                case if case.starts_with("train") => train(case, &trained, &expected, &io, &mut gates),
                other => panic!("case `{other}`: what is computed here?"),
            }
        }
        gates.close(&name(&folder));
    }
}

fn steps(expected: &Value) -> Vec<usize> {
    serde_json::from_value(expected["timesteps"].clone()).expect("timesteps")
}

/// Compares latents after each step: the next step's input, and at the end the result.
fn compare(gates: &mut Gates, case: &str, seen: &[Tensor<3>], last: Tensor<3>, stored: impl Fn(usize) -> Array) {
    for (j, latent) in seen.iter().skip(1).chain([&last]).enumerate() {
        gates.tensor("trajectory", format!("{case} step {j}"), latent.clone(), &stored(j), TRAJECTORY);
    }
}

fn ddim(network: &Denoiser, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let (device, schedule) = (device(), Schedule::published());
    let count = config["ddim"]["steps"].as_u64().expect("steps") as usize;
    assert_eq!(ddim_timesteps(count), steps(&expected["ddim"]));
    let g = config["ddim"]["guidance_scale"].as_f64().expect("a guidance scale");
    let start = io.get("ddim/init_noise").tensor::<3>(&device);
    let [batch, tokens, dim] = start.dims();
    let uncond = repeated(io.get("uncond").tensor(&device), batch);
    let text = Tensor::cat(vec![io.get("text").tensor(&device), uncond], 0);
    let mut seen = Vec::new();
    let last = ddim_sample(&schedule, count, start, |z, t| {
        seen.push(z.clone());
        let pair = Tensor::cat(vec![z.clone(), z], 0);
        let eps = network.forward(pair, &vec![t; 2 * batch], text.clone(), None, &mut Dropout::off());
        let half = |b: std::ops::Range<usize>| eps.clone().slice([b, 0..tokens, 0..dim]);
        guided(half(0..batch), half(batch..2 * batch), g)
    });
    compare(gates, "ddim", &seen, last, |j| row(io.get("ddim/latents_after_step"), j));
}

fn lcm(case: &str, network: &Denoiser, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let (device, schedule) = (device(), Schedule::published());
    let settings = &config["lcm"];
    let grid = Grid::new(1000 / settings["original_inference_steps"].as_u64().expect("grid points") as usize);
    let times = steps(&expected[case]);
    let tuned = settings["timesteps_step_map"].is_object();
    let rule = if tuned { LcmTimesteps::Tuned(grid) } else { LcmTimesteps::Even(grid) };
    assert_eq!(lcm_timesteps(rule, times.len()), times, "{case}");
    let noise: Vec<Tensor<3>> =
        (0..times.len() - 1).map(|j| io.get(&format!("{case}/step_noise/{j}")).tensor(&device)).collect();
    assert_eq!(expected[case]["noise_draws"].as_u64(), Some(noise.len() as u64), "{case}");
    let guidance = io.get(&format!("{case}/w_embedding")).tensor::<2>(&device);
    let w = expected[case]["w_embedded"].as_f64().expect("a guidance scale") as f32;
    let ours = models::networks::guidance_embedding(&vec![w; guidance.dims()[0]], guidance.dims()[1], &device);
    gates.tensor("guidance sinusoid", case, ours, io.get(&format!("{case}/w_embedding")), 2e-3);

    let text = io.get("text").tensor::<3>(&device);
    let start = io.get(&format!("{case}/init_noise")).tensor::<3>(&device);
    let batch = start.dims()[0];
    let mut seen = Vec::new();
    let last = lcm_sample(&schedule, &times, start, &noise, |z, t| {
        seen.push(z.clone());
        network.forward(z, &vec![t; batch], text.clone(), Some(guidance.clone()), &mut Dropout::off())
    });
    compare(gates, case, &seen, last, |j| io.get(&format!("{case}/latents_after_step/{j}")).clone());
}

fn train(case: &str, network: &Denoiser, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let (device, schedule) = (tracked(), Schedule::published());
    let load = |part: &str| io.get(&format!("{case}/{part}")).tensor::<3>(&device);
    let times = io.get(&format!("{case}/timesteps")).usizes();
    let (a, e) = unzip(times.iter().map(|t| schedule.add_noise(*t)));
    let noisy = affine(load("z0"), load("noise"), &a, &e);
    gates.tensor("noised", case, noisy.clone(), io.get(&format!("{case}/noisy")), FORWARD);
    let eps = network.forward(noisy, &times, load("text"), None, &mut Dropout::off());
    gates.tensor("output", case, eps.clone(), io.get(&format!("{case}/eps_pred")), FORWARD);
    let loss = losses::mse(eps, load("noise")) / times.len() as f32;
    let stored = expected[format!("{case}/loss")]["diff_loss"].as_f64().expect("a loss");
    gates.check("loss", case, relative(scalar(&loss), stored), LOSS);
    let found = gradients(network, loss);
    let prefix = format!("{case}/grad");
    check_gradients(gates, &flat::layout(network), &found, &expected[&prefix], io, &prefix);
}
