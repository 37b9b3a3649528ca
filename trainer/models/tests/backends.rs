//! One training step of the VAE on another backend agrees with the same step on flex: loss, gradients, and the weights after it.
#![cfg(all(feature = "flex", any(feature = "ndarray", feature = "wgpu", feature = "cuda")))]

use burn::tensor::{Device, Tensor, TensorData};
use models::kernels::Dropout;
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Init, Vae, VaeConfig};
use models::optim::{AdamW, clip_factor, global_norm};
use models::{device, flat};
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{Backend, DataFormat, Positions, VaeLoss};

/// Loss, gradients, and parameters after an update.
fn step(device: &Device) -> (f32, Vec<f32>, Vec<f32>) {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let config = VaeConfig {
        features: skeleton.features,
        tokens: 2,
        dim: 8,
        width: 32,
        layers: 3,
        heads: 2,
        feed_forward: 48,
        projection: true,
        norm_eps: 1e-5,
    };
    let tracked = device.clone().autodiff();
    let vae = Vae::new(&config, &mut Init::new(Seed(3), "backends", Positions::Uniform, &tracked));
    let (lengths, frames) = ([20, 14, 9], 20);
    let wave = |n: usize, k: f32| (0..n).map(|i| (i as f32 * k).sin() * 1.2).collect::<Vec<_>>();
    let tensor =
        |shape: [usize; 3], k| Tensor::<3>::from_data(TensorData::new(wave(shape.iter().product(), k), shape), device);
    let features = tensor([3, frames, skeleton.features], 0.37);
    let body = Body::new(skeleton, &vec![0.0; skeleton.features], &vec![0.1; skeleton.features], device);

    // Dropout is on: its mask must be the same everywhere.
    let mut dropout = Dropout::new(0.1, 5, 1, 0);
    let posterior = vae.encode(features.clone(), &lengths, &mut dropout);
    let decoded = vae.decode(posterior.sample(tensor([3, 2, 8], 0.71)), &lengths, frames, &mut dropout);
    let recipe = VaeRecipe::from(VaeLoss::default());
    let loss = losses::vae(&recipe, &body, decoded, features, &posterior, &lengths).total().expect("terms") / 3.0;
    let value = loss.clone().inner().into_data().as_slice::<f32>().expect("f32")[0];

    let mut params = flat::read(&vae);
    let mut gradient = vec![0.0; params.len()];
    flat::add_gradients(&vae, &mut loss.backward(), &mut gradient);
    let factor = clip_factor(global_norm(&gradient), 1.0) as f32;
    let clipped: Vec<f32> = gradient.iter().map(|g| g * factor).collect();
    let (mut m, mut v) = (vec![0.0; params.len()], vec![0.0; params.len()]);
    // The default `eps` would turn the rounding error of a vanishing gradient into a full-size update.
    let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-4, weight_decay: 0.01 };
    adam.step(1, 1e-3, &mut params, &clipped, &mut m, &mut v);
    let vae = flat::write(vae, &params);
    (value, gradient, flat::read(&vae))
}

fn off(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
    found.iter().zip(expected).fold(0.0_f32, |m, (f, e)| m.max((f - e).abs())) / scale
}

fn agrees(backend: Backend) {
    let Ok(device) = device::open(backend, 0) else {
        eprintln!("SKIPPED: no {} device on this machine", backend.name());
        return;
    };
    let (loss, gradient, params) = step(&device::open(Backend::Flex, 0).expect("flex is built in"));
    let (other_loss, other_gradient, other_params) = step(&device);
    let found = ((other_loss - loss).abs() / loss, off(&other_gradient, &gradient), off(&other_params, &params));
    eprintln!("{}: loss {:.1e}, gradients {:.1e}, weights {:.1e}", backend.name(), found.0, found.1, found.2);
    assert!(found.0 < 1e-5 && found.1 < 1e-4 && found.2 < 1e-4, "{found:?}");
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
