//! CLIP's text tower as an encoder.
//!
//! A caption's vector is the state of its end token, projected or not, never normalised; padding after it has no
//! effect. Its word vectors are the states of all positions after the last norm, including padding, as MMM and
//! StableMoFusion read them.

use std::sync::Arc;

use burn::tensor::Device;
use models::device::host;
use models::networks::{ClipText, ClipTextConfig, Init};
use protocol::stage::ClipOutput;
use text_models::Network;

use super::encoder::TextEncoder;
use super::published::{Captions, Published};
use super::remembered::Remembered;
use crate::context::StageError;

/// CLIP's text tower.
struct Clip {
    captions: Captions,
    tower: ClipText,
    width: usize,
    positions: usize,
    pooled: Arc<Remembered>,
    words: Arc<Remembered>,
}

impl std::fmt::Debug for Clip {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Clip").field("meta", &self.captions.meta).finish_non_exhaustive()
    }
}

/// Creates the network and loads its weights.
pub(super) fn open(published: Published, device: &Device) -> Result<Box<dyn TextEncoder>, StageError> {
    let Network::Clip(sizes) = &published.captions.meta.description.network else {
        return Err(StageError::Input(
            "the manifest of the text encoder `clip` describes another kind of network".into(),
        ));
    };
    let width = sizes.hidden_size;
    let positions = sizes.max_position_embeddings;
    let config: ClipTextConfig = published.sizes(sizes)?;
    let tower = published.filled(ClipText::new(&config, &mut Init::blank(device)), "")?;
    let (pooled, words) = published.captions.remembered(device);
    Ok(Box::new(Clip { captions: published.captions, tower, width, positions, pooled, words }))
}

impl TextEncoder for Clip {
    fn dim(&self) -> usize {
        self.captions.meta.dim
    }

    fn token_dim(&self) -> usize {
        self.width
    }

    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError> {
        let one = |caption: &&str| {
            self.pooled.of(caption, || {
                let states = self.tower.forward(&self.captions.ids(caption)?, 1, None);
                Ok(match self.captions.meta.output {
                    ClipOutput::Projected => host(states.projected_bc),
                    ClipOutput::Pooled => host(states.pooled_bh),
                })
            })
        };
        Ok(captions.iter().map(one).collect::<Result<Vec<_>, _>>()?.concat())
    }

    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError> {
        let one = |caption: &&str| {
            self.words.of(caption, || {
                let ids = self.captions.padded(caption, self.positions)?;
                Ok(host(self.tower.forward(&ids, 1, None).tokens_bth))
            })
        };
        captions.iter().map(one).collect()
    }
}
