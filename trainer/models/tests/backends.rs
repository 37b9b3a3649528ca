//! One training step of the VAE and of the denoiser on another backend agrees with the same step on flex: loss,
//! gradients, and updated weights. The other backend's kernels are composed of Burn's operations, flex has fused ones.
//! `ndarray` is in every test build.
#![cfg(all(feature = "flex", any(feature = "ndarray", feature = "wgpu", feature = "cuda")))]

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::kernels::{self, Dropout};
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Denoiser, DenoiserConfig, Init, Vae, VaeConfig, guidance_embedding};
use models::optim::{AdamW, clip_factor, global_norm};
use models::{device, flat};
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{Backend, DataFormat, LatentShape, Network, Positions, VaeLoss};

/// Loss, gradients, and parameters after an update.
type Step = (f32, Vec<f32>, Vec<f32>);

fn wave<const D: usize>(shape: [usize; D], k: f32, device: &Device) -> Tensor<D> {
    let values = (0..shape.iter().product()).map(|i| (i as f32 * k).sin() * 1.2).collect::<Vec<_>>();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn update<M: Module>(network: M, loss: Tensor<1>) -> Step {
    let value = loss.clone().inner().into_data().as_slice::<f32>().expect("f32")[0];
    let mut params = flat::read(&network);
    let gradient = flat::gradient(&network, loss);
    let factor = clip_factor(global_norm(&gradient), 1.0) as f32;
    let clipped: Vec<f32> = gradient.iter().map(|g| g * factor).collect();
    let (mut m, mut v) = (vec![0.0; params.len()], vec![0.0; params.len()]);
    // The default `eps` would turn the rounding error of a vanishing gradient into a full-size update.
    let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-4, weight_decay: 0.01 };
    adam.step(1, 1e-3, &mut params, &clipped, &mut m, &mut v);
    let network = flat::write(network, &params);
    (value, gradient, flat::read(&network))
}

fn vae(device: &Device) -> Step {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let config = VaeConfig {
        features: skeleton.features,
        latent: LatentShape { tokens: 2, dim: 8 },
        network: Network { width: 32, layers: 3, heads: 2, feed_forward: 48, ..Network::default() },
        projection: true,
    };
    let tracked = device.clone().autodiff();
    let vae = Vae::new(&config, &mut Init::new(Seed(3), "backends", Positions::Uniform, &tracked));
    let (lengths, frames) = ([20, 14, 9], 20);
    let features = wave([3, frames, skeleton.features], 0.37, device);
    let body = Body::new(skeleton, &vec![0.0; skeleton.features], &vec![0.1; skeleton.features], device);

    // Dropout is on: its mask must be the same on both backends.
    let mut dropout = Dropout::new(0.1, 5, 1, 0);
    let posterior = vae.encode(features.clone(), &lengths, &mut dropout);
    let decoded = vae.decode(posterior.sample(wave([3, 2, 8], 0.71, device)), &lengths, frames, &mut dropout);
    let recipe = VaeRecipe::from(VaeLoss::default());
    let loss = losses::vae(&recipe, &body, decoded, features, &posterior, &lengths).total().expect("terms") / 3.0;
    update(vae, loss)
}

fn denoiser(device: &Device) -> Step {
    let config = DenoiserConfig {
        latent: LatentShape { tokens: 4, dim: 8 },
        network: Network { width: 32, layers: 3, heads: 2, feed_forward: 48, ..Network::default() },
        text_dim: 24,
        time_dim: 16,
        text_relu: true,
        projection: true,
        guidance_dim: Some(12),
    };
    let tracked = device.clone().autodiff();
    let network = Denoiser::new(&config, &mut Init::new(Seed(3), "backends", Positions::Uniform, &tracked));
    let guidance = guidance_embedding(&[7.5, 5.0, 12.25], 12, device);
    let (noisy, text) = (wave([3, 4, 8], 0.53, device), wave([3, 1, 24], 0.29, device));
    let found = network.forward(noisy, &[3, 480, 999], text, Some(guidance), &mut Dropout::new(0.1, 5, 1, 0));
    update(network, losses::mse(found, wave([3, 4, 8], 0.91, device)) / 3.0)
}

fn off(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
    found.iter().zip(expected).fold(0.0_f32, |m, (f, e)| m.max((f - e).abs())) / scale
}

fn agrees(backend: Backend) {
    let Ok(device) = device::open(backend, 0) else {
        fixtures::skip(&format!("no {} device on this machine", backend.name()));
        return;
    };
    let flex = device::open(Backend::Flex, 0).expect("flex is built in");
    for (name, step) in [("vae", vae as fn(&Device) -> Step), ("denoiser", denoiser)] {
        let (loss, gradient, params) = step(&flex);
        let (other_loss, other_gradient, other_params) = step(&device);
        assert!(gradient.iter().any(|g| *g != 0.0), "{name}: nothing to compare");
        let found = ((other_loss - loss).abs() / loss, off(&other_gradient, &gradient), off(&other_params, &params));
        let backend = backend.name();
        eprintln!("{name} on {backend}: loss {:.1e}, gradients {:.1e}, weights {:.1e}", found.0, found.1, found.2);
        assert!(found.0 < 1e-5 && found.1 < 1e-5 && found.2 < 1e-5, "{name} on {backend}: {found:?}");
    }
}

/// A kernel keeps a tape on any of its arguments, also if only the last one has it.
#[test]
fn a_lone_bias_gets_its_gradient() {
    let flex = device::open(Backend::Flex, 0).expect("flex is built in");
    let x = || wave([2, 5, 6], 0.37, &flex);
    let leaf = |k| wave([6], k, &flex.clone().autodiff()).require_grad();
    let sums = |y: Tensor<3>, b: &Tensor<1>| {
        let found = b.grad(&y.sum().backward()).expect("a gradient").into_data();
        assert_eq!(found.as_slice::<f32>().expect("f32"), [10.0; 6]);
    };
    let b = leaf(0.3);
    sums(kernels::linear(x(), wave([6, 6], 0.2, &flex), Some(b.clone())), &b);
    let b = leaf(0.4);
    sums(kernels::layer_norm(x(), wave([6], 0.6, &flex), b.clone(), 1e-5), &b);
    let b = leaf(0.5);
    sums(kernels::add_layer_norm(x(), x(), wave([6], 0.7, &flex), b.clone(), 1e-5), &b);
}

#[cfg(feature = "ndarray")]
#[test]
fn a_training_step_on_ndarray_agrees_with_flex() {
    agrees(Backend::Ndarray);
}

#[cfg(feature = "wgpu")]
#[test]
fn a_training_step_on_wgpu_agrees_with_flex() {
    agrees(Backend::Wgpu);
}

#[cfg(feature = "cuda")]
#[test]
fn a_training_step_on_cuda_agrees_with_flex() {
    agrees(Backend::Cuda);
}
