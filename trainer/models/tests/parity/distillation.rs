//! One step of latent consistency distillation (fixtures `03_distill*`): every intermediate, loss and gradients, and
//! the clip, AdamW and moving average after it.
//!
//! Intermediates are computed from stored inputs, so that each line has an error of its own. Loss, gradients and update
//! are results of the whole chain.

use std::ops::Deref;
use std::path::Path;

use burn::tensor::{Device, Tensor};
use models::diffusion::{Grid, Schedule, affine, boundary, consistency, guided_by, unzip};
use models::flat;
use models::kernels::Dropout;
use models::losses;
use models::networks::{Denoiser, guidance_embedding};
use models::optim::{AdamW, clip_factor, ema, global_norm};
use serde_json::Value;

use crate::common::{Arrays, Gates, device, error, folders, json, name, relative, shared, tracked};
use crate::networks::{check_gradients, denoiser, gradients, repeated, scalar, split};
use crate::{FORWARD, LOSS};

/// Gate of parameters after one update.
const WEIGHTS: f64 = 1e-5;
/// Gate of the norm of a parameter's change in the first update, which is nearly the sign of its gradient.
const CHANGE: f64 = 1e-3;

struct Step<'a> {
    config: &'a Value,
    expected: &'a Value,
    io: &'a Arrays,
    networks: Networks,
}

/// The networks of a distillation, and the grid of its solver.
pub(crate) struct Networks {
    pub(crate) teacher: Denoiser,
    /// The student, on a device that tracks gradients.
    pub(crate) student: Denoiser,
    pub(crate) target: Denoiser,
    pub(crate) grid: Grid,
    pub(crate) schedule: Schedule,
}

impl Networks {
    /// Reads the networks from a teacher's and a student's config, their weights, and the number of grid points.
    pub(crate) fn read(teacher: &Value, student: &Value, weights: &Path, points: &Value) -> Self {
        let (plain, tracked) = (device(), tracked());
        Self {
            teacher: denoiser(teacher, weights, "teacher.", &plain),
            student: denoiser(student, weights, "student.", &tracked),
            target: denoiser(student, weights, "target.", &plain),
            grid: Grid::new(1000 / points.as_u64().expect("grid points") as usize),
            schedule: Schedule::published(),
        }
    }
}

/// The optimizer of a config, and its learning rate.
pub(crate) fn adam(settings: &Value) -> (AdamW, f64) {
    let number = |value: &Value| value.as_f64().expect("a number");
    let adam = AdamW {
        beta1: number(&settings["betas"][0]),
        beta2: number(&settings["betas"][1]),
        eps: number(&settings["eps"]),
        weight_decay: number(&settings["weight_decay"]),
    };
    (adam, number(&settings["lr"]))
}

impl Deref for Step<'_> {
    type Target = Networks;

    fn deref(&self) -> &Networks {
        &self.networks
    }
}

#[test]
fn parity_distillation() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["03_distill"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let weights = folder.join("weights.safetensors");
        let (teacher, student) = (&config["teacher"], &config["student_and_target"]);
        let step = Step {
            networks: Networks::read(teacher, student, &weights, &config["num_ddim_timesteps"]),
            config: &config,
            expected: &expected,
            io: &io,
        };
        let mut gates = Gates::default();
        step.tables(&mut gates);
        for case in io.cases().into_iter().filter(|case| case != "tables") {
            step.intermediates(&case, &mut gates);
            step.update(&case, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

impl Step<'_> {
    fn tables(&self, gates: &mut Gates) {
        let stored = |part: &str| self.io.get(&format!("tables/{part}"));
        let times: Vec<usize> = (0..self.grid.steps).map(|i| self.grid.tau(i)).collect();
        assert_eq!(times, stored("ddim_timesteps").usizes());
        let table = |times: Vec<usize>| times.iter().map(|t| self.schedule.alpha_bar(*t) as f32).collect::<Vec<_>>();
        let all = table((0..1000).collect());
        gates.check("table", "alphas", error(&all, &stored("alphas_cumprod").values), 0.0);
        gates.check("table", "solver", error(&table(times), &stored("ddim_alpha_cumprods").values), 0.0);
        let before = table((0..self.grid.steps).map(|i| self.grid.prev(i)).collect());
        gates.check("table", "solver, before", error(&before, &stored("ddim_alpha_cumprods_prev_f64").values), 0.0);
    }

    /// Start and end of every example's solver step.
    fn times(&self, case: &str) -> (Vec<usize>, Vec<usize>) {
        let index = self.io.get(&format!("{case}/grid_index")).usizes();
        (index.iter().map(|i| self.grid.tau(*i)).collect(), index.iter().map(|i| self.grid.prev(*i)).collect())
    }

    fn load(&self, case: &str, part: &str, device: &Device) -> Tensor<3> {
        self.io.get(&format!("{case}/{part}")).tensor(device)
    }

    /// The stored embedding: with arguments up to 15,000 ours differs from it by rounding.
    fn guidance(&self, case: &str, device: &Device) -> Tensor<2> {
        self.io.get(&format!("{case}/w_embedding")).tensor(device)
    }

    fn intermediates(&self, case: &str, gates: &mut Gates) {
        let device = device();
        let stored = |part: &str| self.io.get(&format!("{case}/{part}"));
        let load = |part: &str| self.load(case, part, &device);
        let what = |part: &str| format!("{case}/{part}");
        let (start, end) = self.times(case);
        assert_eq!(start, stored("start_timesteps").usizes());
        assert_eq!(end, stored("timesteps").usizes());
        for (times, suffix) in [(&start, "_start"), (&end, "")] {
            let (skip, out) = unzip(times.iter().map(|t| boundary(*t)));
            let c = |part: &str| stored(&format!("{part}{suffix}")).values.clone();
            gates.check("boundary", what("c_skip"), error(&skip, &c("c_skip")), FORWARD);
            gates.check("boundary", what("c_out"), error(&out, &c("c_out")), FORWARD);
        }

        let map = |z: &str, eps: &str, times: &[usize], rule: &dyn Fn(usize) -> (f64, f64)| {
            let (a, e) = unzip(times.iter().map(|t| rule(*t)));
            affine(load(z), load(eps), &a, &e)
        };
        let clean = |t| self.schedule.clean(t);
        let mut check = |found: Tensor<3>, part: &str| {
            gates.tensor("intermediate", what(part), found, stored(part), FORWARD);
        };
        check(map("z0", "noise", &start, &|t| self.schedule.add_noise(t)), "noisy");
        check(map("noisy", "student_eps", &start, &clean), "student_x0");
        check(map("noisy", "student_eps", &start, &|t| consistency(&self.schedule, t)), "model_pred");
        check(map("noisy", "teacher_cond_eps", &start, &clean), "teacher_cond_x0");
        check(map("noisy", "teacher_uncond_eps", &start, &clean), "teacher_uncond_x0");
        let w = stored("w").f32s();
        check(guided_by(load("teacher_cond_eps"), load("teacher_uncond_eps"), &w), "cfg_eps");
        check(map("noisy", "cfg_eps", &start, &clean), "cfg_x0");
        let (a, e) = unzip(start.iter().zip(&end).map(|(t, s)| self.schedule.jump(*t, *s)));
        check(affine(load("noisy"), load("cfg_eps"), &a, &e), "z_prev_f64");
        check(map("z_prev_f64", "target_eps", &end, &clean), "target_x0_f64");
        check(map("z_prev_f64", "target_eps", &end, &|t| consistency(&self.schedule, t)), "target_f64");

        let (text, uncond) = (load("text"), repeated(load("uncond"), start.len()));
        let teach = |text| self.teacher.forward(load("noisy"), &start, text, None, &mut Dropout::off());
        check(teach(text.clone()), "teacher_cond_eps");
        check(teach(uncond), "teacher_uncond_eps");
        let guidance = self.guidance(case, &device);
        let off = &mut Dropout::off();
        check(self.target.forward(load("z_prev_f64"), &end, text, Some(guidance.clone()), off), "target_eps");
        let ours = guidance_embedding(&w, guidance.dims()[1], &device);
        gates.tensor("guidance sinusoid", case, ours, stored("w_embedding"), 2e-3);
    }

    /// Predictions of student and target, by the whole chain.
    fn chain(&self, case: &str, gates: &mut Gates) -> (Tensor<3>, Tensor<3>) {
        let (plain, tracked) = (device(), tracked());
        let (start, end) = self.times(case);
        let (a, e) = unzip(start.iter().map(|t| self.schedule.add_noise(*t)));
        let noisy = affine(self.load(case, "z0", &plain), self.load(case, "noise", &plain), &a, &e);
        let text = self.load(case, "text", &plain);
        let uncond = repeated(self.load(case, "uncond", &plain), start.len());
        let off = &mut Dropout::off();

        let cond = self.teacher.forward(noisy.clone(), &start, text.clone(), None, off);
        let uncond = self.teacher.forward(noisy.clone(), &start, uncond, None, off);
        let eps = guided_by(cond, uncond, &self.io.get(&format!("{case}/w")).f32s());
        let (a, e) = unzip(start.iter().zip(&end).map(|(t, s)| self.schedule.jump(*t, *s)));
        let z_prev = affine(noisy.clone(), eps, &a, &e);
        let eps = self.target.forward(z_prev.clone(), &end, text, Some(self.guidance(case, &plain)), off);
        let (a, e) = unzip(end.iter().map(|t| consistency(&self.schedule, *t)));
        let target = affine(z_prev, eps, &a, &e);

        let noisy = Tensor::from_data(noisy.into_data(), &tracked);
        let text = self.load(case, "text", &tracked);
        let guidance = self.guidance(case, &tracked);
        let eps = self.student.forward(noisy.clone(), &start, text, Some(guidance), off);
        gates.tensor("student", case, eps.clone(), self.io.get(&format!("{case}/student_eps")), FORWARD);
        let (a, e) = unzip(start.iter().map(|t| consistency(&self.schedule, *t)));
        (affine(noisy, eps, &a, &e), Tensor::from_data(target.into_data(), &tracked))
    }

    fn update(&self, case: &str, gates: &mut Gates) {
        let (student, target) = self.chain(case, gates);
        let batch = student.dims()[0] as f32;
        let huber = self.expected.get(format!("{case}/loss_huber"));
        let loss = match huber {
            Some(_) => losses::pseudo_huber(student, target, self.config["huber_c"].as_f64().expect("c")),
            None => losses::mse(student, target),
        } / batch;
        let stored = huber.unwrap_or_else(|| &self.expected[format!("{case}/loss_l2")]).as_f64().expect("a loss");
        gates.check("loss", case, relative(scalar(&loss), stored), LOSS);
        let mut grads = gradients(&self.student, loss);
        let entries = flat::layout(&self.student);
        let prefix = format!("{case}/grad");
        check_gradients(gates, &entries, &grads, &self.expected[&prefix], self.io, &prefix);

        let Some(norm) = self.expected.get(format!("{case}/step/grad_norm_before_clip")) else { return };
        let expected = |part: &str| &self.expected[format!("{case}/step/{part}")];
        gates.check("clip", case, relative(global_norm(&grads), norm.as_f64().expect("a norm")), 1e-4);
        let factor = clip_factor(global_norm(&grads), self.config["optimizer"]["max_grad_norm"].as_f64().expect("max"));
        grads.iter_mut().for_each(|g| *g *= factor as f32);
        let (adam, lr) = adam(&self.config["optimizer"]["AdamW"]);
        let before = flat::read(&self.student);
        let mut weights = before.clone();
        let (mut m, mut v) = (vec![0.0; weights.len()], vec![0.0; weights.len()]);
        adam.step(1, lr, &mut weights, &grads, &mut m, &mut v);
        let mut average = flat::read(&self.target);
        ema(&mut average, &weights, self.config["ema_decay"].as_f64().expect("a number"));

        let change: Vec<f32> = weights.iter().zip(&before).map(|(a, b)| a - b).collect();
        let mut norms = |kind: &'static str, found: &[f32], part: &str, gate: f64| {
            let stored = expected(part).as_object().expect("norms by name");
            assert_eq!(stored.len(), entries.len(), "{part}: a norm for every parameter");
            for (entry, values) in split(&entries, found) {
                let wanted = stored[&entry.name].as_f64().expect("a norm");
                gates.check(kind, format!("{case} {}", entry.name), relative(global_norm(values), wanted), gate);
            }
        };
        norms("weights", &weights, "student_parameter_norm_after", WEIGHTS);
        norms("change", &change, "student_change_norm", CHANGE);
        norms("average", &average, "target_parameter_norm_after_ema", WEIGHTS);
        for (kind, flat) in [("student", &weights), ("target", &average)] {
            for (entry, values) in split(&entries, flat) {
                if let Some(stored) = self.io.find(&format!("{case}/step/{kind}/{}", entry.name)) {
                    let what = format!("{case} {kind} {}", entry.name);
                    gates.check("whole weights", what, error(values, &stored.values), WEIGHTS);
                }
            }
        }
    }
}
