//! One whole iteration of phased consistency distillation with its discriminator, and the deterministic sampler
//! (fixtures `11_pcm_step*`). The fixtures implement our reading of the paper, which has no independent confirmation:
//! see their README.
//!
//! Intermediates are computed from stored inputs, so that each line has an error of its own. Losses, gradients and
//! updates are results of the whole chain.

use std::ops::Deref;
use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use models::diffusion::{Phases, affine, guided_by, pcm_sample, unzip};
use models::flat::{self, Entry};
use models::kernels::Dropout;
use models::networks::{Denoiser, Discriminator, Init, guidance_embedding};
use models::optim::{clip_factor, ema, global_norm};
use models::{losses, names};
use protocol::Seed;
use protocol::stage::Positions;
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, device, error, folders, json, name, relative, shared, tracked, values};
use crate::distillation::{Networks, adam};
use crate::networks::{check_gradients, gradients, repeated, scalar, split};
use crate::{FORWARD, LOSS};

/// Gate of the sampler's jumps, one after the other.
const TRAJECTORY: f64 = 1e-5;
/// Gate of parameters after one update.
const WEIGHTS: f64 = 1e-5;
/// Gate of the norm of a parameter's change in the first update, which is nearly the sign of its gradient.
const CHANGE: f64 = 1e-3;
/// Gate of gradients with respect to single tensors.
const GRADIENT: f64 = 1e-4;

struct Fixture<'a> {
    config: &'a Value,
    expected: &'a Value,
    io: &'a Arrays,
    networks: Networks,
    heads: Discriminator,
}

impl Deref for Fixture<'_> {
    type Target = Networks;

    fn deref(&self) -> &Networks {
        &self.networks
    }
}

#[test]
fn parity_pcm_step() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["11_pcm_step"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let student = &config["denoiser"];
        let mut teacher = student.clone();
        teacher["time_cond_proj_dim"] = Value::Null;
        let fixture = Fixture {
            networks: Networks::read(&teacher, student, &weights, &config["grid"]),
            heads: heads(&config, &weights, &tracked()),
            config: &config,
            expected: &expected,
            io: &io,
        };
        let mut gates = Gates::default();
        fixture.tables(&mut gates);
        for case in config["cases"].as_object().expect("cases").keys() {
            let step = Step::read(&fixture, case);
            step.times();
            step.intermediates(&mut gates);
            step.update(&mut gates);
        }
        for case in config["samples"].as_object().expect("samples").keys() {
            fixture.sample(case, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

/// A head's parameters under the fixture's names.
fn stored_entries(heads: &Discriminator) -> Vec<Entry> {
    let words = [("linear1", "lin1"), ("linear2", "lin2"), ("score", "out")];
    let renamed = |mut entry: Entry| {
        for (ours, theirs) in words {
            entry.name = entry.name.replace(&format!(".{ours}."), &format!(".{theirs}."));
        }
        entry
    };
    flat::layout(heads).into_iter().map(renamed).collect()
}

fn heads(config: &Value, weights: &Path, device: &Device) -> Discriminator {
    let network = &config["denoiser"];
    let size = |key: &str| network[key].as_u64().expect("a size") as usize;
    let blank = Discriminator::new(
        size("num_layers"),
        size("hidden_dim"),
        config["discriminator"]["leaky_relu_slope"].as_f64().expect("a slope"),
        &mut Init::new(Seed(1), "parity", Positions::Uniform, device),
    );
    assert_eq!(config["discriminator"]["heads"].as_u64(), Some(blank.heads.len() as u64), "one head a block");
    let bytes = std::fs::read(weights).expect("weights can be read");
    let values = names::from_bytes(&stored_entries(&blank), &bytes, "discriminator.").unwrap_or_else(|e| panic!("{e}"));
    flat::write(blank, &values)
}

impl Fixture<'_> {
    fn tables(&self, gates: &mut Gates) {
        let stored = |part: &str| self.io.get(&format!("tables/{part}"));
        let times: Vec<usize> = (0..self.grid.steps).map(|i| self.grid.tau(i)).collect();
        let before: Vec<usize> = (0..self.grid.steps).map(|i| self.grid.prev(i)).collect();
        assert_eq!(times, stored("grid_timesteps").usizes());
        assert_eq!(before, stored("grid_timesteps_prev").usizes());
        let all: Vec<f32> = (0..1000).map(|t| self.schedule.alpha_bar(t) as f32).collect();
        gates.check("table", "alphas", error(&all, &stored("alphas_cumprod").values), 0.0);
    }

    fn number(&self, key: &str) -> f64 {
        self.config[key].as_f64().unwrap_or_else(|| panic!("`{key}` is a number"))
    }

    /// The student's jumps from pure noise.
    fn sample(&self, case: &str, gates: &mut Gates) {
        let device = device();
        let stored = |part: &str| self.io.get(&format!("{case}/{part}"));
        let phases = Phases::new(&self.grid, self.config["samples"][case]["phases"].as_u64().expect("M") as usize);
        let path: Vec<usize> = serde_json::from_value(self.expected[case]["path"].clone()).expect("timesteps");
        let ours = phases.path();
        assert_eq!(ours.iter().map(|(from, _)| *from).chain([0]).collect::<Vec<_>>(), path, "{case}");
        let w = stored("w").f32s();
        assert_eq!(Some(f64::from(w[0])), self.expected[case]["w_embedded"].as_f64(), "{case}: w as it is");
        let embedding = stored("w_embedding").tensor::<2>(&device);
        let ours = guidance_embedding(&w, embedding.dims()[1], &device);
        gates.tensor("guidance sinusoid", case, ours, stored("w_embedding"), 2e-3);

        let student = denoiser_on(&self.student, &device);
        let (text, start) = (stored("text").tensor::<3>(&device), stored("init_noise").tensor::<3>(&device));
        let batch = start.dims()[0];
        let mut seen = Vec::new();
        let last = pcm_sample(&self.schedule, &phases, start, |z, t| {
            seen.push(z.clone());
            student.forward(z, &vec![t; batch], text.clone(), Some(embedding.clone()), &mut Dropout::off())
        });
        for (j, latent) in seen.into_iter().skip(1).chain([last]).enumerate() {
            let expected = stored(&format!("latents_after_jump/{j}"));
            gates.tensor("trajectory", format!("{case} jump {j}"), latent, expected, TRAJECTORY);
        }
    }
}

fn denoiser_on(network: &Denoiser, device: &Device) -> Denoiser {
    network.clone().valid().to_device(device)
}

/// One case: its draws, and the times computed from them.
struct Step<'a> {
    fixture: &'a Fixture<'a>,
    case: &'a str,
    phases: Phases,
    index: Vec<usize>,
    start: Vec<usize>,
    prev: Vec<usize>,
    end: Vec<usize>,
    next: Vec<usize>,
    levels: Vec<usize>,
}

/// The results of the chain, on the tape of the student.
struct Chain {
    /// The noise that the student predicts.
    eps: Tensor<3>,
    consistency: Tensor<1>,
    fake: Tensor<3>,
    real: Tensor<3>,
}

impl<'a> Step<'a> {
    fn read(fixture: &'a Fixture<'a>, case: &'a str) -> Self {
        let count = fixture.config["cases"][case]["phases"].as_u64().expect("M") as usize;
        let phases = Phases::new(&fixture.grid, count);
        let index = fixture.io.get(&format!("{case}/grid_index")).usizes();
        let of = |rule: &dyn Fn(usize) -> usize| index.iter().map(|i| rule(*i)).collect::<Vec<_>>();
        let (start, prev) = (of(&|i| fixture.grid.tau(i)), of(&|i| fixture.grid.prev(i)));
        let end = of(&|i| phases.edge_time(phases.phase_of(i)));
        let next = of(&|i| phases.next_edge_time(phases.phase_of(i)));
        let draws = fixture.io.get(&format!("{case}/level_u"));
        // The product is in f32: .9 of 1000 is 900 there.
        let level = |((u, end), next): ((f32, &usize), &usize)| end + (u * (next - end) as f32).floor() as usize;
        let levels = draws.f32s().into_iter().zip(&end).zip(&next).map(level).collect();
        Self { fixture, case, phases, index, start, prev, end, next, levels }
    }

    fn stored(&self, part: &str) -> &Array {
        self.fixture.io.get(&format!("{}/{part}", self.case))
    }

    fn load(&self, part: &str, device: &Device) -> Tensor<3> {
        self.stored(part).tensor(device)
    }

    fn expected(&self, part: &str) -> &Value {
        &self.fixture.expected[format!("{}/{part}", self.case)]
    }

    fn times(&self) {
        assert_eq!(self.phases.edges, self.stored("edge_grid_index").usizes());
        let edges: Vec<usize> = (0..self.phases.edges.len()).map(|m| self.phases.edge_time(m)).collect();
        assert_eq!(edges, self.stored("edge_timestep").usizes());
        assert_eq!(self.start, self.stored("start_timestep").usizes());
        assert_eq!(self.prev, self.stored("prev_timestep").usizes());
        assert_eq!(self.end, self.stored("end_timestep").usizes());
        assert_eq!(self.next, self.stored("next_edge").usizes());
        assert_eq!(self.levels, self.stored("level").usizes());
        for (b, i) in self.index.iter().enumerate() {
            assert_eq!(self.stored("c_out_online").values[b], 1.0, "the online network is never at an edge");
            assert_eq!(self.stored("c_skip_target").values[b] == 1.0, self.phases.is_edge(*i), "grid index {i}");
        }
    }

    /// Computes `a z + e eps` with a rule's coefficients for each example.
    fn map(&self, z: Tensor<3>, eps: Tensor<3>, pairs: impl Iterator<Item = (f64, f64)>) -> Tensor<3> {
        let (a, e) = unzip(pairs);
        affine(z, eps, &a, &e)
    }

    fn jumps<'b>(&'b self, from: &'b [usize], to: &'b [usize]) -> impl Iterator<Item = (f64, f64)> + 'b {
        from.iter().zip(to).map(|(t, s)| self.fixture.schedule.jump(*t, *s))
    }

    /// The latents noised to the start of the step.
    fn noised(&self, device: &Device) -> Tensor<3> {
        let pairs = self.start.iter().map(|t| self.fixture.schedule.add_noise(*t));
        self.map(self.load("z0", device), self.load("noise", device), pairs)
    }

    /// The teacher's guided step from `z`, whose two predictions are `cond` and `uncond`.
    fn solved(&self, z: Tensor<3>, cond: Tensor<3>, uncond: Tensor<3>) -> Tensor<3> {
        let guided = guided_by(cond, uncond, &self.stored("w").f32s());
        self.map(z, guided, self.jumps(&self.start, &self.prev))
    }

    fn fake(&self, prediction: Tensor<3>) -> Tensor<3> {
        let noise = self.load("noise_fake", &prediction.device());
        let rule = self.end.iter().zip(&self.levels).map(|(m, s)| self.fixture.schedule.transition(*m, *s));
        self.map(prediction, noise, rule)
    }

    fn real(&self, device: &Device) -> Tensor<3> {
        let pairs = self.levels.iter().map(|s| self.fixture.schedule.add_noise(*s));
        self.map(self.load("z0", device), self.load("noise_real", device), pairs)
    }

    /// Block features of the frozen teacher at the noise levels.
    fn features(&self, z: Tensor<3>) -> Vec<Tensor<3>> {
        let text = self.load("text", &z.device());
        self.fixture.teacher.features(z, &self.levels, text, &mut Dropout::off())
    }

    fn intermediates(&self, gates: &mut Gates) {
        let device = device();
        let (fixture, off) = (self.fixture, &mut Dropout::off());
        let load = |part: &str| self.load(part, &device);
        let text = load("text");
        let uncond = repeated(load("uncond"), self.start.len());
        let guidance = self.stored("w_embedding").tensor::<2>(&device);
        let teach = |text, off: &mut Dropout| fixture.teacher.forward(load("z_t"), &self.start, text, None, off);
        let found = [
            ("z_t", self.noised(&device)),
            ("teacher_cond_eps", teach(text.clone(), off)),
            ("teacher_uncond_eps", teach(uncond, off)),
            ("z_prev", self.solved(load("z_t"), load("teacher_cond_eps"), load("teacher_uncond_eps"))),
            ("target_eps", fixture.target.forward(load("z_prev"), &self.prev, text, Some(guidance), off)),
            ("target", self.map(load("z_prev"), load("target_eps"), self.jumps(&self.prev, &self.end))),
            ("phased_prediction", self.map(load("z_t"), load("student_eps"), self.jumps(&self.start, &self.end))),
            ("fake", self.fake(load("phased_prediction"))),
            ("real", self.real(&device)),
        ];
        for (part, tensor) in found {
            gates.tensor("intermediate", format!("{} {part}", self.case), tensor, self.stored(part), FORWARD);
        }
        let heads = fixture.heads.valid();
        for side in ["fake", "real"] {
            for (i, score) in heads.forward(self.features(load(side))).into_iter().enumerate() {
                let part = format!("score_{side}/{i}");
                gates.tensor("score", format!("{} {part}", self.case), score, self.stored(&part), FORWARD);
            }
        }
    }

    /// Computes the whole chain, each part from the one before. With `leaf` the student's noise is a leaf of the tape.
    fn chain(&self, leaf: bool, gates: &mut Gates) -> Chain {
        let (fixture, plain, tracked, off) = (self.fixture, device(), tracked(), &mut Dropout::off());
        let onto = |x: Tensor<3>| Tensor::<3>::from_data(x.into_data(), &tracked);
        let noised = self.noised(&plain);
        let text = self.load("text", &plain);
        let uncond = repeated(self.load("uncond", &plain), self.start.len());
        let guidance = |device: &Device| self.stored("w_embedding").tensor::<2>(device);
        let cond = fixture.teacher.forward(noised.clone(), &self.start, text.clone(), None, off);
        let uncond = fixture.teacher.forward(noised.clone(), &self.start, uncond, None, off);
        let solved = self.solved(noised.clone(), cond, uncond);
        let eps = fixture.target.forward(solved.clone(), &self.prev, text, Some(guidance(&plain)), off);
        let target = self.map(solved, eps, self.jumps(&self.prev, &self.end));

        let (noised, text) = (onto(noised), self.load("text", &tracked));
        let eps = fixture.student.forward(noised.clone(), &self.start, text, Some(guidance(&tracked)), off);
        let eps = if leaf { onto(eps).require_grad() } else { eps };
        gates.tensor("student", self.case, eps.clone(), self.stored("student_eps"), FORWARD);
        let prediction = self.map(noised, eps.clone(), self.jumps(&self.start, &self.end));
        let batch = self.start.len() as f32;
        let consistency = losses::pseudo_huber(prediction.clone(), onto(target), fixture.number("huber_c")) / batch;
        Chain { eps, consistency, fake: self.fake(prediction), real: self.real(&plain) }
    }

    /// The generator's loss on `fake`, which may be on a tape.
    fn adversarial(&self, fake: Tensor<3>) -> Tensor<1> {
        losses::hinge_generator(self.fixture.heads.valid().forward(self.features(fake))) / self.start.len() as f32
    }

    fn update(&self, gates: &mut Gates) {
        let (fixture, case, batch) = (self.fixture, self.case, self.start.len() as f32);
        let weight = fixture.number("lambda_adv") as f32;
        let loss = |what: &'static str, found: &Tensor<1>, stored: &Value, gates: &mut Gates| {
            gates.check(
                "loss",
                format!("{case} {what}"),
                relative(scalar(found), stored.as_f64().expect("a loss")),
                LOSS,
            );
        };
        let stored = self.expected("loss");
        let chain = self.chain(false, gates);
        let adversarial = self.adversarial(chain.fake.clone());
        let total = chain.consistency.clone() + adversarial.clone() * weight;
        loss("huber", &chain.consistency, &stored["huber"], gates);
        loss("adversarial", &adversarial, &stored["adversarial"], gates);
        loss("generator", &total, &stored["generator_total"], gates);
        let fakes: Vec<Tensor<3>> = self.features(chain.fake.clone().inner());
        let reals: Vec<Tensor<3>> = self.features(chain.real.clone());
        let critic =
            losses::hinge_discriminator(fixture.heads.forward(reals.clone()), fixture.heads.forward(fakes.clone()))
                / batch;
        loss("discriminator", &critic, &stored["discriminator"], gates);
        for (i, (fake, real)) in fakes.into_iter().zip(reals).enumerate() {
            let head = Discriminator { heads: vec![fixture.heads.heads[i].clone()], ..fixture.heads.clone() };
            let one = losses::hinge_generator(head.forward(vec![fake.clone()])) / batch;
            loss("head, generator", &one, &stored["head_generator_terms"][i], gates);
            let one = losses::hinge_discriminator(head.forward(vec![real]), head.forward(vec![fake])) / batch;
            loss("head, discriminator", &one, &stored["head_discriminator_terms"][i], gates);
        }

        let expected = self.expected("grad");
        let entries = flat::layout(&fixture.student);
        let prefix = format!("{case}/grad/student");
        let student = gradients(&fixture.student, total);
        check_gradients(gates, &entries, &student, &expected["student"], fixture.io, &prefix);
        let alone = gradients(&fixture.student, self.chain(false, gates).consistency);
        let norm = expected["student_huber_only_global_norm"].as_f64().expect("a norm");
        gates.check("grad norm", format!("{case} huber only"), relative(global_norm(&alone), norm), GRADIENT);
        let alone = gradients(&fixture.student, self.adversarial(self.chain(false, gates).fake) * weight);
        let part = "student_weighted_adversarial_only";
        check_gradients(gates, &entries, &alone, &expected[part], fixture.io, &format!("{case}/{part}"));
        let heads = gradients(&fixture.heads, critic);
        let named = stored_entries(&fixture.heads);
        let prefix = format!("{case}/grad/discriminator");
        check_gradients(gates, &named, &heads, &expected["discriminator"], fixture.io, &prefix);
        self.inner_gradients(weight, gates);

        let target = flat::read(&fixture.target);
        self.step(("student", &entries, flat::read(&fixture.student), student), Some(target), gates);
        self.step(("discriminator", &named, flat::read(&fixture.heads), heads), None, gates);
    }

    /// Checks gradients with respect to the student's noise, and to the fake alone.
    fn inner_gradients(&self, weight: f32, gates: &mut Gates) {
        let chain = self.chain(true, gates);
        let total = chain.consistency + self.adversarial(chain.fake.clone()) * weight;
        let fake = Tensor::<3>::from_data(chain.fake.into_data(), &tracked()).require_grad();
        let alone = self.adversarial(fake.clone()) * weight;
        for (leaf, loss, part) in
            [(chain.eps, total, "grad_student_eps"), (fake, alone, "grad_fake_of_weighted_adversarial")]
        {
            let found = leaf.grad(&loss.backward()).expect("a leaf has a gradient");
            let off = error(&values(found), &self.stored(part).values);
            gates.check("inner grad", format!("{} {part}", self.case), off, GRADIENT);
        }
    }

    /// Clips and applies AdamW to one network, and moves the average of `average` if one is kept.
    fn step(
        &self,
        (network, entries, before, mut grads): (&'static str, &[Entry], Vec<f32>, Vec<f32>),
        average: Option<Vec<f32>>,
        gates: &mut Gates,
    ) {
        let (fixture, case) = (self.fixture, self.case);
        let expected = self.expected("step");
        let norm = global_norm(&grads);
        let stored = expected[format!("{network}_norm_before_clip")].as_f64().expect("a norm");
        gates.check("clip", format!("{case} {network}"), relative(norm, stored), 1e-4);
        let factor = clip_factor(norm, fixture.config["optimizer"]["max_grad_norm"].as_f64().expect("a norm"));
        grads.iter_mut().for_each(|g| *g *= factor as f32);
        let (adam, lr) = adam(&fixture.config["optimizer"][network]["AdamW"]);
        let mut weights = before.clone();
        let (mut m, mut v) = (vec![0.0; weights.len()], vec![0.0; weights.len()]);
        adam.step(1, lr, &mut weights, &grads, &mut m, &mut v);
        let mut check = |which: &'static str, before: &[f32], after: &[f32]| {
            if let Some(stored) = expected[format!("{which}_change_norm")].as_object() {
                // The gradient of key rows in an attention's bias is only rounding; the fixture leaves the tensor out.
                let change: Vec<f32> = after.iter().zip(before).map(|(a, b)| a - b).collect();
                let left_out = |entry: &Entry| entry.name.ends_with("in_proj_bias");
                assert_eq!(stored.len(), entries.iter().filter(|entry| !left_out(entry)).count(), "{case} {which}");
                for (entry, values) in split(entries, &change).filter(|(entry, _)| !left_out(entry)) {
                    let wanted = stored[&entry.name].as_f64().expect("a norm");
                    let what = format!("{case} {which} {}", entry.name);
                    gates.check("change", what, relative(global_norm(values), wanted), CHANGE);
                }
            }
            let mut whole = 0;
            for (entry, values) in split(entries, after) {
                if let Some(stored) = fixture.io.find(&format!("{case}/step/{which}/{}", entry.name)) {
                    whole += 1;
                    let what = format!("{case} {which} {}", entry.name);
                    gates.check("whole weights", what, error(values, &stored.values), WEIGHTS);
                }
            }
            assert!(whole > 0, "{case} {which}: some weights are stored whole");
        };
        check(network, &before, &weights);
        if let Some(before) = average {
            let mut after = before.clone();
            ema(&mut after, &weights, fixture.config["optimizer"]["ema"].as_f64().expect("a decay"));
            check("target", &before, &after);
        }
    }
}
