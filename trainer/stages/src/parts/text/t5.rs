//! T5's encoder and Sentence-T5 as encoders.
//!
//! A caption's word vectors are the states of its tokens, including its end. Its vector is their mean; for Sentence-T5
//! this passes the dense layer and is divided by its length. A caption is computed alone, without padding.

use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use models::device::host;
use models::networks::{Init, Linear, T5Config, T5Encoder, mean_of_tokens, normalised};
use text_models::{DENSE, Network};

use super::encoder::TextEncoder;
use super::published::{Captions, Published};
use super::remembered::Remembered;
use crate::context::StageError;

/// T5's encoder with an optional dense layer.
struct T5 {
    captions: Captions,
    network: T5Encoder,
    dense: Option<Linear>,
    normalise: bool,
    width: usize,
    pooled: Arc<Remembered>,
    words: Arc<Remembered>,
}

impl std::fmt::Debug for T5 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("T5").field("meta", &self.captions.meta).finish_non_exhaustive()
    }
}

/// Creates the network and loads its weights.
pub(super) fn open(published: Published, device: &Device) -> Result<Box<dyn TextEncoder>, StageError> {
    let (Network::T5(sizes), head) =
        (&published.captions.meta.description.network, published.captions.meta.description.head.clone())
    else {
        let name = &published.captions.meta.encoder;
        return Err(StageError::Input(format!(
            "the manifest of the text encoder `{name}` describes another kind of network"
        )));
    };
    let width = sizes.d_model;
    let config: T5Config = published.sizes(sizes)?;
    let network = published.filled(T5Encoder::new(&config, &mut Init::blank(device)), "")?;
    let dense = match head.as_ref().filter(|head| head.dense) {
        None => None,
        Some(head) => {
            let init = Init::blank(device);
            let mut blank = Linear::zero(&init, width, head.width);
            if head.bias {
                blank.bias = Some(init.constant(0.0, [head.width]));
            }
            Some(published.filled(blank, &format!("{DENSE}linear."))?)
        }
    };
    let normalise = head.is_some_and(|head| head.normalise);
    let (pooled, words) = published.captions.remembered(device);
    Ok(Box::new(T5 { captions: published.captions, network, dense, normalise, width, pooled, words }))
}

impl T5 {
    /// States [1, T, H] of a caption's tokens, and their number T.
    fn states(&self, caption: &str) -> Result<(Tensor<3>, usize), StageError> {
        let ids = self.captions.ids(caption)?;
        Ok((self.network.forward(&ids, &[ids.len()]), ids.len()))
    }
}

impl TextEncoder for T5 {
    fn dim(&self) -> usize {
        self.captions.meta.dim
    }

    fn token_dim(&self) -> usize {
        self.width
    }

    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError> {
        let one = |caption: &&str| {
            self.pooled.of(caption, || {
                let (states, length) = self.states(caption)?;
                let mut vector = mean_of_tokens(states, &[length]);
                if let Some(dense) = &self.dense {
                    vector = dense.forward(vector);
                }
                Ok(host(if self.normalise { normalised(vector) } else { vector }))
            })
        };
        Ok(captions.iter().map(one).collect::<Result<Vec<_>, _>>()?.concat())
    }

    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError> {
        let one = |caption: &&str| self.words.of(caption, || Ok(host(self.states(caption)?.0)));
        captions.iter().map(one).collect()
    }
}
