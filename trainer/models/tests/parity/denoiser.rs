//! The denoiser's forward pass (fixtures `02_denoiser*`).

use burn::tensor::{Device, Tensor};
use models::diffusion::guided;
use models::kernels::Dropout;
use models::networks::{Denoiser, guidance_embedding, time_sinusoid};

use crate::FORWARD;
use crate::common::{Arrays, Gates, device, folders, json, name, shared, tracked, values};
use crate::networks::{denoiser, repeated, timesteps};

/// Gate of the time embedding. Arguments up to 1000 magnify the rounding of a frequency. Ours is the nearest f32; some
/// of the stored ones come from an exponential that is off by a bit.
const TIME: f64 = 1e-4;
const GUIDANCE: f64 = 2e-3;

#[test]
fn parity_denoiser() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["02_denoiser"]) {
        let config = json(&folder.join("config.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        let weights = folder.join("weights.safetensors");
        // The kernels have separate paths with and without autodiff.
        for device in [device(), tracked()] {
            let network = denoiser(&config["constructor"], &weights, "", &device);
            for case in io.cases() {
                if io.find(&format!("{case}/output_pair")).is_some() {
                    pair(&case, &network, &io, &device, &mut gates);
                } else {
                    one(&case, &network, &io, &device, &mut gates);
                }
            }
        }
        gates.close(&name(&folder));
    }
}

/// The stored guidance embedding, after a check that ours is close to it.
fn guidance(case: &str, io: &Arrays, device: &Device, gates: &mut Gates) -> Option<Tensor<2>> {
    let stored = io.find(&format!("{case}/w_embedding"))?;
    let ours = guidance_embedding(&io.get(&format!("{case}/w")).f32s(), stored.shape[1], device);
    gates.tensor("guidance sinusoid", case, ours, stored, GUIDANCE);
    Some(stored.tensor(device))
}

fn one(case: &str, network: &Denoiser, io: &Arrays, device: &Device, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let find = |part: &str| io.find(&format!("{case}/{part}"));
    let what = |part: &str| format!("{case}/{part}");
    let sample = stored("sample").tensor::<3>(device);
    let batch = sample.dims()[0];
    let times = timesteps(stored("timestep"), batch);
    let text = stored("text").tensor::<3>(device);
    let guidance = guidance(case, io, device, gates);
    if let Some(sinusoid) = find("time_sinusoid") {
        gates.tensor(
            "time sinusoid",
            what("sinusoid"),
            time_sinusoid(&times, sinusoid.shape[1], device),
            sinusoid,
            TIME,
        );
    }
    if let Some(token) = find("time_embedding") {
        let found = network.time_token(&times, guidance.clone(), device);
        gates.tensor("time token", what("time"), found, token, FORWARD);
    }
    let run = |guidance| network.forward(sample.clone(), &times, text.clone(), guidance, &mut Dropout::off());
    if let Some(output) = find("output_no_w") {
        gates.tensor("output", what("output_no_w"), run(None), output, FORWARD);
        let differs = values(run(guidance.clone())) != values(run(None));
        assert!(differs, "{case}: the guidance embedding reaches the output");
    }
    gates.tensor("output", what("output"), run(guidance), stored("output"), FORWARD);
}

/// Classifier-free guidance: text half first.
fn pair(case: &str, network: &Denoiser, io: &Arrays, device: &Device, gates: &mut Gates) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let sample = stored("sample").tensor::<3>(device);
    let [batch, tokens, dim] = sample.dims();
    let times = timesteps(stored("timestep"), 2 * batch);
    let uncond = repeated(stored("uncond").tensor(device), batch);
    let text = Tensor::cat(vec![stored("text").tensor(device), uncond], 0);
    let guidance = guidance(case, io, device, gates);
    let double = Tensor::cat(vec![sample.clone(), sample], 0);
    let output = network.forward(double, &times, text, guidance, &mut Dropout::off());
    gates.tensor("output", format!("{case}/pair"), output.clone(), stored("output_pair"), FORWARD);
    // Guidance magnifies the rounding differences of two passes by 2g - 1, so it starts from the stored passes.
    let output = stored("output_pair").tensor::<3>(device);
    let half = |b: std::ops::Range<usize>| output.clone().slice([b, 0..tokens, 0..dim]);
    for g in io.names().filter_map(|n| n.strip_prefix(&format!("{case}/guided_"))) {
        let found = guided(half(0..batch), half(batch..2 * batch), g.parse().expect("a guidance scale in the name"));
        gates.tensor("guided", format!("{case}/guided_{g}"), found, stored(&format!("guided_{g}")), FORWARD);
    }
}
