//! Networks built from a fixture's configuration, and comparison of their gradients.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use models::flat::{self, Entry};
use models::names;
use models::networks::{Denoiser, DenoiserConfig, Init, Vae, VaeConfig};
use models::optim::global_norm;
use protocol::Seed;
use protocol::stage::{LatentShape, Network, Positions};
use serde_json::Value;

use crate::common::{Array, Arrays, Gates, error, relative};

/// Gate of whole gradients of single parameters.
const GRADIENT: f64 = 1e-4;
/// Gate of the norm of all gradients, relative.
const GLOBAL: f64 = 1e-4;
/// Gate of the norm of one parameter's gradient, relative, after an allowance of `ALLOWANCE` times the global norm.
const PARAMETER: f64 = 1e-3;
const ALLOWANCE: f64 = 1e-7;

pub(crate) fn count(config: &Value, key: &str) -> usize {
    config[key].as_u64().unwrap_or_else(|| panic!("`{key}` is a number")) as usize
}

/// Refuses a configuration with options that our networks do not have.
pub(crate) fn only(config: &Value, fixed: &[(&str, Value)]) {
    for (key, value) in fixed {
        assert_eq!(&config[*key], value, "only this `{key}` exists here");
    }
}

/// Sizes of a VAE: (N, d, H, projection).
fn sizes(config: &Value) -> (usize, usize, usize, bool) {
    let latent: Vec<usize> = serde_json::from_value(config["latent_dim"].clone()).expect("two sizes");
    let width = config["hidden_dim"].as_u64().map_or(latent[1], |w| w as usize);
    let projection = config["force_pre_post_proj"].as_bool().expect("a flag") || width != latent[1];
    (latent[0], latent[1], width, projection)
}

pub(crate) fn draws(device: &Device) -> Init<'_> {
    Init::new(Seed(1), "parity", Positions::Uniform, device)
}

/// A VAE from the constructor arguments, with the fixture's weights.
pub(crate) fn vae(config: &Value, weights: &Path, device: &Device) -> Vae {
    vae_at(config, weights, "", device)
}

/// Like [`vae`], with the weights under `prefix`.
pub(crate) fn vae_at(config: &Value, weights: &Path, prefix: &str, device: &Device) -> Vae {
    only(
        config,
        &[
            ("arch", "encoder_decoder".into()),
            ("normalize_before", false.into()),
            ("activation", "gelu".into()),
            ("norm_post", true.into()),
            ("norm_eps", 1e-5.into()),
            ("activation_post", Value::Null),
            ("position_embedding", "learned".into()),
        ],
    );
    let (tokens, dim, width, projection) = sizes(config);
    let config = VaeConfig {
        features: count(config, "nfeats"),
        latent: LatentShape { tokens, dim },
        network: Network {
            width,
            layers: count(config, "num_layers"),
            heads: count(config, "num_heads"),
            feed_forward: count(config, "ff_size"),
            ..Network::default()
        },
        projection,
    };
    load(Vae::new(&config, &mut draws(device)), weights, prefix)
}

/// A denoiser from the constructor arguments, with the fixture's weights under `prefix`.
pub(crate) fn denoiser(config: &Value, weights: &Path, prefix: &str, device: &Device) -> Denoiser {
    load(Denoiser::new(&denoiser_config(config), &mut draws(device)), weights, prefix)
}

/// A denoiser's size from its constructor arguments.
pub(crate) fn denoiser_config(config: &Value) -> DenoiserConfig {
    only(
        config,
        &[
            ("arch", "trans_enc".into()),
            ("normalize_before", false.into()),
            ("activation", "gelu".into()),
            ("norm_post", true.into()),
            ("norm_eps", 1e-5.into()),
            ("activation_post", Value::Null),
            ("flip_sin_to_cos", true.into()),
            ("freq_shift", 0.into()),
            ("time_act_fn", "silu".into()),
            ("time_post_act_fn", Value::Null),
            ("position_embedding", "learned".into()),
        ],
    );
    let (tokens, dim, width, projection) = sizes(config);
    let text_relu = match config["text_act_fn"].as_str() {
        None => false,
        Some("relu") => true,
        Some(other) => panic!("activation `{other}` on the text does not exist here"),
    };
    DenoiserConfig {
        latent: LatentShape { tokens, dim },
        network: Network {
            width,
            layers: count(config, "num_layers"),
            heads: count(config, "num_heads"),
            feed_forward: count(config, "ff_size"),
            ..Network::default()
        },
        text_dim: count(config, "text_dim"),
        time_dim: count(config, "time_dim"),
        text_relu,
        projection,
        guidance_dim: config["time_cond_proj_dim"].as_u64().map(|g| g as usize),
    }
}

pub(crate) fn load<M: Module>(module: M, weights: &Path, prefix: &str) -> M {
    let bytes = std::fs::read(weights).unwrap_or_else(|e| panic!("cannot read {}: {e}", weights.display()));
    names::load(module, &bytes, prefix).unwrap_or_else(|e| panic!("{}: {e}", weights.display()))
}

/// Gradients of `loss`, flat.
pub(crate) fn gradients<M: Module>(module: &M, loss: Tensor<1>) -> Vec<f32> {
    flat::gradient(module, loss)
}

/// Calls `each` with the name and values of every parameter of a flat buffer.
pub(crate) fn split<'a>(entries: &'a [Entry], flat: &'a [f32]) -> impl Iterator<Item = (&'a Entry, &'a [f32])> {
    let mut at = 0;
    entries.iter().map(move |entry| {
        at += entry.len();
        (entry, &flat[at - entry.len()..at])
    })
}

/// Compares flat gradients with `{global_norm, per_parameter, no_gradient}` and with the whole gradients that `io`
/// stores under `prefix/`. Some cases leave out `per_parameter`.
pub(crate) fn check_gradients(
    gates: &mut Gates,
    entries: &[Entry],
    found: &[f32],
    expected: &Value,
    io: &Arrays,
    prefix: &str,
) {
    let global = expected["global_norm"].as_f64().expect("a norm");
    gates.check("grad norm", prefix, relative(global_norm(found), global), GLOBAL);
    for (entry, values) in split(entries, found) {
        if let Some(whole) = io.find(&format!("{prefix}/{}", entry.name)) {
            gates.check("whole grad", format!("{prefix} {}", entry.name), error(values, &whole.values), GRADIENT);
        }
    }
    // The smaller cases of a fixture store no norms per parameter.
    let Some(norms) = expected["per_parameter"].as_object() else { return };
    let unused: Vec<&str> =
        expected["no_gradient"].as_array().expect("names").iter().filter_map(Value::as_str).collect();
    assert_eq!(norms.len() + unused.len(), entries.len(), "{prefix}: as many parameters as stored norms");
    for (entry, values) in split(entries, found) {
        let name = &entry.name;
        let norm = global_norm(values);
        if unused.contains(&name.as_str()) {
            assert_eq!(norm, 0.0, "{prefix}: `{name}` takes no part");
            continue;
        }
        let stored =
            norms.get(name).and_then(Value::as_f64).unwrap_or_else(|| panic!("{prefix} has no norm of `{name}`"));
        let off = ((norm - stored).abs() - ALLOWANCE * global).max(0.0);
        gates.check("grad of parameter", format!("{prefix} {name}"), off / stored.max(ALLOWANCE * global), PARAMETER);
    }
}

/// Timesteps of a batch: one per sample, or one for all.
pub(crate) fn timesteps(array: &Array, batch: usize) -> Vec<usize> {
    let values = array.usizes();
    if values.len() == 1 { vec![values[0]; batch] } else { values }
}

/// A scalar tensor's value.
pub(crate) fn scalar(tensor: &Tensor<1>) -> f64 {
    f64::from(crate::common::values(tensor.clone())[0])
}

/// Repeats the one row of [1, L, C] for a batch.
pub(crate) fn repeated(tensor: Tensor<3>, batch: usize) -> Tensor<3> {
    let [_, len, width] = tensor.dims();
    tensor.expand([batch, len, width])
}
