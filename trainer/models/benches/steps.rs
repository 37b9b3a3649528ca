//! Times training steps of the VAE, the denoiser and PCM with Burn's operations and with the fused kernels. The two
//! alternate in one run. The least time of each is printed, so that other work on the machine counts little.
//!
//! Run it with `RAYON_NUM_THREADS=1 cargo bench -p models` for one thread. A number after `--` sets the timed steps of
//! each. Words after `--` choose the cases that contain one of them; `fused` runs no stock steps, for a profiler.
#![expect(clippy::print_stdout, reason = "a bench prints what it measured")]

use std::time::{Duration, Instant};

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::diffusion::{TIMESTEPS, affine};
use models::kernels::{self, Dropout};
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Denoiser, DenoiserConfig, Discriminator, Init, Vae, VaeConfig};
use models::optim::{AdamW, clip_factor, global_norm};
use models::{device, flat};
use motion::Stream;
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{Backend, DataFormat, LatentShape, Network, Positions, VaeLoss};

/// A network in training.
struct Trained<M> {
    network: M,
    params: Vec<f32>,
    m: Vec<f32>,
    v: Vec<f32>,
    done: u64,
}

impl<M: Module> Trained<M> {
    fn new(network: M) -> Self {
        let params = flat::read(&network);
        let zeros = vec![0.0; params.len()];
        Self { network, m: zeros.clone(), v: zeros, params, done: 0 }
    }

    /// Runs one update, as the training loop does.
    fn step(&mut self, loss: impl FnOnce(&M) -> Tensor<1>) {
        let mut gradients = loss(&self.network).backward();
        let flat = flat::take_gradients(&self.network, &mut gradients);
        let factor = clip_factor(global_norm(&flat), 1.0) as f32;
        self.done += 1;
        let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 };
        adam.step_by(factor, self.done, 1e-4, &mut self.params, &flat, &mut self.m, &mut self.v);
        self.network = flat::write(self.network.clone(), &self.params);
    }
}

fn noise<const D: usize>(shape: [usize; D], purpose: &str, device: &Device) -> Tensor<D> {
    let mut values = vec![0.0; shape.iter().product()];
    Stream::new(Seed(1), purpose, 0, 0).fill_normal(&mut values);
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// d 128, 5 + 5 layers, 16 x 32 latents, features of HumanML3D.
fn vae(device: &Device) -> Trained<Vae> {
    let config = VaeConfig {
        features: 263,
        latent: LatentShape { tokens: 16, dim: 32 },
        network: Network { width: 128, layers: 5, heads: 4, feed_forward: 256, ..Network::default() },
        projection: true,
    };
    Trained::new(Vae::new(&config, &mut Init::new(Seed(1), "vae", Positions::Sinusoid, &device.clone().autodiff())))
}

fn vae_step(state: &mut Trained<Vae>, lengths: &[usize], joint: f64, dropout: f64, device: &Device) {
    let frames = *lengths.iter().max().expect("clips");
    let features = noise([lengths.len(), frames, 263], "features", device);
    let eps = noise([lengths.len(), 16, 32], "eps", device);
    let body = Body::new(Skeleton::of(DataFormat::Humanml3d), &[0.0; 263], &[0.1; 263], device);
    let recipe = VaeRecipe::from(VaeLoss { joint, ..VaeLoss::default() });
    let mut dropout = Dropout::new(dropout, 1, state.done, 0);
    state.step(|vae| {
        let posterior = vae.encode(features.clone(), lengths, &mut dropout);
        let decoded = vae.decode(posterior.sample(eps), lengths, frames, &mut dropout);
        let terms = losses::vae(&recipe, &body, decoded, features, &posterior, lengths);
        terms.total().expect("weights") / lengths.len() as f32
    });
}

/// d 128 and 5 layers, or the quickstart's d 96; 16 latent tokens and 2 of condition.
fn denoiser(width: usize, device: &Device) -> Denoiser {
    let config = DenoiserConfig {
        latent: LatentShape { tokens: 16, dim: 32 },
        network: Network { width, layers: 5, heads: 4, feed_forward: 2 * width, ..Network::default() },
        text_dim: 768,
        time_dim: 768,
        text_relu: false,
        projection: true,
        guidance_dim: None,
    };
    Denoiser::new(&config, &mut Init::new(Seed(1), "denoiser", Positions::Uniform, device))
}

/// Inputs of a denoiser's slice: a latent, a target, captions and timesteps.
fn batch_of(batch: usize, device: &Device) -> ([Tensor<3>; 3], Vec<usize>) {
    let latent = |purpose| noise([batch, 16, 32], purpose, device);
    let timesteps = (0..batch).map(|i| i * 37 % TIMESTEPS).collect();
    ([latent("noisy"), latent("target"), noise([batch, 1, 768], "text", device)], timesteps)
}

fn denoiser_step(state: &mut Trained<Denoiser>, batch: usize, dropout: f64, device: &Device) {
    let ([noisy, target, text], timesteps) = batch_of(batch, device);
    let mut dropout = Dropout::new(dropout, 1, state.done, 0);
    state.step(|network| {
        losses::mse(network.forward(noisy, &timesteps, text, None, &mut dropout), target) / batch as f32
    });
}

/// The networks of PCM with a discriminator.
struct Distilled {
    teacher: Denoiser,
    student: Trained<Denoiser>,
    heads: Trained<Discriminator>,
}

fn pcm(device: &Device) -> Distilled {
    let tracked = device.clone().autodiff();
    let heads = Discriminator::new(5, 96, 0.01, &mut Init::new(Seed(1), "heads", Positions::Uniform, &tracked));
    Distilled {
        teacher: denoiser(96, device),
        student: Trained::new(denoiser(96, &tracked)),
        heads: Trained::new(heads),
    }
}

/// The passes of `distill.pcm` over one slice: the guided teacher, student and target, and the heads on the teacher's
/// features of fake and real.
fn pcm_step(state: &mut Distilled, batch: usize, device: &Device) {
    let ([noisy, clean, text], timesteps) = batch_of(batch, device);
    let off = Dropout::off;
    let twice = |x: &Tensor<3>| Tensor::cat(vec![x.clone(), x.clone()], 0);
    let both: Vec<usize> = timesteps.iter().chain(&timesteps).copied().collect();
    let guided = state.teacher.forward(twice(&noisy), &both, twice(&text), None, &mut off());
    let solved = guided.slice([0..batch, 0..16, 0..32]);
    let halves = vec![0.5; batch];
    let features = |z| state.teacher.features(z, &timesteps, text.clone(), &mut off());
    let heads = &state.heads.network;
    let mut seen = Vec::new();
    state.student.step(|student| {
        let target = student.valid().forward(solved, &timesteps, text.clone(), None, &mut off());
        let out = student.forward(noisy, &timesteps, text.clone(), None, &mut off());
        let fake = features(affine(out.clone(), noise([batch, 16, 32], "fake", device), &halves, &halves));
        seen = fake.iter().map(|f| f.clone().inner()).collect();
        let adversarial = losses::hinge_generator(heads.valid().forward(fake)) * 0.1;
        (losses::pseudo_huber(out, target, 1e-3) + adversarial) / batch as f32
    });
    let real = features(affine(clean, noise([batch, 16, 32], "real", device), &halves, &halves));
    state.heads.step(|heads| losses::hinge_discriminator(heads.forward(real), heads.forward(seen)) / batch as f32);
}

fn least(times: Vec<Duration>) -> f64 {
    times.into_iter().min().unwrap_or_default().as_secs_f64()
}

/// The benchmarks named on the command line.
struct Plan {
    count: usize,
    words: Vec<String>,
    alone: bool,
}

impl Plan {
    fn read() -> Self {
        let (numbers, words): (Vec<_>, Vec<_>) =
            std::env::args().skip(1).filter(|a| !a.starts_with('-')).partition(|a| a.parse::<usize>().is_ok());
        let (modes, words): (Vec<_>, Vec<_>) = words.into_iter().partition(|a| a == "fused");
        Self { count: numbers.first().map_or(15, |n| n.parse().expect("a number")), words, alone: !modes.is_empty() }
    }

    /// Times fused and stock steps in turn; `samples` of each step.
    fn race<S>(&self, name: &str, samples: usize, make: impl Fn() -> S, mut step: impl FnMut(&mut S)) {
        if !self.words.is_empty() && !self.words.iter().any(|word| name.contains(word.as_str())) {
            return;
        }
        let (mut fused, mut stock) = (make(), make());
        let (mut fast, mut slow) = (Vec::new(), Vec::new());
        let begun = Instant::now();
        for turn in 0..self.count + 2 {
            let start = begun.elapsed();
            step(&mut fused);
            let middle = begun.elapsed();
            if !self.alone {
                kernels::stock(|| step(&mut stock));
            }
            // The first two turns warm up caches and the allocator.
            if turn >= 2 {
                fast.push(middle - start);
                slow.push(begun.elapsed() - middle);
            }
        }
        let (fast, slow) = (least(fast), least(slow));
        let rate = |seconds: f64| samples as f64 / seconds;
        if self.alone {
            println!("{name:<44} fused {:7.1} ms {:6.0}/s", fast * 1e3, rate(fast));
            return;
        }
        println!(
            "{name:<44} stock {:7.1} ms {:6.0}/s   fused {:7.1} ms {:6.0}/s   {:.2} times as fast",
            slow * 1e3,
            rate(slow),
            fast * 1e3,
            rate(fast),
            slow / fast
        );
    }
}

fn main() {
    let plan = Plan::read();
    let device = device::open(Backend::Flex, 0).expect("built with flex");
    let clips: Vec<usize> = (0..8).map(|i| 86 + 4 * i).collect();
    let windows: Vec<usize> = (0..16).map(|i| 40 + 4 * (i % 7)).collect();
    let case = |name: &str, lengths: &[usize], joint: f64, dropout: f64| {
        plan.race(name, lengths.len(), || vae(&device), |s| vae_step(s, lengths, joint, dropout, &device));
    };
    case("VAE, 8 clips of 100 frames", &clips, 0.0, 0.0);
    case("VAE, 8 clips, joint loss", &clips, 1.0, 0.0);
    case("VAE, 8 clips, dropout 0.1", &clips, 0.0, 0.1);
    case("VAE, 16 windows of 52 frames", &windows, 0.0, 0.0);
    let tracked = device.clone().autodiff();
    let case = |name: &str, width: usize, batch: usize, dropout: f64| {
        let make = || Trained::new(denoiser(width, &tracked));
        plan.race(name, batch, make, |s| denoiser_step(s, batch, dropout, &device));
    };
    case("denoiser, 64 x 18 tokens", 128, 64, 0.0);
    case("denoiser, 64 x 18 tokens, dropout 0.1", 128, 64, 0.1);
    case("MLD, the quickstart's slice of 16", 96, 16, 0.0);
    plan.race("PCM, the quickstart's slice of 16", 16, || pcm(&device), |s| pcm_step(s, 16, &device));
}
