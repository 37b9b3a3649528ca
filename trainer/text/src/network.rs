//! Sizes of published encoders from their `config.json`, and their tensors.
//!
//! Sources: the configurations of `CLIPTextModel` and `T5EncoderModel` in Hugging Face's transformers, whose defaults
//! replace keys that a file leaves out.

use protocol::{excerpt, json_mistake};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Largest accepted width; published ones are below 11,000.
pub(crate) const WIDEST: usize = 65_536;
/// Largest accepted number of rows of a token table.
const ROWS: usize = 4_000_000;
/// Largest accepted number of positions, and so of tokens of a caption.
const POSITIONS: usize = 4_096;

/// Name and shape of a tensor of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSpec {
    /// Published name of the tensor.
    pub name: String,
    /// Length of each axis.
    pub shape: Vec<usize>,
}

/// Sizes of CLIP's text tower.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ClipSizes {
    /// Rows of the token table.
    pub vocab_size: usize,
    pub hidden_size: usize,
    pub intermediate_size: usize,
    /// Number of blocks.
    pub num_hidden_layers: usize,
    /// Number of attention heads.
    pub num_attention_heads: usize,
    /// Largest number of tokens.
    pub max_position_embeddings: usize,
    /// Width C of a projected caption.
    pub projection_dim: usize,
    /// Activation of the feed-forward, `quick_gelu` or `gelu`.
    pub hidden_act: String,
    /// Epsilon that layer norms add to the variance.
    pub layer_norm_eps: f64,
    /// The end token; in published files 2 means the largest id of a caption.
    pub eos_token_id: usize,
}

impl Default for ClipSizes {
    fn default() -> Self {
        Self {
            vocab_size: 49_408,
            hidden_size: 512,
            intermediate_size: 2_048,
            num_hidden_layers: 12,
            num_attention_heads: 8,
            max_position_embeddings: 77,
            projection_dim: 512,
            hidden_act: "quick_gelu".into(),
            layer_norm_eps: 1e-5,
            eos_token_id: 2,
        }
    }
}

/// Sizes of T5's encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct T5Sizes {
    /// Rows of the token table.
    pub vocab_size: usize,
    pub d_model: usize,
    /// Width of a head.
    pub d_kv: usize,
    pub d_ff: usize,
    /// Number of blocks.
    pub num_layers: usize,
    /// Number of attention heads.
    pub num_heads: usize,
    /// Number of buckets of distances.
    pub relative_attention_num_buckets: usize,
    /// Distances from this one on share a bucket.
    pub relative_attention_max_distance: usize,
    /// Added to mean squares in norms.
    pub layer_norm_epsilon: f64,
    /// Form of the feed-forward, `relu` or `gated-gelu`.
    pub feed_forward_proj: String,
    /// Id that pads a caption.
    pub pad_token_id: u32,
}

impl Default for T5Sizes {
    fn default() -> Self {
        Self {
            vocab_size: 32_128,
            d_model: 512,
            d_kv: 64,
            d_ff: 2_048,
            num_layers: 6,
            num_heads: 8,
            relative_attention_num_buckets: 32,
            relative_attention_max_distance: 128,
            layer_norm_epsilon: 1e-6,
            feed_forward_proj: "relu".into(),
            pad_token_id: 0,
        }
    }
}

/// A network with its sizes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "network", rename_all = "lowercase")]
pub enum Network {
    /// CLIP's text tower.
    Clip(ClipSizes),
    /// T5's encoder without further layers.
    T5(T5Sizes),
}

/// Refuses a value of a key outside `1..=most`.
fn size(key: &str, value: usize, most: usize) -> Result<(), String> {
    if (1..=most).contains(&value) {
        return Ok(());
    }
    Err(format!("`{key}` is {value}; expected 1 to {most}"))
}

fn small(key: &str, value: f64) -> Result<(), String> {
    if value > 0.0 && value < 1.0 {
        Ok(())
    } else {
        Err(format!("`{key}` is {value}; expected a number above 0 and below 1"))
    }
}

/// The value of `model_type`, or an empty string.
fn model_type(config: &Value) -> &str {
    config["model_type"].as_str().unwrap_or_default()
}

impl Network {
    /// Reads CLIP's `config.json`, of the whole model or of the text tower alone.
    ///
    /// # Errors
    /// The invalid key, and the expected value.
    pub fn clip(config: &Value) -> Result<Self, String> {
        let found = model_type(config);
        let mut text = match found {
            "clip" if config["text_config"].is_object() => config["text_config"].clone(),
            "clip_text_model" => config.clone(),
            _ => {
                return Err(format!(
                    "`model_type` is `{}`; expected `clip` with `text_config`, or `clip_text_model`",
                    excerpt(found)
                ));
            }
        };
        if let Some(width) = config.get("projection_dim") {
            text["projection_dim"] = width.clone();
        }
        let sizes: ClipSizes = serde_json::from_value(text).map_err(|e| json_mistake(&e))?;
        let network = Self::Clip(sizes);
        network.check()?;
        Ok(network)
    }

    /// Reads the `config.json` of a T5 encoder.
    ///
    /// # Errors
    /// As [`clip`](Self::clip).
    pub fn t5(config: &Value) -> Result<Self, String> {
        let found = model_type(config);
        if found != "t5" {
            return Err(format!("`model_type` is `{}`; expected `t5`", excerpt(found)));
        }
        let network = Self::T5(serde_json::from_value(config.clone()).map_err(|e| json_mistake(&e))?);
        network.check()?;
        Ok(network)
    }

    /// Refuses sizes that no network has.
    ///
    /// # Errors
    /// The invalid key, and the expected value.
    pub fn check(&self) -> Result<(), String> {
        match self {
            Self::Clip(of) => {
                size("vocab_size", of.vocab_size, ROWS)?;
                size("hidden_size", of.hidden_size, WIDEST)?;
                size("intermediate_size", of.intermediate_size, WIDEST)?;
                size("num_hidden_layers", of.num_hidden_layers, 255)?;
                size("num_attention_heads", of.num_attention_heads, 1_024)?;
                size("max_position_embeddings", of.max_position_embeddings, POSITIONS)?;
                size("projection_dim", of.projection_dim, WIDEST)?;
                small("layer_norm_eps", of.layer_norm_eps)?;
                let width = of.hidden_size;
                let heads = of.num_attention_heads;
                if width % heads != 0 {
                    return Err(format!("`hidden_size` is {width}; expected a multiple of the {heads} heads"));
                }
                match of.hidden_act.as_str() {
                    "quick_gelu" | "gelu" => Ok(()),
                    other => Err(format!("`hidden_act` is `{}`; expected `quick_gelu` or `gelu`", excerpt(other))),
                }
            }
            Self::T5(of) => {
                size("vocab_size", of.vocab_size, ROWS)?;
                size("d_model", of.d_model, WIDEST)?;
                size("d_kv", of.d_kv, WIDEST)?;
                size("d_ff", of.d_ff, WIDEST)?;
                size("num_layers", of.num_layers, 255)?;
                size("num_heads", of.num_heads, 1_024)?;
                size("relative_attention_num_buckets", of.relative_attention_num_buckets, WIDEST)?;
                size("relative_attention_max_distance", of.relative_attention_max_distance, WIDEST)?;
                small("layer_norm_epsilon", of.layer_norm_epsilon)?;
                let buckets = of.relative_attention_num_buckets;
                let most = of.relative_attention_max_distance;
                if buckets % 4 != 0 || most <= buckets / 4 {
                    return Err(format!(
                        "there are {buckets} buckets up to a distance of {most}; expected a multiple of 4, and a \
                         distance above a quarter of it"
                    ));
                }
                match of.feed_forward_proj.as_str() {
                    "relu" | "gated-gelu" => Ok(()),
                    other => {
                        Err(format!("`feed_forward_proj` is `{}`; expected `relu` or `gated-gelu`", excerpt(other)))
                    }
                }
            }
        }
    }

    /// Number of rows of the token table.
    pub fn rows(&self) -> usize {
        match self {
            Self::Clip(sizes) => sizes.vocab_size,
            Self::T5(sizes) => sizes.vocab_size,
        }
    }

    /// Width of a token's state.
    pub fn width(&self) -> usize {
        match self {
            Self::Clip(sizes) => sizes.hidden_size,
            Self::T5(sizes) => sizes.d_model,
        }
    }

    /// Largest number of tokens of a caption. T5 has no limit, but its attention grows with the square of the number.
    pub fn positions(&self) -> usize {
        match self {
            Self::Clip(sizes) => sizes.max_position_embeddings,
            Self::T5(_) => POSITIONS,
        }
    }

    /// Every tensor of the network, under its published name.
    pub fn tensors(&self) -> Vec<TensorSpec> {
        let mut all = Vec::new();
        let mut add = |name: String, shape: &[usize]| all.push(TensorSpec { name, shape: shape.to_vec() });
        match self {
            Self::Clip(of) => {
                let width = of.hidden_size;
                let inner = of.intermediate_size;
                add("text_model.embeddings.token_embedding.weight".into(), &[of.vocab_size, width]);
                add("text_model.embeddings.position_embedding.weight".into(), &[of.max_position_embeddings, width]);
                for layer in 0..of.num_hidden_layers {
                    let name = |part: &str| format!("text_model.encoder.layers.{layer}.{part}");
                    for part in ["k_proj", "v_proj", "q_proj", "out_proj"] {
                        add(name(&format!("self_attn.{part}.weight")), &[width, width]);
                        add(name(&format!("self_attn.{part}.bias")), &[width]);
                    }
                    for (part, from, to) in [("fc1", width, inner), ("fc2", inner, width)] {
                        add(name(&format!("mlp.{part}.weight")), &[to, from]);
                        add(name(&format!("mlp.{part}.bias")), &[to]);
                    }
                    for part in ["layer_norm1", "layer_norm2"] {
                        add(name(&format!("{part}.weight")), &[width]);
                        add(name(&format!("{part}.bias")), &[width]);
                    }
                }
                add("text_model.final_layer_norm.weight".into(), &[width]);
                add("text_model.final_layer_norm.bias".into(), &[width]);
                add("text_projection.weight".into(), &[of.projection_dim, width]);
            }
            Self::T5(of) => {
                let width = of.d_model;
                let inner = of.num_heads * of.d_kv;
                add("shared.weight".into(), &[of.vocab_size, width]);
                for layer in 0..of.num_layers {
                    let name = |part: &str| format!("encoder.block.{layer}.layer.{part}.weight");
                    for part in ["q", "k", "v"] {
                        add(name(&format!("0.SelfAttention.{part}")), &[inner, width]);
                    }
                    add(name("0.SelfAttention.o"), &[width, inner]);
                    if layer == 0 {
                        let buckets = of.relative_attention_num_buckets;
                        add(name("0.SelfAttention.relative_attention_bias"), &[buckets, of.num_heads]);
                    }
                    add(name("0.layer_norm"), &[width]);
                    let ups: &[&str] = if of.feed_forward_proj == "relu" { &["wi"] } else { &["wi_0", "wi_1"] };
                    for up in ups {
                        add(name(&format!("1.DenseReluDense.{up}")), &[of.d_ff, width]);
                    }
                    add(name("1.DenseReluDense.wo"), &[width, of.d_ff]);
                    add(name("1.layer_norm"), &[width]);
                }
                add("encoder.final_layer_norm.weight".into(), &[width]);
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// The published numbers of parameters of the papers' encoders.
    #[test]
    fn published_sizes_have_their_published_parameters() {
        protocol::show_excerpts();
        let count = |network: &Network| -> usize {
            network.tensors().iter().map(|tensor| tensor.shape.iter().product::<usize>()).sum()
        };
        let clip = Network::clip(&json!({"model_type": "clip", "projection_dim": 512, "text_config": {}})).unwrap();
        // ViT-B/32: 63,165,952 for the tower and 512 x 512 for the projection.
        assert_eq!(count(&clip), 63_165_952 + 512 * 512);
        let large = json!({"model_type": "t5", "d_model": 1024, "d_ff": 4096, "num_layers": 24, "num_heads": 16});
        assert_eq!(count(&Network::t5(&large).unwrap()), 334_939_648, "Sentence-T5-large");
    }

    #[test]
    fn sizes_that_no_network_has_are_refused_by_name() {
        protocol::show_excerpts();
        let clip =
            |key: &str, value: Value| Network::clip(&json!({"model_type": "clip_text_model", key: value})).unwrap_err();
        assert!(clip("vocab_size", json!(1_u64 << 40)).contains("`vocab_size` is 1099511627776; expected 1 to"));
        assert!(clip("hidden_size", json!(500)).contains("a multiple of the 8 heads"));
        assert!(clip("num_hidden_layers", json!(0)).contains("`num_hidden_layers` is 0"));
        assert!(clip("hidden_act", json!("relu")).contains("expected `quick_gelu` or `gelu`"));
        assert!(clip("layer_norm_eps", json!(-1)).contains("above 0"));
        assert!(clip("hidden_size", json!("wide")).contains("expected usize"));
        assert!(Network::clip(&json!({"model_type": "bert"})).unwrap_err().contains("`model_type` is `bert`"));
        let t5 = |key: &str, value: Value| Network::t5(&json!({"model_type": "t5", key: value})).unwrap_err();
        assert!(t5("relative_attention_num_buckets", json!(3)).contains("3 buckets"));
        assert!(t5("feed_forward_proj", json!("gated-silu")).contains("gated-gelu"));
        assert!(Network::t5(&json!([])).unwrap_err().contains("expected `t5`"));
    }
}
