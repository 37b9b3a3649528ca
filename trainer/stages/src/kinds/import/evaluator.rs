//! `import.evaluator`: imports the published evaluators for HumanML3D and KIT-ML, or one in their layout.
//!
//! It reads `text_mot_match/model/finest.tar`, a torch pickle of three state dicts beside optimizer states.
//! Alternatively it reads `finest.safetensors` with the prefixes `text_encoder.`, `motion_encoder.` and
//! `movement_encoder.`. The statistics for normalising motions are `Comp_*/meta/{mean,std}.npy`. Sizes are derived from
//! the shapes. No code of a pickle is executed.
//!
//! The files are not trusted. Declared sizes are checked against the file before memory is allocated. An archive
//! unpacks to no more than its own length. The tensors of a pickle take no more than the file. The network that the
//! shapes describe has no more parameters than the file.

use std::collections::{BTreeMap, HashMap};

use models::flat::layout;
use models::names::from_bytes;
use models::networks::{Evaluator, EvaluatorConfig, Init};
use motion::{DataPath, Skeleton, npy};
use protocol::stage::ImportEvaluator;
use protocol::{Digest, excerpt, limits};
use pytorch_reader::{DType, PytorchReader};
use safetensors::SafeTensors;

use crate::artifacts::Tensors;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::external::{self, Given};
use crate::kinds::shape::Plain;
use crate::parts::evaluator::{self, EvaluatorMeta};
use crate::parts::word_vectors::{CLASSES, WORD_WIDTH, Words};
use crate::stand_in;

/// The state dicts of the pickle.
const PARTS: [&str; 3] = ["text_encoder", "motion_encoder", "movement_encoder"];

/// Upper limit of the number of tensors; the published evaluators have 49.
const MAX_TENSORS: usize = 1_000;
/// Upper limit of the header's bytes, with room for that many names.
const MAX_HEADER: u64 = 1 << 20;

impl Plain for ImportEvaluator {
    fn stand_in(&self, cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
        Some(stand_in::evaluator(cx, self.format))
    }

    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        external::read(cx, |cx, given| import(self, cx, given))
    }
}

fn import(settings: &ImportEvaluator, cx: &mut dyn AttemptContext, given: &Given) -> Result<Outcome, StageError> {
    let folder = given.path("path")?;
    let skeleton = Skeleton::of(settings.format);
    let (file, bytes) = weights(folder)?;
    let refuse = |text: String| StageError::Input(format!("{}: {text}", file.display()));
    let config = sizes(&bytes).map_err(refuse)?;
    let expected = skeleton.layout().contacts.start;
    if config.features != expected {
        return Err(refuse(format!(
            "its movements have {} features, but the format `{}` has {expected}; set `format` to the format that it \
             was trained on",
            config.features,
            settings.format.name()
        )));
    }
    if (config.word, config.classes) != (WORD_WIDTH, CLASSES) {
        let word = config.word;
        let classes = config.classes;
        return Err(refuse(format!(
            "it expects word vectors of width {word} and {classes} word classes; expected {WORD_WIDTH} and {CLASSES}"
        )));
    }
    check_parameters(&config, &bytes).map_err(refuse)?;
    let mean = statistic(folder, "mean.npy", skeleton)?;
    let std = statistic(folder, "std.npy", skeleton)?;
    if let Some(i) = std.iter().position(|s| !(*s > 0.0 && s.is_finite())) {
        return Err(StageError::Input(format!(
            "{}: std.npy: value {i} is {}; expected a number above 0",
            folder.display(),
            std[i]
        )));
    }
    let device = cx.device().inner();
    let blank = Evaluator::new(&config, &mut Init::blank(&device));
    let entries = layout(&blank);
    let flat = from_bytes(&entries, &bytes, "").map_err(|e| refuse(e.to_string()))?;
    if let Some(bad) = flat.iter().position(|v| !v.is_finite()) {
        return Err(refuse(format!("parameter {bad} of {} is not finite", flat.len())));
    }
    let words = Words::open(given.get("words"))?;
    if words == Words::Hashed {
        cx.log(
            "no `words` folder: captions use the built-in word vectors; published evaluators need the published \
             vectors",
        );
    }
    let meta =
        EvaluatorMeta { format: settings.format, config, mean, std, words: words.meta(), origin: "imported".into() };
    let output = evaluator::publish(cx, &meta, (&entries, &flat), &words)?;
    let metrics = BTreeMap::from([("parameters".to_owned(), flat.len() as f64)]);
    Ok(Outcome::Finished { output, metrics })
}

/// Reads the file of the weights, and returns its path and its tensors as safetensors.
fn weights(folder: &DataPath) -> Result<(DataPath, Vec<u8>), StageError> {
    let below = folder.join("text_mot_match/model");
    for base in [&below, folder] {
        let safe = base.join("finest.safetensors");
        if safe.has_entry() {
            let bytes = safe.read(limits::WEIGHTS_BYTES);
            let bytes = bytes.map_err(|e| StageError::Input(format!("{}: {e}", safe.display())))?;
            return Ok((safe, bytes));
        }
        let pickle = base.join("finest.tar");
        if pickle.has_entry() {
            let bytes = unpickle(&pickle).map_err(|e| StageError::Input(format!("{}: {e}", pickle.display())))?;
            return Ok((pickle, bytes));
        }
    }
    Err(StageError::Input(format!(
        "{}: no `finest.tar` or `finest.safetensors` here or in `text_mot_match/model`; set `path` to the folder of \
         one dataset in the published layout, such as `t2m/t2m`",
        folder.display()
    )))
}

/// Reads the three state dicts of a torch file.
fn unpickle(file: &DataPath) -> Result<Vec<u8>, String> {
    let length = text_models::archive_length(file)?;
    let held = file.hold().map_err(|e| e.to_string())?;
    let mut tensors = Vec::new();
    for part in PARTS {
        let reader = PytorchReader::with_top_level_key(held.path(), part).map_err(|e| {
            let said = text_models::no_torch(&e);
            format!("no state dict `{part}`: {said}; expected {}", PARTS.join(", "))
        })?;
        tensors.extend(reader.into_tensors().into_iter().map(|(name, tensor)| (format!("{part}.{name}"), tensor)));
    }
    if tensors.len() > MAX_TENSORS {
        return Err(format!("the file has {} tensors; expected at most {MAX_TENSORS}", tensors.len()));
    }
    // A tensor may repeat one number, and several may share one storage.
    let declared = tensors.iter().fold(0_u64, |sum, (_, tensor)| sum.saturating_add(tensor.byte_len() as u64));
    if declared > length {
        return Err(format!("its tensors declare {declared} bytes, but the file has {length}"));
    }
    let mut all = Tensors::default();
    for (name, tensor) in tensors {
        let bytes = tensor.read().map_err(|e| format!("`{}`: {}", excerpt(&name), text_models::no_torch(&e)))?;
        let values: Vec<f32> = match tensor.dtype() {
            DType::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            DType::F64 => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            other => return Err(format!("`{}` is {other:?}; expected F32", excerpt(&name))),
        };
        all = all.with(&name, tensor.shape().to_vec(), values);
    }
    all.to_bytes().map_err(|e| e.to_string())
}

/// Derives sizes from shapes.
fn sizes(bytes: &[u8]) -> Result<EvaluatorConfig, String> {
    let header = bytes.first_chunk::<8>().map_or(0, |length| u64::from_le_bytes(*length));
    if header > MAX_HEADER {
        return Err(format!("the header has {header} bytes; expected at most {MAX_HEADER}"));
    }
    let file = SafeTensors::deserialize(bytes).map_err(|e| format!("no safetensors: {}", excerpt(&e.to_string())))?;
    if file.len() > MAX_TENSORS {
        return Err(format!("the file has {} tensors; expected at most {MAX_TENSORS}", file.len()));
    }
    let shapes: HashMap<String, Vec<usize>> =
        file.iter().map(|(name, view)| (name.to_owned(), view.shape().to_vec())).collect();
    if let Some((name, shape)) = shapes.iter().find(|(_, shape)| shape.contains(&0)) {
        return Err(format!("`{}` has shape {shape:?}, which has no elements", excerpt(name)));
    }
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

/// Refuses shapes of a larger network than the file holds, before the network is created.
fn check_parameters(config: &EvaluatorConfig, bytes: &[u8]) -> Result<(), String> {
    let wide = |n: usize| n as u128;
    let linear = |from: u128, to: u128| (from + 1).saturating_mul(to);
    let encoder = |input: usize, width: usize| {
        let input = wide(input);
        let width = wide(width);
        let gru = linear(width, width).saturating_mul(12);
        linear(input, width) + gru + linear(2 * width, width) + linear(width, wide(config.embedding)) + 4 * width
    };
    let convolution = |from: usize, to: usize| linear(4 * wide(from), wide(to));
    let described = linear(wide(config.classes), wide(config.word))
        + encoder(config.word, config.text_hidden)
        + encoder(config.movement, config.motion_hidden)
        + convolution(config.features, config.movement_hidden)
        + convolution(config.movement_hidden, config.movement)
        + linear(wide(config.movement), wide(config.movement));
    let held = wide(bytes.len() / 4);
    if described > held {
        return Err(format!("its shapes need a network of {described} parameters, but the file holds at most {held}"));
    }
    Ok(())
}

/// Reads a statistic from `meta`, or from the `meta` of the only `Comp_*` folder.
fn statistic(folder: &DataPath, name: &str, skeleton: &Skeleton) -> Result<Vec<f32>, StageError> {
    let missing = |what: String| StageError::Input(format!("{}: {what}", folder.display()));
    let names = folder.names().map_err(|e| missing(e.to_string()))?;
    let found: Vec<DataPath> = names
        .into_iter()
        .filter(|entry| entry.to_string_lossy().starts_with("Comp_"))
        .map(|entry| folder.join(entry))
        .chain([folder.clone()])
        .map(|path| path.join("meta").join(name))
        .filter(DataPath::has_entry)
        .collect();
    let [file] = &found[..] else {
        return Err(missing(format!(
            "found {} files `Comp_*/meta/{name}`; expected one, with the statistics that the evaluator normalises \
             motions with",
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

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use models::flat;
    use models::names::to_bytes;
    use protocol::Seed;
    use protocol::stage::Positions;

    use super::*;

    fn config() -> EvaluatorConfig {
        EvaluatorConfig {
            features: 8,
            movement_hidden: 6,
            movement: 5,
            motion_hidden: 7,
            word: 9,
            classes: 3,
            text_hidden: 4,
            embedding: 10,
        }
    }

    /// Serialises a small evaluator as safetensors.
    fn small() -> Vec<u8> {
        let device = burn::tensor::Device::flex();
        let network = Evaluator::new(&config(), &mut Init::new(Seed(0), "small", Positions::Uniform, &device));
        to_bytes(&layout(&network), &flat::read(&network))
    }

    /// Serialises the tensors of `small`, some with other shapes.
    fn reshaped(change: &dyn Fn(&str, &mut Vec<usize>)) -> Vec<u8> {
        let bytes = small();
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let mut all = Tensors::default();
        for (name, view) in file.iter() {
            let mut shape = view.shape().to_vec();
            change(name, &mut shape);
            let values = vec![0.5; shape.iter().product()];
            all = all.with(name, shape, values);
        }
        all.to_bytes().unwrap()
    }

    #[test]
    fn the_parameters_that_shapes_describe_are_counted_exactly() {
        let bytes = small();
        let found = sizes(&bytes).unwrap();
        assert_eq!(found, config());
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let held: usize = file.iter().map(|(_, view)| view.data().len()).sum();
        check_parameters(&found, &vec![0; held]).unwrap();
        let said = check_parameters(&found, &vec![0; held - 4]).unwrap_err();
        assert!(said.contains(&format!("{} parameters", held / 4)), "{said}");
    }

    #[test]
    fn shapes_that_ask_for_more_than_the_file_are_refused_before_anything_is_made() {
        // An axis of zero has no elements, so the other axes cost nothing.
        let empty = reshaped(&|name, shape| {
            if name.ends_with("hidden") {
                *shape = vec![2, 0, 1 << 40];
            }
        });
        assert!(sizes(&empty).unwrap_err().contains("which has no elements"));
        // The initial states are one row; the matrices after them are its square.
        let wide = reshaped(&|name, shape| {
            if name == "motion_encoder.hidden" {
                shape[2] = 1 << 20;
            }
        });
        let config = sizes(&wide).unwrap();
        assert_eq!(config.motion_hidden, 1 << 20);
        let said = check_parameters(&config, &wide).unwrap_err();
        assert!(said.contains("need a network of"), "{said}");
        let mut long = small();
        long[..8].copy_from_slice(&(90_u64 << 20).to_le_bytes());
        assert!(sizes(&long).unwrap_err().contains("the header has 94371840 bytes"));
    }

    #[test]
    fn an_archive_that_unpacks_to_more_than_it_is_is_not_unpacked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("finest.tar");
        let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        let packed = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        for name in ["archive/data.pkl", "archive/data/0"] {
            archive.start_file(name, packed).unwrap();
            archive.write_all(&vec![0; 8 << 20]).unwrap();
        }
        archive.finish().unwrap();
        let said = unpickle(&DataPath::local(&path)).unwrap_err();
        assert!(said.contains("unpacks to 16777216 bytes"), "{said}");
        std::fs::remove_file(&path).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        assert!(unpickle(&DataPath::local(&path)).unwrap_err().contains("is a named pipe"));
        let said = weights(&DataPath::local(folder.path())).unwrap_err().to_string();
        assert!(said.contains("finest.tar: is a named pipe; expected a file"), "{said}");
    }

    /// Overwritten, cut and doubled bytes must not cause a panic; any result is allowed.
    #[test]
    fn no_bytes_break_the_importer() {
        let mut state = 0x9e37_79b9_7f4a_7c15_u64;
        let mut next = move |bound: usize| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state % bound.max(1) as u64) as usize
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("finest.tar");
        let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
        let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        for (name, bytes) in
            [("archive/data.pkl", &b"\x80\x02}q\x00X\x0c\x00\x00\x00text_encoder}s."[..]), ("archive/data/0", &[0; 64])]
        {
            archive.start_file(name, stored).unwrap();
            archive.write_all(bytes).unwrap();
        }
        let archive = archive.finish().unwrap().into_inner();
        let weights = small();
        for round in 0..600 {
            let mut bytes = if round % 2 == 0 { archive.clone() } else { weights.clone() };
            // The important bytes are headers at either end of a file; half of the safetensors rounds change only the
            // first 4,000.
            let head = if round % 4 == 1 { 4_000 } else { bytes.len() };
            for _ in 0..=next(4) {
                let at = next(head.min(bytes.len()));
                match next(4) {
                    0 => bytes.truncate(at),
                    1 => bytes.splice(at..at, [b'9'; 3]).for_each(drop),
                    _ if !bytes.is_empty() => {
                        let at = at.min(bytes.len() - 1);
                        bytes[at] = [0, 0xff, b'9', b'0', b'"', 0x7f][next(6)];
                    }
                    _ => {}
                }
            }
            if round % 2 == 0 {
                std::fs::write(&path, &bytes).unwrap();
                let _ = unpickle(&DataPath::local(&path));
            } else if let Ok(config) = sizes(&bytes) {
                let _ = check_parameters(&config, &bytes);
            }
        }
    }
}
