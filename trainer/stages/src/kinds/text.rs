//! `text.embed`: captions as vectors, once and for all stages.

use std::collections::BTreeMap;

use motion::text::hashed_embedding;
use protocol::ArtifactKind;
use protocol::stage::{TextEmbed, TextEncoder};

use super::Plain;
use crate::artifacts::{self, EMBEDDINGS_FILE, EmbeddingsMeta, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};

/// The encoder's name in metas.
pub fn encoder_name(encoder: TextEncoder) -> &'static str {
    match encoder {
        TextEncoder::Hashed => "hashed",
    }
}

/// The embedding of `caption` by the encoder called `name` in a meta.
pub fn embed(name: &str, caption: &str) -> Result<Vec<f32>, StageError> {
    match name {
        "hashed" => Ok(hashed_embedding(caption).to_vec()),
        other => Err(StageError::Input(format!("text encoder `{other}` is not in this build, which has `hashed`"))),
    }
}

impl Plain for TextEmbed {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let captions = artifacts::captions(&*cx.blobs(), &manifest)?;
        let encoder = encoder_name(self.encoder);
        let null = embed(encoder, "")?;
        let dim = null.len();
        let mut rows = Vec::with_capacity(captions.len() * dim);
        for caption in &captions {
            rows.extend(embed(encoder, &caption.text)?);
        }
        let meta = EmbeddingsMeta { encoder: encoder.to_owned(), dim, captions: captions.len() };
        let tensors = Tensors::default().with("captions", [captions.len(), dim], rows).with("null", [dim], null);
        let output =
            artifacts::publish(cx, ArtifactKind::Embeddings, to_meta(&meta), EMBEDDINGS_FILE, tensors.to_bytes()?)?;
        let metrics = BTreeMap::from([("captions".to_owned(), captions.len() as f64)]);
        Ok(Outcome::Finished { output, metrics })
    }
}
