//! A training step on flex, with the fused kernels, against the same step on ndarray, where every function is composed of Burn's
//! operations: loss and whole gradient. Both backends are in every test build.
#![cfg(feature = "flex")]

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::flat;
use models::kernels::{self, Dropout};
use models::losses::{self, Body, VaeRecipe};
use models::networks::{Denoiser, DenoiserConfig, Init, Vae, VaeConfig, guidance_embedding};
use motion::random::Stream;
use motion::skeleton::Skeleton;
use protocol::Seed;
use protocol::stage::{DataFormat, Positions, VaeLoss};

fn ndarray() -> Device {
    #[expect(deprecated, reason = "the second opinion, as long as Burn has it")]
    Device::ndarray()
}

fn noise<const D: usize>(shape: [usize; D], purpose: &str, device: &Device) -> Tensor<D> {
    let mut values = vec![0.0; shape.iter().product()];
    Stream::new(Seed(7), purpose, 0, 0).fill_normal(&mut values);
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The network with every parameter moved a little, so that none is at a zero that hides a gradient.
fn stirred<M: Module>(network: M) -> M {
    let mut params = flat::read(&network);
    let mut stream = Stream::new(Seed(7), "stir", 0, 0);
    params.iter_mut().for_each(|p| *p += 0.02 * stream.normal());
    flat::write(network, &params)
}

fn loss_and_gradient<M: Module>(network: &M, loss: Tensor<1>) -> (f32, Vec<f32>) {
    let value = loss.clone().inner().into_data().as_slice::<f32>().expect("f32")[0];
    let mut gradient = vec![0.0; flat::read(network).len()];
    flat::add_gradients(network, &mut loss.backward(), &mut gradient);
    (value, gradient)
}

fn vae_step(device: &Device) -> (f32, Vec<f32>) {
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
    let vae = stirred(Vae::new(&config, &mut Init::new(Seed(3), "agreement", Positions::Uniform, &tracked)));
    let (lengths, frames) = ([20, 14, 9], 20);
    let features = noise([3, frames, skeleton.features], "features", device);
    let body = Body::new(skeleton, &vec![0.0; skeleton.features], &vec![0.1; skeleton.features], device);
    let mut dropout = Dropout::new(0.1, 5, 1, 0);
    let posterior = vae.encode(features.clone(), &lengths, &mut dropout);
    let decoded = vae.decode(posterior.sample(noise([3, 2, 8], "eps", device)), &lengths, frames, &mut dropout);
    let recipe = VaeRecipe::from(VaeLoss::default());
    let loss = losses::vae(&recipe, &body, decoded, features, &posterior, &lengths).total().expect("terms") / 3.0;
    loss_and_gradient(&vae, loss)
}

fn denoiser_step(device: &Device) -> (f32, Vec<f32>) {
    let config = DenoiserConfig {
        tokens: 4,
        dim: 8,
        width: 32,
        layers: 3,
        heads: 2,
        feed_forward: 48,
        text_dim: 24,
        time_dim: 16,
        text_relu: true,
        projection: true,
        guidance_dim: Some(12),
        norm_eps: 1e-5,
    };
    let tracked = device.clone().autodiff();
    let network = stirred(Denoiser::new(&config, &mut Init::new(Seed(3), "agreement", Positions::Uniform, &tracked)));
    let guidance = guidance_embedding(&[7.5, 5.0, 12.25], 12, device);
    let (noisy, text) = (noise([3, 4, 8], "noisy", device), noise([3, 1, 24], "text", device));
    let mut dropout = Dropout::new(0.1, 5, 1, 0);
    let found = network.forward(noisy, &[3, 480, 999], text, Some(guidance), &mut dropout);
    loss_and_gradient(&network, losses::mse(found, noise([3, 4, 8], "target", device)) / 3.0)
}

fn norm(values: impl Iterator<Item = f32>) -> f64 {
    values.map(|v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt()
}

fn compare(name: &str, step: impl Fn(&Device) -> (f32, Vec<f32>)) {
    let (fused, fused_gradient) = step(&Device::flex());
    let (stock, stock_gradient) = step(&ndarray());
    assert_eq!(fused_gradient.len(), stock_gradient.len());
    let size = norm(stock_gradient.iter().copied());
    assert!(stock.is_finite() && size.is_finite() && size > 0.0, "{name}: nothing to compare");
    let off = norm(fused_gradient.iter().zip(&stock_gradient).map(|(f, s)| f - s)) / size;
    let loss_off = f64::from((fused - stock).abs()) / f64::from(stock.abs());
    eprintln!("{name}: loss {stock:.6}, off by {loss_off:.1e}; gradient of norm {size:.3e}, off by {off:.1e}");
    assert!(loss_off <= 1e-5, "{name}: losses {fused} and {stock}");
    assert!(off <= 1e-4, "{name}: gradients differ by {off:.1e} of their norm");
}

#[test]
fn ndarray_agrees_with_flex() {
    compare("VAE", vae_step);
    compare("denoiser", denoiser_step);
}

/// A tape anywhere among a kernel's arguments is kept, also if it is the last of them alone that has one.
#[test]
fn a_lone_bias_gets_its_gradient() {
    let flex = Device::flex();
    let x = || noise([2, 5, 6], "x", &flex);
    let leaf = |purpose| noise([6], purpose, &flex.clone().autodiff()).require_grad();
    let sums = |y: Tensor<3>, b: &Tensor<1>| {
        let found = b.grad(&y.sum().backward()).expect("a gradient").into_data();
        assert_eq!(found.as_slice::<f32>().expect("f32"), [10.0; 6]);
    };
    let b = leaf("bias");
    sums(kernels::linear(x(), noise([6, 6], "weight", &flex), Some(b.clone())), &b);
    let b = leaf("beta");
    sums(kernels::layer_norm(x(), noise([6], "gamma", &flex), b.clone(), 1e-5), &b);
    let b = leaf("beta");
    sums(kernels::add_layer_norm(x(), x(), noise([6], "gamma", &flex), b.clone(), 1e-5), &b);
}
