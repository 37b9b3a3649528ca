//! Placeholders for the outputs of stages in an estimate: clips and an untrained evaluator, noise of the right shape.

use models::flat;
use models::networks::{Evaluator, Init};
use motion::dataset::{Caption, Clip, Dataset, Entry, PackError, Split};
use motion::{Skeleton, Stream};
use protocol::stage::{DataFormat, EvaluatorNetwork, Positions};
use protocol::{ArtifactKind, Digest};

use crate::artifacts::{DatasetMeta, Draft, to_meta};
use crate::context::{AttemptContext, StageError};
use crate::parts::evaluator::{self, EvaluatorMeta};
use crate::parts::word_vectors::Words;

/// Frames of each clip: 142 on average, as in HumanML3D.
const FRAMES: [usize; 6] = [196, 160, 144, 144, 120, 88];
/// Number of clips.
pub(crate) const CLIPS: usize = FRAMES.len();

/// Makes clips of noise; the last two are not for training.
pub(crate) fn dataset(cx: &mut dyn AttemptContext, format: DataFormat) -> Result<Digest, StageError> {
    let width = Skeleton::of(format).features;
    let clip = |(i, frames): (usize, &usize)| {
        let mut noise = Stream::new(cx.task().seed, "estimate/clip", i as u64, 0);
        let features: Vec<f32> = (0..frames * width).map(|_| noise.normal()).collect();
        Clip { id: format!("{i}"), frames: *frames, features: features.into() }
    };
    let words = "a person walks forward and then turns around to the left";
    let caption = || Caption::whole(words, words.split(' ').map(|word| format!("{word}/NOUN")).collect());
    let entry = |(i, frames): (usize, &usize)| {
        let split = [Split::Train, Split::Val, Split::Test][i.saturating_sub(CLIPS - 3)];
        Entry { id: format!("{i}"), clip: i, start: 0, len: *frames, captions: vec![i], split }
    };
    let dataset = Dataset {
        format,
        mean: vec![0.0; width],
        std: vec![1.0; width],
        clips: FRAMES.iter().enumerate().map(clip).collect(),
        captions: FRAMES.iter().map(|_| caption()).collect(),
        entries: FRAMES.iter().enumerate().map(entry).collect(),
    };
    let meta =
        DatasetMeta { format, clips: CLIPS, captions: CLIPS, entries: CLIPS, frames: FRAMES.iter().sum(), skipped: 0 };
    let mut draft = Draft::new(cx, ArtifactKind::Dataset, to_meta(&meta));
    dataset.write_files::<Failure>(|name, bytes| draft.add(&name, bytes).map_err(Failure))?;
    draft.finish(cx)
}

/// An untrained evaluator of the published size.
pub(crate) fn evaluator(cx: &mut dyn AttemptContext, format: DataFormat) -> Result<Digest, StageError> {
    let skeleton = Skeleton::of(format);
    let words = Words::Hashed;
    let meta = EvaluatorMeta {
        format,
        config: evaluator::config(&EvaluatorNetwork::default(), skeleton),
        mean: vec![0.0; skeleton.features],
        std: vec![1.0; skeleton.features],
        words: words.meta(),
        origin: "untrained".into(),
    };
    let device = cx.device();
    let network = Evaluator::new(&meta.config, &mut Init::new(cx.task().seed, "estimate", Positions::Uniform, &device));
    let entries = flat::layout(&network);
    let values = flat::read(&network);
    evaluator::publish(cx, &meta, (&entries[..], &values[..]), &words)
}

/// An error that prevented a file from being kept.
struct Failure(StageError);

impl From<PackError> for Failure {
    fn from(error: PackError) -> Self {
        Self(StageError::Fault(error.to_string()))
    }
}

impl From<Failure> for StageError {
    fn from(Failure(error): Failure) -> Self {
        error
    }
}
