//! `text.embed`: captions as vectors, once and for all stages, with the encoder that made them.

use std::collections::BTreeMap;

use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::TextEmbed;

use super::Plain;
use crate::artifacts::{self, Draft, EMBEDDINGS_FILE, EmbeddingsMeta, Tensors, to_meta};
use crate::context::{AttemptContext, Outcome, StageError};
use crate::text;

/// Captions embedded at once.
const BLOCK: usize = 64;

impl Plain for TextEmbed {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
        let captions = artifacts::captions(&*cx.blobs(), &manifest)?;
        let part = text::manifest(self.encoder);
        let digest = cx.put_manifest(&part)?;
        let encoder = text::open(&part, &*cx.blobs(), &cx.device())?;
        let (null, dim) = (encoder.pooled(&[""])?, encoder.dim());
        let mut rows = Vec::with_capacity(captions.len() * dim);
        for block in captions.chunks(BLOCK) {
            let texts: Vec<&str> = block.iter().map(|caption| caption.text.as_str()).collect();
            rows.extend(encoder.pooled(&texts)?);
        }
        let meta = EmbeddingsMeta { text: digest, dim, captions: captions.len() };
        let tensors = Tensors::default().with("captions", [captions.len(), dim], rows).with("null", [dim], null);
        let mut draft = Draft::new(cx, ArtifactKind::Embeddings, to_meta(&meta));
        draft.part(&Role::TEXT, &part);
        draft.add(EMBEDDINGS_FILE, tensors.to_bytes()?)?;
        let output = draft.finish(cx)?;
        let metrics = BTreeMap::from([("captions".to_owned(), captions.len() as f64)]);
        Ok(Outcome::Finished { output, metrics })
    }
}
