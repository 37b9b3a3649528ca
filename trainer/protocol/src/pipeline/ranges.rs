//! The range of every numeric setting, by its path in the stage. No network, evaluation or schedule needs a larger
//! value.
//!
//! A limit is far above the papers' values and far below an overflow or the exhaustion of a machine's memory. Rules
//! that depend on other settings are in `rules`. The rules here need only the path, so one walk over the serialised
//! settings checks all of them, and a test can try each. The kinds share the table: a path has one meaning.

use serde_json::Value;

use crate::limits;
use crate::stage::{Problem, Problems};

/// Allowed numbers of a setting, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Range {
    /// Whole numbers in a range.
    Whole(u64, u64),
    /// Real numbers in a range.
    Real(f64, f64),
}

use Range::{Real, Whole};

/// Range and unit by path; entries of a list have the path of the list.
const RANGES: &[(&str, Range, &str)] = &[
    // Settings of data stages.
    ("clips", Whole(1, 100_000), "clips"),
    ("val", Real(0.0, 1.0), "of the clips"),
    ("test", Real(0.0, 1.0), "of the clips"),
    ("metres_per_unit", Real(0.0, 1000.0), "metres"),
    ("fps", Real(0.0, 10_000.0), "frames a second"),
    ("crops", Whole(1, 256), "crops of an entry"),
    ("shards", Whole(1, limits::SHARDS), "shards"),
    ("max_tokens", Whole(0, 4_096), "tokens"),
    // Sizes of networks.
    ("latent.tokens", Whole(1, limits::LATENT_TOKENS), "tokens"),
    ("latent.dim", Whole(1, 16_384), "numbers a token"),
    ("network.width", Whole(1, 16_384), "channels"),
    ("network.layers", Whole(1, 255), "layers"),
    ("network.heads", Whole(1, 1_024), "heads"),
    ("network.feed_forward", Whole(1, 65_536), "channels"),
    ("network.dropout", Real(0.0, 1.0), ""),
    ("network.movement", Whole(1, 4_096), "channels"),
    ("network.motion", Whole(1, 4_096), "channels"),
    ("network.text", Whole(1, 4_096), "channels"),
    ("network.embedding", Whole(1, 4_096), "channels"),
    ("network.multipliers", Whole(1, 64), ""),
    ("network.time", Whole(2, 16_384), "channels"),
    ("network.text_layers", Whole(1, 255), "layers"),
    ("network.text_heads", Whole(1, 1_024), "heads"),
    ("network.text_feed_forward", Whole(1, 65_536), "channels"),
    ("guidance_dim", Whole(4, 16_384), "channels"),
    ("network.depth", Whole(1, 16), "blocks"),
    ("network.word_blocks", Whole(0, 255), "blocks"),
    ("network.growth", Whole(1, 16), ""),
    ("heads", Whole(0, 1_024), "heads"),
    ("growth", Whole(1, 16), ""),
    ("network.condition", Whole(1, 16_384), "channels"),
    ("solver_steps", Whole(1, 1_000), "steps"),
    ("decoder_steps", Whole(0, 1_000), "steps"),
    ("intervals", Whole(1, 1_000), "intervals"),
    ("longest", Whole(1, 4_096), "tokens"),
    ("corruption", Real(0.0, 1.0), "of the tokens"),
    ("perturbed", Real(0.0, 1.0), "of the words"),
    ("codes", Whole(2, 65_536), "codes"),
    ("code_dim", Whole(1, 4_096), "numbers a code"),
    ("quantizers", Whole(1, 64), "codebooks"),
    ("padded", Whole(0, 10_000), "frames"),
    // Settings of training.
    ("steps", Whole(1, 1_000_000_000), "steps"),
    ("warmup", Whole(0, 1_000_000_000), "steps"),
    ("batch.global", Whole(1, 65_536), "examples"),
    ("batch.slices", Whole(1, 4_096), "slices"),
    ("lr", Real(0.0, 1e3), ""),
    ("discriminator_lr", Real(0.0, 1e3), ""),
    ("optimizer.beta1", Real(0.0, 1.0), ""),
    ("optimizer.beta2", Real(0.0, 1.0), ""),
    ("optimizer.eps", Real(0.0, 1.0), ""),
    ("optimizer.weight_decay", Real(0.0, 1e3), ""),
    ("discriminator_optimizer.beta1", Real(0.0, 1.0), ""),
    ("discriminator_optimizer.beta2", Real(0.0, 1.0), ""),
    ("discriminator_optimizer.eps", Real(0.0, 1.0), ""),
    ("discriminator_optimizer.weight_decay", Real(0.0, 1e3), ""),
    ("max_grad_norm", Real(0.0, 1e6), ""),
    ("ema", Real(0.0, 1.0), ""),
    ("ema_every", Whole(1, 1_000_000), "updates"),
    ("timesteps", Whole(2, 1_000), "timesteps"),
    ("max_frames", Whole(4, 10_000), "frames"),
    ("feature_bias", Real(1e-3, 1e3), ""),
    ("decoded", Real(0.0, 1.0), "of the batch"),
    ("losses.low_frequency.weight", Real(0.0, 1e6), ""),
    ("losses.low_frequency.keep", Whole(1, 10_000), "coefficients"),
    ("losses.low_frequency.from", Real(0.0, 1.0), "of the timesteps"),
    ("losses.low_frequency.to", Real(0.0, 1.0), "of the timesteps"),
    ("losses.semantic.weight", Real(0.0, 1e6), ""),
    ("losses.semantic.from", Real(0.0, 1.0), "of the timesteps"),
    ("losses.semantic.to", Real(0.0, 1.0), "of the timesteps"),
    ("losses.semantic.threshold", Real(-1.0, 1.0), ""),
    ("dropout", Real(0.0, 1.0), ""),
    ("guidance_dropout", Real(0.0, 1.0), "of the captions"),
    ("diffusion.beta_first", Real(0.0, 1.0), "of the variance"),
    ("diffusion.beta_last", Real(0.0, 1.0), "of the variance"),
    ("loss.feature", Real(0.0, 1e6), ""),
    ("loss.joint", Real(0.0, 1e6), ""),
    ("loss.velocity", Real(0.0, 1e6), ""),
    ("loss.feet", Real(0.0, 1e6), ""),
    ("loss.kl", Real(0.0, 1e6), ""),
    ("loss.position", Real(0.0, 1e6), ""),
    ("loss.commitment", Real(0.0, 1e6), ""),
    ("quantize_dropout", Real(0.0, 1.0), "of the steps"),
    ("window", Whole(4, 10_000), "frames"),
    ("loss.joint_from", Real(0.0, 1.0), "of the steps"),
    ("windows.min", Whole(1, 10_000), "frames"),
    ("windows.max", Whole(1, 10_000), "frames"),
    ("windows.until", Real(0.0, 1.0), "of the steps"),
    ("windows.batch", Whole(0, 65_536), "examples"),
    ("movement.until", Real(0.0, 1.0), "of the steps"),
    ("movement.window", Whole(1, 10_000), "frames"),
    ("movement.batch", Whole(0, 65_536), "examples"),
    ("movement.sparsity", Real(0.0, 1e6), ""),
    ("movement.smoothness", Real(0.0, 1e6), ""),
    ("emphasis", Real(0.0, 1e6), ""),
    ("margin", Real(0.0, 1e6), ""),
    // Settings of distillation.
    ("guidance", Real(0.0, 1e3), ""),
    ("skip", Whole(1, 1_000), "timesteps"),
    ("huber_c", Real(0.0, 1e6), ""),
    ("phases", Whole(1, 1_000), "phases"),
    ("adversarial", Real(0.0, 1e6), ""),
    // Settings of control.
    ("hints.density", Real(0.0, 100.0), "percent of the frames"),
    ("loss.latent", Real(0.0, 1e6), ""),
    ("loss.tokens", Real(0.0, 1e6), ""),
    ("loss.control", Real(0.0, 1e6), ""),
    ("embedding", Whole(1, 16_384), "channels"),
    ("trajectory_lr", Real(0.0, 1e3), ""),
    ("percent", Real(0.0, 100.0), "percent of the frames"),
    ("frames", Whole(1, 10_000), "frames"),
    ("bands", Real(1e-3, 1e3), "hertz"),
    ("motions", Whole(1, 10_000), "motions"),
    ("threshold", Real(0.0, 1e3), "metres"),
    ("scale", Real(0.0, 1e3), ""),
    // Settings of evaluation.
    ("sampler.steps", Whole(1, 1_000), "steps"),
    ("sampler.guidance", Real(0.0, 1e3), ""),
    ("sampler.timesteps", Whole(0, 999), ""),
    ("repeats", Whole(1, 100), "repeats"),
    ("samples", Whole(1, 100), "samples of an entry"),
    ("components", Whole(1, 4_096), "components"),
    ("pools", Whole(4, 4_096), "motions"),
    ("multimodality.captions", Whole(0, 1_000), "captions"),
    ("multimodality.samples", Whole(0, 1_000), "samples of a caption"),
    ("multimodality.pairs", Whole(0, 1_000), "pairs of a caption"),
    // Settings of placement.
    ("workers.min", Whole(1, 10_000), "workers"),
    ("workers.max", Whole(0, 10_000), "workers"),
    ("checkpoint.every", Whole(0, 1_000_000_000), "steps"),
    ("checkpoint.keep.latest", Whole(1, 10_000), "checkpoints"),
    ("checkpoint.keep.ended", Whole(0, 10_000), "checkpoints"),
    ("checkpoint.keep.best", Whole(0, 10_000), "checkpoints"),
];

/// Range of the setting at `path`, and its unit. A path that is not in the table, such as a new kind's, gets a range in
/// which nothing overflows; `number` decides between whole and real numbers.
pub(super) fn range(path: &str, number: &Value) -> (Range, &'static str) {
    let general = if number.is_f64() { Real(-1e9, 1e9) } else { Whole(0, 65_536) };
    let found = RANGES.iter().find(|(of, ..)| *of == path);
    found.map_or((general, ""), |(_, range, unit)| (*range, *unit))
}

impl Range {
    /// Returns true if `value`, a JSON number, is in the range.
    fn holds(self, value: &Value) -> bool {
        match self {
            Whole(from, to) => value.as_u64().is_some_and(|value| (from..=to).contains(&value)),
            Real(from, to) => value.as_f64().is_some_and(|value| (from..=to).contains(&value)),
        }
    }

    fn describe(self, unit: &str) -> String {
        let range = match self {
            Whole(from, to) => format!("{from} to {to}"),
            Real(from, to) => format!("a number from {from} to {to}"),
        };
        if unit.is_empty() { range } else { format!("{range} {unit}") }
    }
}

/// Reports values of `settings`, as JSON, that are out of range; skips fields that already have a problem in `p`.
pub(super) fn check(p: &mut Problems, settings: &Value) {
    let mut found = Problems::default();
    walk(&mut found, "", "", settings);
    let known = |problem: &Problem| p.0.iter().any(|other| other.field == problem.field);
    let new: Vec<Problem> = found.0.into_iter().filter(|problem| !known(problem)).collect();
    p.0.extend(new);
}

/// Walks over `value` at `field`, with indices; `path` is the same without them.
fn walk(p: &mut Problems, field: &str, path: &str, value: &Value) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                let below = |parent: &str| if parent.is_empty() { key.clone() } else { format!("{parent}.{key}") };
                walk(p, &below(field), &below(path), value);
            }
        }
        Value::Array(items) if items.len() > limits::LIST => {
            p.add(field, format!("`{path}` has {} entries; expected at most {}", items.len(), limits::LIST), "");
        }
        Value::Array(items) => {
            // A problem in a list of numbers is reported for the list, as by its other rules.
            let texts = items.iter().any(Value::is_string);
            for (i, item) in items.iter().enumerate() {
                let field = if texts { format!("{field}[{i}]") } else { field.to_owned() };
                walk(p, &field, path, item);
            }
        }
        Value::String(text) if text.len() > limits::TEXT_BYTES => {
            p.add(field, format!("`{path}` has {} bytes; expected at most {}", text.len(), limits::TEXT_BYTES), "");
        }
        Value::String(text) if text.contains(char::is_control) => {
            p.add(field, format!("`{path}` holds a control character, {}", text.escape_debug()), "write it without");
        }
        Value::Number(_) => {
            let (range, unit) = range(path, value);
            if !range.holds(value) {
                p.add(field, format!("`{path}` is {value}; expected {}", range.describe(unit)), "");
            }
        }
        Value::String(_) | Value::Bool(_) | Value::Null => {}
    }
}
