//! Times a training step of the VAE and of the denoiser with Burn's operations and with the fused kernels. The two
//! alternate in one run and medians are printed, so that a busy moment of the machine counts little.
//!
//! Run it with `RAYON_NUM_THREADS=1 cargo bench -p models` for one thread. A number after `--` sets the timed steps of
//! each.
#![expect(clippy::print_stdout, reason = "a bench prints what it measured")]

use std::time::{Duration, Instant};

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::diffusion::TIMESTEPS;
use models::kernels::{self, Dropout};
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Denoiser, DenoiserConfig, Init, Vae, VaeConfig};
use models::optim::{AdamW, clip_factor, global_norm};
use models::{device, flat};
use motion::Stream;
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{Backend, DataFormat, Positions, VaeLoss};

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
        let mut flat = vec![0.0; self.params.len()];
        flat::add_gradients(&self.network, &mut gradients, &mut flat);
        let factor = clip_factor(global_norm(&flat), 1.0) as f32;
        flat.iter_mut().for_each(|g| *g *= factor);
        self.done += 1;
        let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 };
        adam.step(self.done, 1e-4, &mut self.params, &flat, &mut self.m, &mut self.v);
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
        tokens: 16,
        dim: 32,
        width: 128,
        layers: 5,
        heads: 4,
        feed_forward: 256,
        projection: true,
        norm_eps: 1e-5,
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

/// d 128, 5 layers, 16 latent tokens and 2 of condition.
fn denoiser(device: &Device) -> Trained<Denoiser> {
    let config = DenoiserConfig {
        tokens: 16,
        dim: 32,
        width: 128,
        layers: 5,
        heads: 4,
        feed_forward: 256,
        text_dim: 768,
        time_dim: 768,
        text_relu: false,
        projection: true,
        guidance_dim: None,
        norm_eps: 1e-5,
    };
    let tracked = device.clone().autodiff();
    Trained::new(Denoiser::new(&config, &mut Init::new(Seed(1), "denoiser", Positions::Uniform, &tracked)))
}

fn denoiser_step(state: &mut Trained<Denoiser>, batch: usize, dropout: f64, device: &Device) {
    let (noisy, target) = (noise([batch, 16, 32], "noisy", device), noise([batch, 16, 32], "target", device));
    let text = noise([batch, 1, 768], "text", device);
    let timesteps: Vec<usize> = (0..batch).map(|i| i * 37 % TIMESTEPS).collect();
    let mut dropout = Dropout::new(dropout, 1, state.done, 0);
    state.step(|network| {
        losses::mse(network.forward(noisy, &timesteps, text, None, &mut dropout), target) / batch as f32
    });
}

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort_unstable();
    times[times.len() / 2].as_secs_f64()
}

/// Times `fused` and `stock` steps in turn; `samples` of each step.
fn race<S>(name: &str, samples: usize, count: usize, make: impl Fn() -> S, mut step: impl FnMut(&mut S)) {
    let (mut fused, mut stock) = (make(), make());
    let (mut fast, mut slow) = (Vec::new(), Vec::new());
    for turn in 0..count + 2 {
        let start = Instant::now();
        step(&mut fused);
        let taken = start.elapsed();
        let start = Instant::now();
        kernels::stock(|| step(&mut stock));
        // The first two turns warm up caches and the allocator.
        if turn >= 2 {
            fast.push(taken);
            slow.push(start.elapsed());
        }
    }
    let (fast, slow) = (median(fast), median(slow));
    let rate = |seconds: f64| samples as f64 / seconds;
    println!(
        "{name:<44} stock {:7.1} ms {:6.0}/s   fused {:7.1} ms {:6.0}/s   {:.2} times as fast",
        slow * 1e3,
        rate(slow),
        fast * 1e3,
        rate(fast),
        slow / fast
    );
}

fn main() {
    let count = std::env::args().find_map(|a| a.parse().ok()).unwrap_or(15);
    let device = device::open(Backend::Flex, 0).expect("built with flex");
    let clips: Vec<usize> = (0..8).map(|i| 86 + 4 * i).collect();
    let windows: Vec<usize> = (0..16).map(|i| 40 + 4 * (i % 7)).collect();
    let case = |name: &str, lengths: &[usize], joint: f64, dropout: f64| {
        race(name, lengths.len(), count, || vae(&device), |s| vae_step(s, lengths, joint, dropout, &device));
    };
    case("VAE, 8 clips of 100 frames", &clips, 0.0, 0.0);
    case("VAE, 8 clips, joint loss", &clips, 1.0, 0.0);
    case("VAE, 8 clips, dropout 0.1", &clips, 0.0, 0.1);
    case("VAE, 16 windows of 52 frames", &windows, 0.0, 0.0);
    let case = |name: &str, batch: usize, dropout: f64| {
        race(name, batch, count, || denoiser(&device), |s| denoiser_step(s, batch, dropout, &device));
    };
    case("denoiser, 64 x 18 tokens", 64, 0.0);
    case("denoiser, 64 x 18 tokens, dropout 0.1", 64, 0.1);
}
