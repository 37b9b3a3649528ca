//! Control: trajectory encoder, residuals, the controlled prediction with its losses and gradients,
//! copy-initialisation, a step of two groups, and controlled sampling (fixtures `02_control*`).

use std::path::Path;

use burn::tensor::{Device, Tensor};
use models::diffusion::{Grid, LcmTimesteps, Schedule, affine, ddim_sample, guided, lcm_sample, lcm_timesteps, unzip};
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::losses::{Body, ControlTarget, Pointwise, mse};
use models::networks::{
    Control, Denoiser, Hints, TrajectoryConfig, TrajectoryEncoder, Vae, copied_from, guidance_embedding,
};
use models::optim::{AdamW, clip_factor, global_norm};
use motion::skeleton::Skeleton;
use protocol::stage::{DataFormat, LatentShape, Network};
use serde_json::Value;

use crate::common::{Arrays, Gates, device, error, folders, json, name, relative, shared, tracked};
use crate::networks::{
    check_gradients, count, denoiser, denoiser_config, draws, load, only, repeated, scalar, split, vae_at,
};
use crate::{FORWARD, LOSS};

const TRAJECTORY: f64 = 1e-5;
const CHANGE: f64 = 1e-3;

/// The contents of a fixture.
struct Fixture {
    config: Value,
    expected: Value,
    io: Arrays,
    vae: Vae,
    base: Denoiser,
    control: Denoiser,
    trajectory: TrajectoryEncoder,
    body: Body,
    device: Device,
}

fn controlnet(config: &Value, device: &Device) -> Denoiser {
    let sizes = denoiser_config(config);
    let embed = config["controlnet_embed_dim"].as_u64().map_or(sizes.network.width, |width| width as usize);
    let activated = match config["controlnet_act_fn"].as_str() {
        None => false,
        Some("silu") => true,
        Some(other) => panic!("activation `{other}` does not exist here"),
    };
    Denoiser::controlnet(&sizes, embed, activated, &mut draws(device))
}

fn trajectory(config: &Value, device: &Device) -> TrajectoryEncoder {
    let latent: Vec<usize> = serde_json::from_value(config["latent_dim"].clone()).expect("two sizes");
    let width = config["hidden_dim"].as_u64().map_or(latent[1], |w| w as usize);
    only(config, &[("norm_eps", 1e-5.into())]);
    let sizes = TrajectoryConfig {
        joints: count(config, "nfeats"),
        latent: LatentShape { tokens: latent[0], dim: latent[1] },
        network: Network {
            width,
            layers: count(config, "num_layers"),
            heads: count(config, "num_heads"),
            feed_forward: count(config, "ff_size"),
            ..Network::default()
        },
        projection: config["force_post_proj"].as_bool().expect("a flag") || width != latent[1],
    };
    TrajectoryEncoder::new(&sizes, &mut draws(device))
}

impl Fixture {
    fn read(folder: &Path, device: &Device) -> Self {
        let config = json(&folder.join("config.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let plain = crate::common::device();
        let format = match count(&config, "njoints") {
            22 => DataFormat::Humanml3d,
            21 => DataFormat::Kit,
            other => panic!("{other} joints: no format has as many"),
        };
        let (mean, std) = (io.get("stats/mean").f32s(), io.get("stats/std").f32s());
        let mut body = Body::new(Skeleton::of(format), &mean, &std, &plain);
        body.metres_per_unit = 1.0;
        Self {
            vae: vae_at(&config["vae"], &weights, "vae.", &plain),
            base: denoiser(&config["denoiser"], &weights, "denoiser.", &plain),
            control: load(controlnet(&config["denoiser"], device), &weights, "controlnet."),
            trajectory: load(trajectory(&config["traj_encoder"], device), &weights, "traj_encoder."),
            expected: json(&folder.join("expected.json")),
            device: device.clone(),
            config,
            io,
            body,
        }
    }

    fn tensor<const D: usize>(&self, key: &str) -> Tensor<D> {
        self.io.get(key).tensor(&self.device)
    }

    fn hints(&self, case: &str) -> Hints {
        let values = self.io.get(&format!("{case}/hint"));
        let mask = self.io.get(&format!("{case}/hint_mask"));
        let given: Vec<bool> = mask.values.iter().map(|m| *m != 0.0).collect();
        let [batch, frames, joints] = values.shape[..3] else { panic!("{case}: a hint has four axes") };
        Hints::new(&values.f32s(), &given, (batch, frames, joints), &self.device)
    }

    /// The cases with a loss.
    fn cases(&self) -> Vec<String> {
        let has = |case: &String| self.io.find(&format!("{case}/sample_pred")).is_some();
        self.io.cases().into_iter().filter(has).collect()
    }

    /// The batch's noised latents and the controlled network's output for them.
    fn forward(&self, case: &str, control: &Denoiser, trajectory: &TrajectoryEncoder) -> Forward {
        let off = &mut Dropout::off();
        let key = |part: &str| format!("{case}/{part}");
        let lengths = self.io.get(&key("lengths")).usizes();
        let features = self.io.find(&key("features")).or(self.io.find(&key("motion"))).expect("features");
        let posterior = self.vae.encode(features.tensor(&device()), &lengths, off);
        let clean = posterior.sample(self.io.get(&key("vae_noise")).tensor(&device()));
        let times = self.io.get(&key("timesteps")).usizes();
        let schedule = Schedule::published();
        let (a, e) = unzip(times.iter().map(|t| schedule.add_noise(*t)));
        let noisy = affine(clean.clone(), self.io.get(&key("noise")).tensor(&device()), &a, &e);
        let tokens = trajectory.forward(&self.hints(case), off);
        let text = self.io.get(&key("text")).tensor::<3>(&device());
        let guidance = self.io.find(&key("w_embedding")).map(|w| w.tensor(&device()));
        let residuals = control.residuals(noisy.clone(), &times, text.clone(), guidance.clone(), tokens.clone(), off);
        let run = Control { residuals: &residuals, scale: 1.0 };
        let out = self.base.forward_controlled(noisy.clone(), &times, text, guidance, run, off);
        let (a, e) = unzip(times.iter().map(|t| schedule.clean(*t)));
        let predicted = affine(noisy.clone(), out.clone(), &a, &e);
        Forward { clean, noisy, tokens, residuals, out, predicted, lengths }
    }

    /// The loss's terms under `settings`: latent, control and features.
    fn loss(&self, case: &str, settings: &Value, forward: &Forward) -> (Tensor<1>, Tensor<1>, Option<Tensor<1>>) {
        let key = |part: &str| format!("{case}/{part}");
        let number = |name: &str| settings[name].as_f64().expect("a weight") as f32;
        let batch = forward.lengths.len() as f32;
        let latent = if self.config["denoiser"]["time_cond_proj_dim"].is_null() {
            mse(forward.out.clone(), self.tensor(&key("noise"))) / batch
        } else {
            mse(forward.predicted.clone(), forward.clean.clone()) / batch
        };
        let frames = self.io.get(&key("hint")).shape[1];
        let decoded = self.vae.decode(forward.predicted.clone(), &forward.lengths, frames, &mut Dropout::off());
        let distance = match settings["func"].as_str() {
            Some("l2") => Pointwise::L2,
            Some("l1") => Pointwise::L1,
            Some("l1_smooth") => Pointwise::SmoothL1,
            other => panic!("distance {other:?} does not exist here"),
        };
        let hint = self.io.get(&key("hint"));
        let given: Vec<bool> = self.io.get(&key("hint_mask")).values.iter().map(|m| *m != 0.0).collect();
        let joints = hint.shape[2];
        let (mean, std) = (self.io.get("stats/raw_mean").f32s(), self.io.get("stats/raw_std").f32s());
        let metres = settings["use_3d"].as_bool().expect("a flag");
        let shape = (forward.lengths.len(), frames, joints);
        let target = ControlTarget::new(&hint.f32s(), &given, shape, (&mean, &std), metres, &device());
        // The divisor of a sample's sum, over the batch according to the variant.
        let entries = target.entries();
        let all: usize = entries.iter().sum();
        let weights: Vec<f32> = entries
            .iter()
            .map(|own| match settings["vaeloss_type"].as_str() {
                Some("sum") => 1.0 / all as f32,
                Some("sum_mask") => 1.0 / (batch * *own as f32),
                Some("mask") => 1.0 / (3.0 * batch * *own as f32),
                other => panic!("mean {other:?} does not exist here"),
            })
            .collect();
        let control = target.loss(self.body.joints(decoded.clone()), distance, &weights) * number("cond_ratio");
        let features = (number("rot_ratio") > 0.0).then(|| {
            let real = self.io.find(&key("features")).or(self.io.find(&key("motion"))).expect("features");
            let weights = models::losses::FrameWeights::masked(&forward.lengths, frames, &self.device);
            let width = if settings["vaeloss_type"] == "mask" { 1.0 } else { decoded.dims()[2] as f32 };
            weights.compare(distance, decoded.clone(), real.tensor(&self.device)) * width / batch * number("rot_ratio")
        });
        (latent, control, features)
    }

    /// Names and lengths of all trained parameters, and their gradient of `loss`.
    fn gradients(&self, loss: Tensor<1>) -> (Vec<Entry>, Vec<f32>) {
        let named = |prefix: &str, entries: Vec<Entry>| -> Vec<Entry> {
            entries.into_iter().map(|e| Entry { name: format!("{prefix}{}", e.name), shape: e.shape }).collect()
        };
        let control = named("controlnet.", flat::layout(&self.control));
        let trajectory = named("traj_encoder.", flat::layout(&self.trajectory));
        let mut gradients = loss.backward();
        let first = flat::take_gradients(&self.control, &mut gradients);
        let second = flat::take_gradients(&self.trajectory, &mut gradients);
        (control.into_iter().chain(trajectory).collect(), [first, second].concat())
    }
}

struct Forward {
    clean: Tensor<3>,
    noisy: Tensor<3>,
    tokens: Tensor<3>,
    residuals: Vec<Tensor<3>>,
    out: Tensor<3>,
    predicted: Tensor<3>,
    lengths: Vec<usize>,
}

/// The variants of the loss: by name, or the single one of all cases.
fn variants(config: &Value) -> Vec<(String, Value)> {
    match config["loss_variants"].as_object() {
        Some(all) => all.iter().map(|(name, settings)| (format!("/{name}"), settings.clone())).collect(),
        None => vec![(String::new(), config["loss"].clone())],
    }
}

#[test]
fn parity_control() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["02_control"]) {
        let mut gates = Gates::default();
        let fixture = Fixture::read(&folder, &tracked());
        for case in fixture.cases() {
            // Another network in the fixture made it; `parity_control_initialisation` checks it.
            if case != "init" {
                training(&fixture, &case, &mut gates);
            }
        }
        let plain = Fixture::read(&folder, &device());
        for case in plain.io.cases().into_iter().filter(|case| case.starts_with("sample")) {
            sampling(&plain, &case, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

fn training(f: &Fixture, case: &str, gates: &mut Gates) {
    let forward = f.forward(case, &f.control, &f.trajectory);
    let what = |part: &str| format!("{case}/{part}");
    for (part, found) in [
        ("z0", &forward.clean),
        ("noisy", &forward.noisy),
        ("traj_embedding", &forward.tokens),
        ("denoiser_output", &forward.out),
    ] {
        if let Some(stored) = f.io.find(&what(part)) {
            gates.tensor("forward", what(part), found.clone(), stored, FORWARD);
        }
    }
    // At the noisiest timesteps the clean sample magnifies an output's rounding many times.
    gates.tensor("sample", case, forward.predicted.clone(), f.io.get(&what("sample_pred")), 3.0 * FORWARD);
    for (i, residual) in forward.residuals.iter().enumerate() {
        if let Some(stored) = f.io.find(&what(&format!("controlnet_residual/{i}"))) {
            // Stored with the token axis first.
            gates.tensor("residual", what(&i.to_string()), residual.clone().swap_dims(0, 1), stored, FORWARD);
        }
    }
    for (variant, settings) in variants(&f.config) {
        let stored = &f.expected[format!("{case}/loss{variant}")];
        let run = || {
            let forward = f.forward(case, &f.control, &f.trajectory);
            f.loss(case, &settings, &forward)
        };
        let total = |(latent, control, features): (Tensor<1>, Tensor<1>, Option<Tensor<1>>)| {
            let both = latent + control;
            match features {
                Some(features) => both + features,
                None => both,
            }
        };
        let (latent, control, features) = run();
        let mut parts = vec![("diff_loss", scalar(&latent)), ("cond_loss", scalar(&control))];
        parts.extend(features.as_ref().map(|term| ("rot_loss", scalar(term))));
        parts.push(("loss", scalar(&total((latent, control, features)))));
        for (key, found) in parts {
            let wanted = stored[key].as_f64().expect("a loss");
            gates.check("loss", format!("{case}{variant} {key}"), relative(found, wanted), LOSS);
        }
        let (entries, found) = f.gradients(total(run()));
        let prefix = format!("{case}/grad{variant}");
        match f.expected[format!("{case}/grad{variant}_global_norm")].as_f64() {
            Some(norm) => gates.check("grad norm", &*prefix, relative(global_norm(&found), norm), 1e-4),
            None => check_gradients(gates, &entries, &found, &f.expected[&prefix], &f.io, &prefix),
        }
        if f.expected[format!("{case}/grad_cond_only")].is_object() {
            let (entries, found) = f.gradients(run().1);
            let prefix = format!("{case}/grad_cond_only");
            check_gradients(gates, &entries, &found, &f.expected[&prefix], &f.io, &prefix);
        }
        if f.expected[format!("{case}/step")].is_object() {
            step(f, case, total(run()), gates);
        }
    }
}

/// Clips over both groups together, and applies AdamW.
fn step(f: &Fixture, case: &str, loss: Tensor<1>, gates: &mut Gates) {
    let settings = &f.config["optimizer"];
    let number = |value: &Value| value.as_f64().expect("a number");
    let adam = AdamW {
        beta1: number(&settings["AdamW"]["betas"][0]),
        beta2: number(&settings["AdamW"]["betas"][1]),
        eps: number(&settings["AdamW"]["eps"]),
        weight_decay: number(&settings["AdamW"]["weight_decay"]),
    };
    let (entries, mut grads) = f.gradients(loss);
    let stored = &f.expected[format!("{case}/step")];
    let norm = global_norm(&grads);
    gates.check("norm", case, relative(norm, number(&stored["grad_norm_before_clip"])), 1e-4);
    let factor = clip_factor(norm, number(&settings["max_grad_norm"])) as f32;
    grads.iter_mut().for_each(|g| *g *= factor);
    let before = [flat::read(&f.control), flat::read(&f.trajectory)].concat();
    let (mut after, mut m, mut v) = (before.clone(), vec![0.0; before.len()], vec![0.0; before.len()]);
    adam.step(1, number(&settings["AdamW"]["lr"]), &mut after, &grads, &mut m, &mut v);
    let change: Vec<f32> = after.iter().zip(&before).map(|(a, b)| a - b).collect();
    for (entry, values) in split(&entries, &change) {
        if let Some(wanted) = stored["parameter_change_norm"][&entry.name].as_f64() {
            gates.check("change", format!("{case} {}", entry.name), relative(global_norm(values), wanted), CHANGE);
        }
    }
    for (entry, values) in split(&entries, &after) {
        if let Some(whole) = f.io.find(&format!("{case}/step/{}", entry.name)) {
            gates.check("after the step", format!("{case} {}", entry.name), error(values, &whole.values), 1e-5);
        }
    }
}

/// Samples latents from text, hint and noise: LCM steps, or DDIM with guidance.
fn sampling(f: &Fixture, case: &str, gates: &mut Gates) {
    let off = &mut Dropout::off();
    let schedule = Schedule::published();
    let stored = &f.expected[case];
    let times: Vec<usize> = serde_json::from_value(stored["timesteps"].clone()).expect("timesteps");
    // Some fixtures sample with the text and the hint of a training case that they name.
    let from = if f.io.find(&format!("{case}/text")).is_some() { case } else { "ragged" };
    let text = f.tensor::<3>(&format!("{from}/text"));
    let tokens = f.tensor::<3>(&format!("{from}/traj_embedding"));
    if f.io.find(&format!("{from}/hint")).is_some() {
        let found = f.trajectory.forward(&f.hints(from), off);
        gates.tensor("forward", format!("{case} tokens"), found, f.io.get(&format!("{from}/traj_embedding")), FORWARD);
    }
    let start = f.tensor::<3>(&format!("{case}/init_noise"));
    let [batch, n, dim] = start.dims();
    let mut seen = Vec::new();
    let run = |z: Tensor<3>, t: usize, text: Tensor<3>, tokens: Tensor<3>, guidance: Option<Tensor<2>>| {
        let off = &mut Dropout::off();
        let times = vec![t; z.dims()[0]];
        let residuals = f.control.residuals(z.clone(), &times, text.clone(), guidance.clone(), tokens, off);
        let control = Control { residuals: &residuals, scale: 1.0 };
        f.base.forward_controlled(z, &times, text, guidance, control, off)
    };
    let last = match f.config["denoiser"]["time_cond_proj_dim"].as_u64() {
        None => {
            let scale = stored["guidance_scale"].as_f64().expect("a guidance scale");
            let nothing = repeated(f.tensor(&format!("{case}/uncond")), batch);
            let (text, tokens) = (Tensor::cat(vec![text, nothing], 0), Tensor::cat(vec![tokens.clone(), tokens], 0));
            ddim_sample(&schedule, times.len(), start, |z, t| {
                seen.push(z.clone());
                let out = run(Tensor::cat(vec![z.clone(), z], 0), t, text.clone(), tokens.clone(), None);
                let half = |from: usize| out.clone().slice([from..from + batch, 0..n, 0..dim]);
                guided(half(0), half(batch), scale)
            })
        }
        Some(width) => {
            let w = stored["w_embedded"].as_f64().expect("a guidance scale") as f32;
            let guidance = guidance_embedding(&vec![w; batch], width as usize, &f.device);
            let tuned = f.config["timesteps_step_map"].is_object() || f.config["lcm_num_ddim_timesteps"].is_u64();
            let rule = if tuned { LcmTimesteps::Tuned(Grid::new(100)) } else { LcmTimesteps::Even(Grid::new(20)) };
            assert_eq!(lcm_timesteps(rule, times.len()), times, "{case}");
            let noise: Vec<Tensor<3>> =
                (0..times.len() - 1).map(|j| f.tensor(&format!("{case}/step_noise/{j}"))).collect();
            lcm_sample(&schedule, &times, start, &noise, |z, t| {
                seen.push(z.clone());
                run(z, t, text.clone(), tokens.clone(), Some(guidance.clone()))
            })
        }
    };
    for (j, found) in seen.iter().skip(1).chain([&last]).enumerate() {
        if let Some(stored) = f.io.find(&format!("{case}/latents_after_step/{j}")) {
            gates.tensor("trajectory", format!("{case} step {j}"), found.clone(), stored, TRAJECTORY);
        }
    }
    if let Some(joints) = f.io.find(&format!("{case}/joints")) {
        let lengths = f.io.get(&format!("{case}/lengths")).usizes();
        let decoded = f.vae.decode(last, &lengths, joints.shape[1], &mut Dropout::off());
        gates.tensor("joints", case, f.body.joints(decoded), joints, TRAJECTORY);
    }
}

/// The copy of a denoiser changes nothing, and only its zero layers get a gradient.
#[test]
fn parity_control_initialisation() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["02_control_v2_temporal"]) {
        let mut f = Fixture::read(&folder, &tracked());
        let keys = f.expected["init/keys"].clone();
        let list = |key: &str| -> Vec<String> { serde_json::from_value(keys[key].clone()).expect("names") };
        let fresh = copied_from(&f.base, controlnet(&f.config["denoiser"], &f.device));
        let base: std::collections::BTreeMap<String, Vec<f32>> =
            split(&flat::layout(&f.base), &flat::read(&f.base)).map(|(e, v)| (e.name.clone(), v.to_vec())).collect();
        let (copied, kept, zero) =
            (list("copied_from_denoiser"), list("kept_own_initialisation"), list("zero_at_start"));
        for (entry, values) in split(&flat::layout(&fresh), &flat::read(&fresh)) {
            let same = base.get(&entry.name).is_some_and(|own| own == values);
            // Upstream's lists may contain the norm at the end, which a ControlNet does not use.
            assert_eq!(copied.contains(&entry.name), same, "{} is copied", entry.name);
            assert_eq!(kept.contains(&entry.name), !same, "{} keeps its own", entry.name);
            assert_eq!(zero.contains(&entry.name), values.iter().all(|v| *v == 0.0), "{} is zero", entry.name);
        }
        // The two inner layers of the condition embedding come from the fixture.
        let weights = Arrays::read(&folder.join("weights.safetensors"));
        let mut values = flat::read(&fresh);
        let mut at = 0;
        for entry in flat::layout(&fresh) {
            if let Some(stored) = weights.find(&format!("init.controlnet.{}", entry.name)) {
                values[at..at + entry.len()].copy_from_slice(&stored.f32s());
            }
            at += entry.len();
        }
        f.control = flat::write(fresh, &values);
        let mut gates = Gates::default();
        let forward = f.forward("init", &f.control, &f.trajectory);
        gates.tensor("forward", "init", forward.out.clone(), f.io.get("init/denoiser_output"), FORWARD);
        let (_, settings) = variants(&f.config).remove(0);
        let total = |forward: &Forward| {
            let (latent, control, _) = f.loss("init", &settings, forward);
            latent + control
        };
        let wanted = f.expected["init/loss"]["loss"].as_f64().expect("a loss");
        gates.check("loss", "init", relative(scalar(&total(&forward)), wanted), LOSS);
        let (entries, found) = f.gradients(total(&f.forward("init", &f.control, &f.trajectory)));
        let stored = &f.expected["init/grad"];
        let norm = stored["global_norm"].as_f64().expect("a norm");
        gates.check("grad norm", "init", relative(global_norm(&found), norm), 1e-4);
        for (entry, values) in split(&entries, &found) {
            match stored["nonzero"][&entry.name].as_f64() {
                Some(wanted) => {
                    gates.check("grad of parameter", &*entry.name, relative(global_norm(values), wanted), 1e-3);
                }
                None => assert_eq!(global_norm(values), 0.0, "{} gets no gradient yet", entry.name),
            }
        }
        gates.close(&name(&folder));
    }
}
