//! `import.evaluator`: the published evaluators, for HumanML3D and KIT-ML, or one in their layout.
//!
//! Read are `text_mot_match/model/finest.tar`, a torch pickle of three state dicts beside optimizer states, or `finest.safetensors` in its
//! place with `text_encoder.`, `motion_encoder.` and `movement_encoder.` before the names; and `Comp_*/meta/{mean,std}.npy`, the statistics that its
//! motions are normalised with. Sizes are read off the shapes. Nothing in a pickle is run.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use models::flat::layout;
use models::names::{from_bytes, to_bytes};
use models::networks::{Evaluator, EvaluatorConfig, Init};
use motion::{Skeleton, npy};
use protocol::Seed;
use protocol::stage::{ImportEvaluator, Positions};
use pytorch_reader::{DType, PytorchReader};
use safetensors::SafeTensors;

use super::Plain;
use crate::artifacts::Tensors;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluator::{self, EvaluatorMeta};
use crate::words::{CLASSES, WORD_WIDTH, Words};

/// The state dicts of the pickle.
const PARTS: [&str; 3] = ["text_encoder", "motion_encoder", "movement_encoder"];

impl Plain for ImportEvaluator {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let folder = Path::new(&self.path);
        let skeleton = Skeleton::of(self.format);
        let (file, bytes) = weights(folder)?;
        let refuse = |text: String| StageError::Input(format!("{}: {text}", file.display()));
        let config = sizes(&bytes).map_err(refuse)?;
        let expected = skeleton.layout().contacts.start;
        if config.features != expected {
            return Err(refuse(format!(
                "its movements are made of {} features, those of {:?} of {expected}; set `format` to what it was trained on",
                config.features, self.format
            )));
        }
        if (config.word, config.classes) != (WORD_WIDTH, CLASSES) {
            let (word, classes) = (config.word, config.classes);
            return Err(refuse(format!(
                "it reads words of width {word} in {classes} classes, expected {WORD_WIDTH} in {CLASSES}"
            )));
        }
        let (mean, std) = (statistic(folder, "mean.npy", skeleton)?, statistic(folder, "std.npy", skeleton)?);
        if let Some(i) = std.iter().position(|s| !(*s > 0.0 && s.is_finite())) {
            return Err(StageError::Input(format!(
                "{}: std.npy: value {i} is {}, expected above 0",
                folder.display(),
                std[i]
            )));
        }
        let device = cx.device().inner();
        let blank = Evaluator::new(&config, &mut Init::new(Seed(0), "blank", Positions::Uniform, &device));
        let entries = layout(&blank);
        let flat = from_bytes(&entries, &bytes, "").map_err(|e| refuse(e.to_string()))?;
        if let Some(bad) = flat.iter().position(|v| !v.is_finite()) {
            return Err(refuse(format!("parameter {bad} of {} is not finite", flat.len())));
        }
        let words = Words::open(&self.words)?;
        if words == Words::Hashed {
            cx.log("no `words` folder: captions are read through the built-in word vectors; the published evaluators need the published ones");
        }
        let meta =
            EvaluatorMeta { format: self.format, config, mean, std, words: words.meta(), origin: "imported".into() };
        let output = evaluator::publish(cx, &meta, to_bytes(&entries, &flat), &words)?;
        let metrics = BTreeMap::from([("parameters".to_owned(), flat.len() as f64)]);
        Ok(Outcome::Finished { output, metrics })
    }
}

/// The file of the weights, and its tensors as safetensors.
fn weights(folder: &Path) -> Result<(PathBuf, Vec<u8>), StageError> {
    let below = folder.join("text_mot_match/model");
    for base in [&below, folder] {
        let safe = base.join("finest.safetensors");
        if safe.is_file() {
            let bytes = std::fs::read(&safe).map_err(|e| StageError::Input(format!("{}: {e}", safe.display())))?;
            return Ok((safe, bytes));
        }
        let pickle = base.join("finest.tar");
        if pickle.is_file() {
            let bytes = unpickle(&pickle).map_err(|e| StageError::Input(format!("{}: {e}", pickle.display())))?;
            return Ok((pickle, bytes));
        }
    }
    Err(StageError::Input(format!(
        "{}: no `finest.tar` or `finest.safetensors` here or in `text_mot_match/model`; `path` is the folder of one dataset in the \
         published layout, such as `t2m/t2m`",
        folder.display()
    )))
}

/// The three state dicts of a torch file.
fn unpickle(file: &Path) -> Result<Vec<u8>, String> {
    let mut all = Tensors::default();
    for part in PARTS {
        let reader = PytorchReader::with_top_level_key(file, part)
            .map_err(|e| format!("no state dict `{part}`: {e}; expected {}", PARTS.join(", ")))?;
        for (name, tensor) in reader.into_tensors() {
            let bytes = tensor.read().map_err(|e| format!("`{part}.{name}`: {e}"))?;
            let values: Vec<f32> = match tensor.dtype() {
                DType::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
                DType::F64 => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
                other => return Err(format!("`{part}.{name}` is {other:?}, expected F32")),
            };
            all = all.with(&format!("{part}.{name}"), tensor.shape().to_vec(), values);
        }
    }
    all.to_bytes().map_err(|e| e.to_string())
}

/// Sizes out of shapes.
fn sizes(bytes: &[u8]) -> Result<EvaluatorConfig, String> {
    let file = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
    let shapes: HashMap<String, Vec<usize>> =
        file.iter().map(|(name, view)| (name.to_owned(), view.shape().to_vec())).collect();
    let dim = |name: &str, axis: usize| {
        let found = shapes.get(name).and_then(|shape| shape.get(axis)).copied();
        found.ok_or_else(|| format!("no tensor `{name}` with {} axes", axis + 1))
    };
    Ok(EvaluatorConfig {
        features: dim("movement_encoder.main.0.weight", 1)?,
        movement_hidden: dim("movement_encoder.main.0.weight", 0)?,
        movement: dim("movement_encoder.main.3.weight", 0)?,
        motion_hidden: dim("motion_encoder.hidden", 2)?,
        word: dim("text_encoder.pos_emb.weight", 0)?,
        classes: dim("text_encoder.pos_emb.weight", 1)?,
        text_hidden: dim("text_encoder.hidden", 2)?,
        embedding: dim("text_encoder.output_net.3.weight", 0)?,
    })
}

/// A statistic in `meta`, or in the `meta` of the one `Comp_*` folder.
fn statistic(folder: &Path, name: &str, skeleton: &Skeleton) -> Result<Vec<f32>, StageError> {
    let missing = |what: String| StageError::Input(format!("{}: {what}", folder.display()));
    let entries = std::fs::read_dir(folder).map_err(|e| missing(e.to_string()))?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.file_name().is_some_and(|n| n.to_string_lossy().starts_with("Comp_")))
        .chain([folder.to_owned()])
        .map(|path| path.join("meta").join(name))
        .filter(|path| path.is_file())
        .collect();
    found.sort();
    let [file] = &found[..] else {
        return Err(missing(format!(
            "{} files `Comp_*/meta/{name}`, expected one: the statistics that the evaluator normalises motions with",
            found.len()
        )));
    };
    let array = npy::read_any_float(file).map_err(|e| StageError::Input(e.to_string()))?;
    if array.shape != [skeleton.features] {
        return Err(StageError::Input(format!(
            "{}: shape {:?}, expected [{}]",
            file.display(),
            array.shape,
            skeleton.features
        )));
    }
    Ok(array.data)
}
