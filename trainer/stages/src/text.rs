//! Text encoders: how captions become what a generator is conditioned on.
//!
//! An encoder is an artifact of kind `text-encoder`. Caption embeddings hold the one that made them as their part `text`, a model that was
//! trained on them holds it too, and so a model is always drawn with the encoder that it was trained with. To add one: an implementation
//! of [`TextEncoder`], a line in the table of [`open`], and its word in [`protocol::stage::TextEncoder`].

use burn::tensor::Device;
use checkpoint::Blobs;
use motion::text::{hashed_embedding, hashed_tokens};
use protocol::stage::TextEncoder as Choice;
use protocol::{ArtifactKind, Manifest};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::artifacts;
use crate::context::StageError;

/// Meta of an artifact of kind `text-encoder`, as far as all encoders share it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TextEncoderMeta {
    /// Which one: a name in the table of [`open`].
    pub encoder: String,
    /// Width of its vectors.
    pub dim: usize,
}

/// Turns captions into vectors.
pub trait TextEncoder: std::fmt::Debug {
    /// Width of its vectors.
    fn dim(&self) -> usize;

    /// A vector for each caption, `[captions, dim]`. That of the empty one is the null condition of classifier-free guidance.
    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError>;

    /// A vector for each token of each caption, `[tokens, dim]` a caption; at least one.
    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError>;
}

/// Words and word pairs hashed to signed coordinates; has no weights.
#[derive(Debug, Clone, Copy)]
struct Hashed;

impl TextEncoder for Hashed {
    fn dim(&self) -> usize {
        motion::text::EMBEDDING_WIDTH
    }

    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError> {
        Ok(captions.iter().flat_map(|caption| hashed_embedding(caption)).collect())
    }

    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError> {
        Ok(captions.iter().map(|caption| hashed_tokens(caption).concat()).collect())
    }
}

/// Opens an encoder of a manifest.
type Open = fn(&Manifest, &dyn Blobs, &Device) -> Result<Box<dyn TextEncoder>, StageError>;

/// Every encoder by its name in manifests.
const ENCODERS: [(&str, Open); 1] = [("hashed", |_, _, _| Ok(Box::new(Hashed)))];

/// The encoder of an artifact of kind `text-encoder`.
pub fn open(manifest: &Manifest, blobs: &dyn Blobs, device: &Device) -> Result<Box<dyn TextEncoder>, StageError> {
    artifacts::expect("the text encoder", manifest, ArtifactKind::TextEncoder)?;
    let meta: TextEncoderMeta = artifacts::meta(manifest, "the text encoder")?;
    let Some((_, open)) = ENCODERS.iter().find(|(name, _)| *name == meta.encoder) else {
        let have: Vec<&str> = ENCODERS.iter().map(|(name, _)| *name).collect();
        let wanted = meta.encoder;
        return Err(StageError::Input(format!(
            "text encoder `{wanted}` is not in this build, which has {}",
            have.join(", ")
        )));
    };
    let encoder = open(manifest, blobs, device)?;
    if encoder.dim() != meta.dim {
        let (found, said) = (encoder.dim(), meta.dim);
        return Err(StageError::Input(format!("text encoder `{}` gives {found} numbers, not {said}", meta.encoder)));
    }
    Ok(encoder)
}

/// The manifest of the encoder that settings name.
pub fn manifest(choice: Choice) -> Manifest {
    match choice {
        Choice::Hashed => {
            let meta = json!({"encoder": choice.name(), "dim": Hashed.dim()});
            Manifest::new(ArtifactKind::TextEncoder, meta)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::MemoryBlobs;

    #[test]
    fn an_encoder_is_opened_by_its_manifest_alone() {
        let blobs = MemoryBlobs::default();
        let open = |manifest: &Manifest| super::open(manifest, &blobs, &Device::flex());
        let encoder = open(&manifest(Choice::Hashed)).expect("built in");
        let captions = ["a man walks", ""];
        let pooled = encoder.pooled(&captions).expect("built in");
        assert_eq!(pooled.len(), 2 * encoder.dim());
        let tokens = encoder.tokens(&captions).expect("built in");
        assert_eq!(
            tokens.iter().map(|rows| rows.len() / encoder.dim()).collect::<Vec<_>>(),
            [4, 1],
            "words and the end"
        );
        assert_eq!(tokens[1], pooled[encoder.dim()..], "an empty caption is its end alone");
        assert_ne!(tokens[0], encoder.tokens(&["a walks man"]).expect("built in")[0], "in order");

        let other = Manifest::new(ArtifactKind::TextEncoder, json!({"encoder": "clip", "dim": 512}));
        let refused = open(&other).expect_err("not in this build").to_string();
        assert!(refused.contains("`clip`") && refused.contains("hashed"), "{refused}");
        let refused = open(&Manifest::new(ArtifactKind::Vae, json!({}))).expect_err("a VAE").to_string();
        assert!(refused.contains("Vae"), "{refused}");
    }
}
