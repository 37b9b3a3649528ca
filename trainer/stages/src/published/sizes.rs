//! Sizes of published networks, derived from the shapes of their weights, and the places of networks in files.
//!
//! A size comes from a tensor with that many elements along an axis. Every other tensor of the network is compared with
//! the sizes before anything is allocated.

use models::networks::{
    DenoiserConfig, GptConfig, LEVELS, MdmConfig, MmmConfig, MomaskConfig, Projection, STRIDE, TimeFeatures,
    TokenizerConfig, TrajectoryConfig, UnetConfig, VaeConfig,
};
use protocol::limits;
use protocol::stage::{LatentShape, MdmNetwork, Network, TokenNetwork, TokenizerNetwork};

use super::{Found, Place};
use crate::context::StageError;

/// Largest number of a network's consecutive blocks, and of codebooks.
const BLOCKS: usize = 255;
/// Largest number of residual blocks in a tokenizer's level.
const DEPTH: usize = 16;

type Result<T> = std::result::Result<T, StageError>;

/// MLD's or MotionLCM's VAE.
pub const VAE: Place = Place::new("VAE", &["state_dict.vae.", "vae.", "state_dict.", ""], "query_pos_decoder.pe");
/// MLD's or MotionLCM's denoiser.
pub const DENOISER: Place =
    Place::new("denoiser", &["state_dict.denoiser.", "denoiser.", "state_dict.", ""], "time_embedding.linear_1.weight");
/// MotionLCM's ControlNet.
pub const CONTROLNET: Place =
    Place::new("ControlNet", &["state_dict.controlnet.", "controlnet."], "controlnet_cond_embedding.0.weight");
/// MotionLCM's trajectory encoder.
pub const TRAJECTORY_ENCODER: Place =
    Place::new("trajectory encoder", &["state_dict.traj_encoder.", "traj_encoder."], "skel_embedding.weight");
/// The tokenizer of T2M-GPT, MMM or MoMask.
pub const TOKENIZER: Place =
    Place::new("tokenizer", &["vq_model.", "net.vqvae.", "net.", "vqvae.", "tokenizer.", ""], "encoder.model.0.weight");
/// MoMask's masked transformer.
pub const MASKED: Place = Place::new(
    "masked transformer",
    &["t2m_transformer.", "trans.", "mask.", "generator.mask.", ""],
    "token_emb.weight",
);
/// MoMask's residual transformer.
pub const RESIDUAL: Place =
    Place::new("residual transformer", &["res_transformer.", "res.", "generator.res.", ""], "quant_emb.weight");
/// T2M-GPT's transformer.
pub const GPT: Place = Place::new("transformer of T2M-GPT", &["trans.", "generator.", ""], "trans_base.tok_emb.weight");
/// MMM's transformer.
pub const MMM: Place =
    Place::new("transformer of MMM", &["trans.", "generator.", ""], "trans_base.learn_tok_emb.weight");
/// MDM; the average of its weights is preferred.
pub const MDM: Place =
    Place::new("MDM", &["model_avg.", "model.", "state_dict.", "denoiser.", ""], "embed_timestep.time_embed.0.weight");
/// DisCoRD's U-Net.
pub const UNET: Place =
    Place::new("U-Net of DisCoRD", &["", "state_dict.", "model.", "decoder."], "net.init_proj.weight");

/// Number of entries in a list of blocks. Refuses more than any network has.
fn listed(found: &Found<'_>, stem: &str) -> Result<usize> {
    let count = found.count(stem);
    if count > BLOCKS {
        return Err(found.refuse(format!("`{stem}` has {count} entries; expected at most {BLOCKS}")));
    }
    Ok(count)
}

/// Size of a skip stack.
fn stack(found: &Found<'_>, stem: &str, heads: usize) -> Result<Network> {
    let width = found.dim(&format!("{stem}.middle_block.self_attn.in_proj_weight"), 1)?;
    Ok(Network {
        width,
        layers: 2 * listed(found, &format!("{stem}.input_blocks"))? + 1,
        heads: divided(found, width, heads)?,
        feed_forward: found.dim(&format!("{stem}.middle_block.linear1.weight"), 0)?,
        ..Network::default()
    })
}

/// Size of consecutive blocks, without an embedding.
fn blocks(found: &Found<'_>, stem: &str, heads: usize) -> Result<TokenNetwork> {
    let width = found.dim(&format!("{stem}.0.self_attn.in_proj_weight"), 1)?;
    Ok(TokenNetwork {
        width,
        layers: listed(found, stem)?,
        heads: divided(found, width, heads)?,
        feed_forward: found.dim(&format!("{stem}.0.linear1.weight"), 0)?,
        ..TokenNetwork::default()
    })
}

/// Refuses heads that do not divide the width.
fn divided(found: &Found<'_>, width: usize, heads: usize) -> Result<usize> {
    if heads > 0 && width.is_multiple_of(heads) {
        return Ok(heads);
    }
    Err(found
        .refuse(format!("its width is {width}, which is not a multiple of the {heads} attention heads; set `heads`")))
}

/// An axis of a tensor minus `less`. Refuses a result below 1.
fn without(found: &Found<'_>, name: &str, axis: usize, less: usize) -> Result<usize> {
    let all = found.dim(name, axis)?;
    let few = || found.refuse(format!("`{name}` has {all} rows; expected more than {less}"));
    all.checked_sub(less).filter(|rest| *rest > 0).ok_or_else(few)
}

/// Sizes of a VAE.
pub fn of_vae(found: &Found<'_>, heads: usize) -> Result<VaeConfig> {
    let network = stack(found, "encoder", heads)?;
    let projection = found.has("latent_pre.weight");
    let tokens = found.dim("global_motion_token", 0)?;
    // Each latent token has a mean and a deviation, and they precede the frames.
    let most = 2 * limits::LATENT_TOKENS;
    if !tokens.is_multiple_of(2) || tokens as u64 > most {
        return Err(
            found.refuse(format!("`global_motion_token` has {tokens} rows; expected an even number, at most {most}"))
        );
    }
    Ok(VaeConfig {
        features: found.dim("skel_embedding.weight", 1)?,
        latent: LatentShape {
            tokens: tokens / 2,
            dim: if projection { found.dim("latent_pre.weight", 0)? } else { network.width },
        },
        network,
        projection,
    })
}

/// Sizes of a denoiser of latents of `tokens` tokens, which the weights do not show. The ReLU is assumed without
/// projections.
pub fn of_denoiser(found: &Found<'_>, tokens: usize, heads: usize) -> Result<DenoiserConfig> {
    let network = stack(found, "encoder", heads)?;
    let projection = found.has("latent_pre.weight");
    let guided = "time_embedding.cond_proj.weight";
    let guidance_dim = if found.has(guided) { Some(found.dim(guided, 1)?) } else { None };
    let time_dim = found.dim(DENOISER.marker, 1)?;
    // Pairs of a sine and a cosine; the guidance has at least two pairs, since its frequencies divide by their number
    // less one.
    for (what, dim, least) in [("time", time_dim, 2), ("guidance", guidance_dim.unwrap_or(4), 4)] {
        if dim < least || !dim.is_multiple_of(2) {
            return Err(
                found.refuse(format!("its {what} has {dim} numbers; expected an even number, at least {least}"))
            );
        }
    }
    Ok(DenoiserConfig {
        latent: LatentShape {
            tokens,
            dim: if projection { found.dim("latent_pre.weight", 1)? } else { network.width },
        },
        network,
        text_dim: found.dim("emb_proj.1.weight", 1)?,
        time_dim,
        text_relu: !projection,
        projection,
        guidance_dim,
    })
}

/// Sizes of a trajectory encoder.
pub fn of_trajectory(found: &Found<'_>, heads: usize) -> Result<TrajectoryConfig> {
    let network = stack(found, "encoder", heads)?;
    let projection = found.has("latent_proj.weight");
    let coordinates = found.dim("skel_embedding.weight", 1)?;
    if !coordinates.is_multiple_of(3) {
        return Err(found.refuse(format!("`skel_embedding.weight` has {coordinates} inputs; expected three per joint")));
    }
    Ok(TrajectoryConfig {
        joints: coordinates / 3,
        latent: LatentShape {
            tokens: found.dim("global_motion_token", 0)?,
            dim: if projection { found.dim("latent_proj.weight", 0)? } else { network.width },
        },
        network,
        projection,
    })
}

/// A tokenizer's networks and codebooks.
#[derive(Debug, Clone, PartialEq)]
pub struct TokenizerSizes {
    /// Size of the networks.
    pub config: TokenizerConfig,
    /// Number of codes of a codebook.
    pub codes: usize,
    /// Number of codebooks.
    pub quantizers: usize,
    /// True if the only codebook has no number in its name (T2M-GPT, MMM).
    pub single: bool,
}

/// Sizes of a tokenizer; its weights do not show the growth of its dilations.
pub fn of_tokenizer(found: &Found<'_>, growth: usize) -> Result<TokenizerSizes> {
    let single = found.has("quantizer.codebook");
    let first = if single { "quantizer.codebook" } else { "quantizer.layers.0.codebook" };
    let depth = found.count("encoder.model.2.1.model");
    if !(1..=DEPTH).contains(&depth) {
        return Err(found.refuse(format!("a level has {depth} residual blocks; expected 1 to {DEPTH}")));
    }
    let books = (0..BLOCKS).take_while(|q| found.has(&format!("quantizer.layers.{q}.codebook"))).count();
    let taps = found.dim("encoder.model.2.0.weight", 2)?;
    if taps != 2 * STRIDE || !found.has(&format!("encoder.model.{}.weight", LEVELS + 2)) {
        return Err(
            found.refuse(format!("its encoder does not halve the frames {LEVELS} times, as all published encoders do"))
        );
    }
    Ok(TokenizerSizes {
        config: TokenizerConfig {
            features: found.dim("encoder.model.0.weight", 1)?,
            dim: found.dim(first, 1)?,
            network: TokenizerNetwork {
                width: found.dim("encoder.model.0.weight", 0)?,
                depth,
                growth,
                ..TokenizerNetwork::default()
            },
        },
        codes: found.dim(first, 0)?,
        quantizers: if single { 1 } else { books },
        single,
    })
}

/// Sizes of MoMask's masked transformer; its weights do not show the number of codebooks.
pub fn of_masked(found: &Found<'_>, quantizers: usize, heads: usize) -> Result<MomaskConfig> {
    let network = blocks(found, "seqTransEncoder.layers", heads)?;
    Ok(MomaskConfig {
        codes: without(found, "token_emb.weight", 0, 2)?,
        quantizers,
        network: TokenNetwork { embedding: found.dim("token_emb.weight", 1)?, ..network },
        text_dim: found.dim("cond_emb.weight", 1)?,
    })
}

/// Sizes of MoMask's residual transformer, with shared weights as published.
pub fn of_residual(found: &Found<'_>, heads: usize) -> Result<MomaskConfig> {
    if found.has("output_proj_bias") {
        return Err(
            found.refuse("its output tables differ from its input tables; published residual transformers share them")
        );
    }
    let network = blocks(found, "seqTransEncoder.layers", heads)?;
    let quantizers = found.dim("quant_emb.weight", 1)?;
    if quantizers < 3 {
        return Err(found.refuse(format!("it has {quantizers} codebooks; expected at least 3")));
    }
    Ok(MomaskConfig {
        codes: without(found, "token_embed_weight_", 1, 1)?,
        quantizers,
        network: TokenNetwork { embedding: found.dim("token_embed_weight_", 2)?, ..network },
        text_dim: found.dim("cond_emb.weight", 1)?,
    })
}

/// Number of positions of T2M-GPT or MMM, including caption and end, from the rows of the tables.
fn positions(found: &Found<'_>, longest: usize) -> Result<usize> {
    let table =
        ["trans_base.pos_embed.embed", "trans_base.pos_embedding.weight"].into_iter().find(|name| found.has(name));
    let block = table.map_or(Ok(longest + 2), |name| found.dim(name, 0))?;
    if block < 3 {
        return Err(found.refuse(format!("it has {block} positions; expected at least 3")));
    }
    Ok(block)
}

/// Feed-forward width, a multiple of the width.
fn multiple(found: &Found<'_>, name: &str, width: usize) -> Result<usize> {
    let wide = found.dim(name, 0)?;
    if !wide.is_multiple_of(width) {
        return Err(found.refuse(format!("`{name}` has {wide} rows; expected a multiple of the width, {width}")));
    }
    Ok(wide)
}

/// Sizes of T2M-GPT's transformer; `longest` tokens if the file has no table of positions.
pub fn of_gpt(found: &Found<'_>, longest: usize, heads: usize) -> Result<GptConfig> {
    let width = found.dim("trans_base.blocks.0.attn.key.weight", 0)?;
    Ok(GptConfig {
        codes: without(found, "trans_base.tok_emb.weight", 0, 2)?,
        network: TokenNetwork {
            width,
            layers: listed(found, "trans_base.blocks")?,
            heads: divided(found, width, heads)?,
            feed_forward: multiple(found, "trans_base.blocks.0.mlp.0.weight", width)?,
            ..TokenNetwork::default()
        },
        block: positions(found, longest)?,
        text_dim: found.dim("trans_base.cond_emb.weight", 1)?,
    })
}

/// Sizes of MMM's transformer.
pub fn of_mmm(found: &Found<'_>, longest: usize, heads: usize) -> Result<MmmConfig> {
    let width = found.dim("trans_head.blocks.0.attn.key.weight", 0)?;
    let layers = listed(found, "trans_head.blocks")?;
    Ok(MmmConfig {
        codes: found.dim("trans_head.head.weight", 0)?,
        dim: found.dim("trans_base.learn_tok_emb.weight", 1)?,
        network: TokenNetwork {
            width,
            layers,
            heads: divided(found, width, heads)?,
            feed_forward: multiple(found, "trans_head.blocks.0.mlp.0.weight", width)?,
            word_blocks: listed(found, "trans_base.cross_att")?.min(layers),
            ..TokenNetwork::default()
        },
        block: positions(found, longest)?,
        text_dim: found.dim("trans_base.cond_emb.weight", 1)?,
    })
}

/// Sizes of MDM's transformer.
pub fn of_mdm(found: &Found<'_>, heads: usize) -> Result<MdmConfig> {
    let TokenNetwork { width, layers, heads, feed_forward, .. } = blocks(found, "seqTransEncoder.layers", heads)?;
    if !width.is_multiple_of(2) {
        return Err(found.refuse(format!("its width is {width}; expected an even number")));
    }
    Ok(MdmConfig {
        features: found.dim("input_process.poseEmbedding.weight", 1)?,
        network: MdmNetwork { width, layers, heads, feed_forward, ..MdmNetwork::default() },
        text_dim: found.dim("embed_text.weight", 1)?,
    })
}

/// Sizes of DisCoRD's U-Net, of two levels as published; `attention` is its heads and their width, if it has any.
pub fn of_unet(found: &Found<'_>, attention: (usize, usize)) -> Result<UnetConfig> {
    let projection = "net.condition_projection";
    let features = found.dim("net.final_conv.weight", 0)?;
    let has = |name: &str| found.has(&format!("{projection}.{name}"));
    let dim = |name: &str, axis| found.dim(&format!("{projection}.{name}"), axis);
    let (kind, token_dim) = if has("3.weight") {
        (Projection::Stack, dim("3.weight", 1)?)
    } else if has("1.weight") {
        (Projection::Repeat, dim("1.weight", 1)?)
    } else if has("0.weight") {
        (Projection::Transposed, dim("0.weight", 0)?)
    } else {
        return Err(found
            .refuse(format!("the projection `{projection}` is not supported; expected stack, repeat or transposed")));
    };
    if found.has("net.time_mlp.0.weights") {
        return Err(found.refuse("its time embedding has learned frequencies; published networks have fixed ones"));
    }
    let blocks = (0..BLOCKS).take_while(|i| found.has(&format!("net.downs.0.{i}.mlp.1.weight"))).count();
    Ok(UnetConfig {
        features,
        width: found.dim("net.init_proj.weight", 0)?,
        multiples: vec![1, 2],
        token_dim,
        condition_dim: without(found, "net.init_proj.weight", 1, features)?,
        blocks,
        projection: kind,
        attention: found.has("net.mid_attn.fn.fn.to_qkv.weight").then_some(attention),
        time: TimeFeatures::Sinusoid,
        theta: 10_000.0,
        learned_variance: false,
    })
}
