//! The part of a model that predicts the length of a caption's motion. Stage `train.length` trains it.

use burn::tensor::{Device, Tensor, TensorData};
use checkpoint::Blobs;
use checkpoint::model::Parts;
use models::device::host;
use models::kernels::Dropout;
use models::networks::{Init, LengthEstimator};
use motion::Stream;
use protocol::stage::DataFormat;
use protocol::{ArtifactKind, Manifest};
use serde::{Deserialize, Serialize};

use super::weights;
use crate::artifacts;
use crate::context::StageError;

/// Meta of an artifact of kind `length`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LengthMeta {
    /// Format of the training data.
    pub format: DataFormat,
    /// The text encoder of its training.
    pub fits: Parts,
    /// Width of a caption embedding.
    pub text_dim: usize,
    /// Number of classes; class c is a motion of `c * unit` frames.
    pub classes: usize,
    /// Frames per class.
    pub unit: usize,
}

/// A trained length estimator.
#[derive(Debug)]
pub struct Lengths {
    network: LengthEstimator,
    meta: LengthMeta,
    device: Device,
}

impl Lengths {
    /// Reads an artifact of kind `length`.
    pub fn read(blobs: &dyn Blobs, manifest: &Manifest, device: &Device) -> Result<Self, StageError> {
        artifacts::expect("the length estimator", manifest, ArtifactKind::Length)?;
        let meta: LengthMeta = artifacts::meta(manifest, "the length estimator")?;
        if meta.unit != LengthEstimator::UNIT {
            let found = meta.unit;
            let known = LengthEstimator::UNIT;
            return Err(StageError::Input(format!(
                "the length estimator has {found} frames per class; expected {known}"
            )));
        }
        let device = device.clone().inner();
        let mut blank = Init::blank(&device);
        let fresh = LengthEstimator::new(meta.text_dim, meta.classes, &mut blank);
        let network = weights::load(fresh, blobs, manifest, "the length estimator's weights")?;
        Ok(Self { network, meta, device })
    }

    /// Meta of the artifact.
    pub fn meta(&self) -> &LengthMeta {
        &self.meta
    }

    /// Draws a length in frames for a caption's vector, as MoMask does: a caption may describe a slow or a fast motion.
    pub fn draw(&self, pooled: &[f32], stream: &mut Stream) -> usize {
        let text = TensorData::new(pooled.to_vec(), [1, self.meta.text_dim]);
        let logits = self.network.forward(Tensor::from_data(text, &self.device), &mut Dropout::off());
        let logits = host(logits);
        LengthEstimator::sample(&logits, stream)
    }
}
