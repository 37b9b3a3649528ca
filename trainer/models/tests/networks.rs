//! Properties of the networks that hold for any weights.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use models::flat::{layout, read, take_gradients};
use models::kernels::Dropout;
use models::losses::hinge_generator;
use models::networks::{
    Denoiser, DenoiserConfig, Discriminator, Init, Vae, VaeConfig, guidance_embedding, time_sinusoid,
};
use protocol::Seed;
use protocol::stage::{LatentShape, Network, Positions};

fn vae_config() -> VaeConfig {
    VaeConfig {
        features: 20,
        latent: LatentShape { tokens: 3, dim: 6 },
        network: Network { width: 16, layers: 5, heads: 2, feed_forward: 24, ..Network::default() },
        projection: true,
    }
}

fn denoiser_config(guidance_dim: Option<usize>) -> DenoiserConfig {
    DenoiserConfig {
        latent: LatentShape { tokens: 3, dim: 6 },
        network: Network { width: 16, layers: 5, heads: 2, feed_forward: 24, ..Network::default() },
        text_dim: 10,
        time_dim: 12,
        text_relu: false,
        projection: true,
        guidance_dim,
    }
}

fn draws(device: &Device) -> Init<'_> {
    Init::new(Seed(3), "test", Positions::Uniform, device)
}

/// Values without a pattern, within ±1.
fn wave<const D: usize>(shape: [usize; D], salt: usize, device: &Device) -> Tensor<D> {
    let count = shape.iter().product();
    let values: Vec<f32> = (0..count).map(|i: usize| ((i * i + 31 * salt + 7 * i) as f32 * 0.618).sin()).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("f32")
}

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

#[test]
fn first_values_are_a_function_of_seed_and_purpose() {
    let device = Device::flex();
    let of = |seed, purpose| {
        read(&Vae::new(&vae_config(), &mut Init::new(Seed(seed), purpose, Positions::Uniform, &device)))
    };
    assert_eq!(of(3, "a"), of(3, "a"));
    assert_ne!(of(3, "a"), of(4, "a"));
    assert_ne!(of(3, "a"), of(3, "b"));
}

#[test]
fn first_values_are_distributed_as_published() {
    let vae = Vae::new(&vae_config(), &mut draws(&Device::flex()));
    let (flat, mut at) = (read(&vae), 0);
    for entry in layout(&vae) {
        let values = &flat[at..at + entry.len()];
        at += entry.len();
        let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let fills = |from: f32, to: f32| {
            let slack = 0.05 * (to - from);
            low >= from && high <= to && (values.len() < 200 || (low < from + slack && high > to - slack))
        };
        let xavier = |out: usize, inner: usize| (6.0 / (inner + out) as f32).sqrt();
        let name = entry.name.as_str();
        let stacked = name.starts_with("encoder.") || name.starts_with("decoder.");
        let ok = match entry.shape[..] {
            // The packed projection counts as one matrix.
            [out, inner] if stacked => fills(-xavier(out, inner), xavier(out, inner)),
            [_, inner] if name.ends_with(".weight") => fills(-(inner as f32).powf(-0.5), (inner as f32).powf(-0.5)),
            [500, 1, _] => fills(0.0, 1.0),
            _ if name.contains("norm") => values.iter().all(|v| *v == if name.ends_with("weight") { 1.0 } else { 0.0 }),
            _ if name.contains("in_proj") || name.contains("out_proj") => values.iter().all(|v| *v == 0.0),
            _ => values.iter().any(|v| *v != 0.0),
        };
        assert!(ok, "{name} {:?} lies in {low}..{high}", entry.shape);
    }
    assert_eq!(at, flat.len());
}

#[test]
fn padding_changes_nothing() {
    let device = Device::flex();
    let vae = Vae::new(&vae_config(), &mut draws(&device));
    let off = &mut Dropout::off();
    let features = wave([1, 9, 20], 1, &device);
    let longer = Tensor::cat(vec![features.clone(), wave([1, 4, 20], 2, &device) * 50.0], 1);
    let (short, long) = (vae.encode(features, &[9], off), vae.encode(longer, &[9], off));
    assert!(worst(&host(short.mu_bnd.clone()), &host(long.mu_bnd)) < 1e-5);
    assert!(worst(&host(short.logvar_bnd.clone()), &host(long.logvar_bnd)) < 1e-5);
    let short_motion = host(vae.decode(short.mu_bnd.clone(), &[9], 9, off));
    let long_motion = host(vae.decode(short.mu_bnd, &[9], 13, off));
    assert!(worst(&short_motion, &long_motion[..9 * 20]) < 1e-5);
    assert!(long_motion[9 * 20..].iter().all(|v| *v == 0.0), "padded frames are exactly zero");
}

#[test]
fn samples_of_a_batch_do_not_see_each_other() {
    let device = Device::flex();
    let student = Denoiser::new(&denoiser_config(Some(8)), &mut draws(&device));
    let (z, text) = (wave([3, 3, 6], 1, &device), wave([3, 2, 10], 2, &device));
    let (times, w) = ([7, 500, 999], guidance_embedding(&[5.0, 7.5, 14.0], 8, &device));
    let off = &mut Dropout::off();
    let together = host(student.forward(z.clone(), &times, text.clone(), Some(w.clone()), off));
    for b in 0..3 {
        let (z, text) = (z.clone().slice([b..b + 1, 0..3, 0..6]), text.clone().slice([b..b + 1, 0..2, 0..10]));
        let alone = host(student.forward(z, &times[b..=b], text, Some(w.clone().slice([b..b + 1, 0..8])), off));
        assert!(worst(&alone, &together[b * 18..(b + 1) * 18]) < 1e-5);
    }
}

#[test]
fn a_fresh_student_ignores_its_guidance() {
    let device = Device::flex();
    let teacher = Denoiser::new(&denoiser_config(None), &mut draws(&device));
    let student = Denoiser::new(&denoiser_config(Some(8)), &mut draws(&device));
    let (z, text) = (wave([2, 3, 6], 1, &device), wave([2, 1, 10], 2, &device));
    let off = &mut Dropout::off();
    // The projection is initialised to zero and draws nothing, so both hold the same weights.
    let expected = host(teacher.forward(z.clone(), &[20, 900], text.clone(), None, off));
    for w in [0.0, 6.5, 14.0] {
        let w = guidance_embedding(&[w, w], 8, &device);
        assert_eq!(host(student.forward(z.clone(), &[20, 900], text.clone(), Some(w), off)), expected);
    }
}

#[test]
fn generator_gradients_pass_through_the_frozen_teacher() {
    let device = Device::flex().autodiff();
    let teacher = Denoiser::new(&denoiser_config(None), &mut draws(&device)).no_grad();
    let heads = Discriminator::new(5, 16, 0.01, &mut draws(&device));
    let fake = wave([2, 3, 6], 1, &device).require_grad();
    let features = teacher.features(fake.clone(), &[40, 700], wave([2, 1, 10], 2, &device), &mut Dropout::off());
    assert_eq!(features.len(), 5, "one per block");
    let scores = heads.forward(features);
    assert!(scores.iter().all(|s| s.dims() == [2, 3, 1]), "a score per latent token");
    let mut gradients = hinge_generator(scores).backward();
    let on_fake = host(fake.grad(&gradients).expect("the teacher lets gradients through"));
    assert!(on_fake.iter().all(|g| g.is_finite()) && on_fake.iter().any(|g| *g != 0.0));
    let on_teacher = take_gradients(&teacher, &mut gradients);
    assert!(on_teacher.iter().all(|g| *g == 0.0), "a frozen network collects no gradients");
    let on_heads = take_gradients(&heads, &mut gradients);
    assert!(on_heads.iter().any(|g| *g != 0.0));
}

#[test]
fn sinusoids_have_the_published_values() {
    let device = Device::flex();
    let near = |found: &[f32], expected: &[f32], slack: f32| assert!(worst(found, expected) < slack, "{found:?}");
    let time = host(time_sinusoid(&[1, 999], 768, &device));
    near(&time[..4], &[0.540_302, 0.560_091, 0.579_108, 0.597_375], 1e-6);
    near(&time[384..388], &[0.841_471, 0.828_431, 0.815_251, 0.801_962], 1e-6);
    near(&time[768..771], &[0.999_650, 0.140_256, -0.953_502], 1e-4);
    near(&time[1152..1155], &[-0.026_461, 0.990_115, -0.301_387], 1e-4);
    let guidance = host(guidance_embedding(&[7.0], 256, &device));
    near(&guidance[..4], &[0.506_885, 0.804_387, -0.860_457, 0.999_944], 1e-3);
    near(&guidance[128..132], &[0.862_013, 0.594_106, -0.509_523, -0.010_555], 1e-3);
}
