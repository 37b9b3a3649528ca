//! CLIP's text tower. Source: Radford et al., arXiv:2103.00020. Tensor names are those of Hugging Face's `CLIPModel`,
//! whose image tower is not read. [`renamed_from_openai`] renames weights under OpenAI's names.
//!
//! Token and position embeddings, causal pre-norm blocks, a norm. A caption's vector is the state at the end token,
//! which has the largest id, or the projection of that state. Padding does not affect the states up to the end token;
//! the states after it depend on it.

use burn::module::Module;
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use serde::{Deserialize, Serialize};

use super::attend::{DEVIATION, Embedding, attend, causal, hiding, linear};
use super::{Init, Linear, Norm};
use crate::kernels::{self, Dropout};

/// The end token's id in published settings; it means "the largest id of the caption".
const LEGACY_END: usize = 2;

/// Activation between the layers of the feed-forward.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClipActivation {
    /// `x sigmoid(1.702 x)`, as in the published towers.
    QuickGelu,
    /// GELU with the error function.
    Gelu,
}

/// Size of the tower, as in `text_config` of a published `config.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClipTextConfig {
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
    /// Activation in the feed-forward.
    pub hidden_act: ClipActivation,
    /// Added to variances in layer norms.
    pub layer_norm_eps: f64,
    /// The end token; 2 means the largest id of a caption.
    pub eos_token_id: usize,
}

/// Tables of tokens and positions.
#[derive(Module, Debug)]
pub struct ClipEmbeddings {
    /// One vector of width H for each token.
    pub token_embedding: Embedding,
    /// One vector of width H for each position.
    pub position_embedding: Embedding,
}

/// Attention with separate projections.
#[derive(Module, Debug)]
pub struct ClipAttention {
    /// H -> H.
    pub k_proj: Linear,
    /// H -> H.
    pub v_proj: Linear,
    /// H -> H.
    pub q_proj: Linear,
    /// H -> H.
    pub out_proj: Linear,
}

/// The feed-forward of two layers.
#[derive(Module, Debug)]
pub struct ClipMlp {
    /// H -> feed-forward width.
    pub fc1: Linear,
    /// Feed-forward width -> H.
    pub fc2: Linear,
}

/// A pre-norm block: `x += Attn(LN1 x)`, `x += MLP(LN2 x)`.
#[derive(Module, Debug)]
pub struct ClipBlock {
    pub self_attn: ClipAttention,
    /// Norm before the attention.
    pub layer_norm1: Norm,
    pub mlp: ClipMlp,
    /// Norm before the feed-forward.
    pub layer_norm2: Norm,
}

/// The stack of blocks.
#[derive(Module, Debug)]
pub struct ClipEncoder {
    /// Blocks, first to last.
    pub layers: Vec<ClipBlock>,
}

/// The tower without its projection.
#[derive(Module, Debug)]
pub struct ClipTextModel {
    pub embeddings: ClipEmbeddings,
    pub encoder: ClipEncoder,
    /// Norm after the blocks.
    pub final_layer_norm: Norm,
}

/// The tower with its projection.
#[derive(Module, Debug)]
pub struct ClipText {
    /// The tower without the projection.
    pub text_model: ClipTextModel,
    /// H -> C, no bias.
    pub text_projection: Linear,
    #[module(skip)]
    config: ClipTextConfig,
}

/// The outputs of the tower for a batch of captions.
#[derive(Debug)]
pub struct ClipStates {
    /// The state of every token, after the last norm: [B, T, H].
    pub tokens_bth: Tensor<3>,
    /// The state of the end token: [B, H].
    pub pooled_bh: Tensor<2>,
    /// The projection of `pooled_bh`, not normalised: [B, C].
    pub projected_bc: Tensor<2>,
}

impl ClipText {
    /// Creates a tower with untrained weights.
    pub fn new(config: &ClipTextConfig, init: &mut Init<'_>) -> Self {
        let width = config.hidden_size;
        let inner = config.intermediate_size;
        let mut block = || {
            let mut square = || linear(init, width, width);
            let self_attn = ClipAttention { k_proj: square(), v_proj: square(), q_proj: square(), out_proj: square() };
            ClipBlock {
                self_attn,
                layer_norm1: Norm::new(init, width),
                mlp: ClipMlp { fc1: linear(init, width, inner), fc2: linear(init, inner, width) },
                layer_norm2: Norm::new(init, width),
            }
        };
        let layers = (0..config.num_hidden_layers).map(|_| block()).collect();
        Self {
            text_model: ClipTextModel {
                embeddings: ClipEmbeddings {
                    token_embedding: Embedding::new(init, config.vocab_size, width),
                    position_embedding: Embedding::new(init, config.max_position_embeddings, width),
                },
                encoder: ClipEncoder { layers },
                final_layer_norm: Norm::new(init, width),
            },
            text_projection: Linear {
                weight: init.scaled_normal(DEVIATION, [config.projection_dim, width]),
                bias: None,
            },
            config: config.clone(),
        }
    }

    /// Encodes `ids` [B T]. `visible` [B T] hides keys. Users of the published models pass `None`, so positions after
    /// the end see the padding.
    ///
    /// # Panics
    /// If there are more tokens than positions, or an id is not in the table.
    pub fn forward(&self, ids: &[usize], batch: usize, visible: Option<&[bool]>) -> ClipStates {
        let embeddings = &self.text_model.embeddings;
        let len = ids.len() / batch;
        let rows = self.config.vocab_size;
        assert!(len <= self.config.max_position_embeddings, "{len} tokens, the tower has too few positions");
        assert!(ids.iter().all(|id| *id < rows), "an id is beyond the table of {rows} tokens");
        let positions: Vec<usize> = (0..len).collect();
        let x = embeddings.token_embedding.rows(ids, batch) + embeddings.position_embedding.rows(&positions, 1);
        let device = x.device();
        let bias = causal(len, &device);
        let bias = visible.map_or_else(|| bias.clone(), |visible| bias.clone() + hiding(visible, batch, &device));
        let x = self.text_model.encoder.layers.iter().fold(x, |x, block| self.block(block, x, &bias));
        let tokens_bth = self.text_model.final_layer_norm.forward(x, self.config.layer_norm_eps);
        let ends = ids.chunks_exact(len).map(|ids| self.end(ids)).enumerate();
        let width = self.config.hidden_size;
        let ends: Vec<Tensor<3>> =
            ends.map(|(b, end)| tokens_bth.clone().slice([b..b + 1, end..end + 1, 0..width])).collect();
        let pooled_bh = Tensor::cat(ends, 0).reshape([batch, width]);
        let projected_bc = self.text_projection.forward(pooled_bh.clone());
        ClipStates { tokens_bth, pooled_bh, projected_bc }
    }

    fn block(&self, block: &ClipBlock, x_bth: Tensor<3>, bias: &Tensor<4>) -> Tensor<3> {
        let eps = self.config.layer_norm_eps;
        let attention = &block.self_attn;
        let normed = block.layer_norm1.forward(x_bth.clone(), eps);
        let (q, k, v) = (
            attention.q_proj.forward(normed.clone()),
            attention.k_proj.forward(normed.clone()),
            attention.v_proj.forward(normed),
        );
        let heads = self.config.num_attention_heads;
        let attended = attend(q, k, v, heads, Some(bias.clone()), &mut Dropout::off());
        let x = x_bth + attention.out_proj.forward(attended);
        let inner = block.mlp.fc1.forward(block.layer_norm2.forward(x.clone(), eps));
        let inner = match self.config.hidden_act {
            ClipActivation::QuickGelu => inner.clone() * sigmoid(inner * 1.702),
            ClipActivation::Gelu => kernels::gelu(inner),
        };
        x + block.mlp.fc2.forward(inner)
    }

    /// The position of a caption's end: its first end token, or the first of its largest ids.
    fn end(&self, ids: &[usize]) -> usize {
        let end = match self.config.eos_token_id {
            LEGACY_END => ids.iter().copied().max().unwrap_or_default(),
            end => end,
        };
        ids.iter().position(|id| *id == end).unwrap_or_default()
    }
}

/// Converts a tensor under OpenAI's name into tensors under Hugging Face's names. Returns none for tensors that the
/// text tower lacks. `shape` must be the shape of the values.
pub fn renamed_from_openai(name: &str, shape: &[usize], values: Vec<f32>) -> Vec<(String, Vec<usize>, Vec<f32>)> {
    let same = |name: &str, values: Vec<f32>| vec![(name.to_owned(), shape.to_vec(), values)];
    match name {
        "token_embedding.weight" => same("text_model.embeddings.token_embedding.weight", values),
        "positional_embedding" => same("text_model.embeddings.position_embedding.weight", values),
        "ln_final.weight" => same("text_model.final_layer_norm.weight", values),
        "ln_final.bias" => same("text_model.final_layer_norm.bias", values),
        "text_projection" => {
            // OpenAI's shape is [H, C]; Hugging Face's is [C, H].
            let &[width, out] = shape else { return Vec::new() };
            let turned = (0..out).flat_map(|c| (0..width).map(move |h| h * out + c)).map(|at| values[at]).collect();
            vec![("text_projection.weight".to_owned(), vec![out, width], turned)]
        }
        _ => {
            let Some((layer, rest)) = name.strip_prefix("transformer.resblocks.").and_then(|rest| rest.split_once('.'))
            else {
                return Vec::new();
            };
            let layer = format!("text_model.encoder.layers.{layer}");
            if let Some(what) = rest.strip_prefix("attn.in_proj_") {
                let third = [&[shape[0] / 3], &shape[1..]].concat();
                let parts = values.chunks(values.len() / 3).zip(["q_proj", "k_proj", "v_proj"]);
                return parts
                    .map(|(part, which)| (format!("{layer}.self_attn.{which}.{what}"), third.clone(), part.to_vec()))
                    .collect();
            }
            let (module, what) = rest.rsplit_once('.').unwrap_or((rest, ""));
            let module = match module {
                "attn.out_proj" => "self_attn.out_proj",
                "ln_1" => "layer_norm1",
                "ln_2" => "layer_norm2",
                "mlp.c_fc" => "mlp.fc1",
                "mlp.c_proj" => "mlp.fc2",
                _ => return Vec::new(),
            };
            same(&format!("{layer}.{module}.{what}"), values)
        }
    }
}
