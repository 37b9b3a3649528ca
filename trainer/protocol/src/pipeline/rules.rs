//! What settings must satisfy beyond their types: ranges, divisibility, shapes that belong together.
//!
//! One stage at a time; what concerns several stages is in `graph`.

use crate::id::is_name;
use crate::stage::{
    Batch, Distance, Distillation, Keep, LatentShape, MultiModality, Network, Optimizer, Placement, Register, Sampler,
    StageSettings, Training,
};

/// A rule that does not hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Problem {
    /// The field, as a path inside the stage; empty for the stage itself.
    pub(super) field: String,
    /// What is wrong and what was expected.
    pub(super) message: String,
    /// What to do.
    pub(super) help: Option<String>,
}

/// Collects problems of one stage.
#[derive(Debug, Default)]
pub(super) struct Problems(pub(super) Vec<Problem>);

impl Problems {
    pub(super) fn add(&mut self, field: &str, message: impl Into<String>, help: &str) {
        let help = (!help.is_empty()).then(|| help.to_owned());
        self.0.push(Problem { field: field.to_owned(), message: message.into(), help });
    }

    fn positive(&mut self, field: &str, value: usize) {
        if value == 0 {
            self.add(field, format!("`{field}` is 0; expected at least 1"), "");
        }
    }

    fn above_zero(&mut self, field: &str, value: f64) {
        if !(value > 0.0 && value.is_finite()) {
            self.add(field, format!("`{field}` is {value}; expected a number above 0"), "");
        }
    }

    fn not_negative(&mut self, field: &str, value: f64) {
        if !(value >= 0.0 && value.is_finite()) {
            self.add(field, format!("`{field}` is {value}; expected 0 or more"), "");
        }
    }

    /// 0 <= value <= 1, or < 1 when `open`.
    fn fraction(&mut self, field: &str, value: f64, open: bool) {
        let fits = value >= 0.0 && if open { value < 1.0 } else { value <= 1.0 };
        if !fits {
            let range = if open { "at least 0 and below 1" } else { "between 0 and 1" };
            self.add(field, format!("`{field}` is {value}; expected {range}"), "");
        }
    }
}

/// Everything that can be said of one stage alone.
pub(super) fn stage(settings: &StageSettings, placement: &Placement) -> Vec<Problem> {
    let mut problems = Problems::default();
    let p = &mut problems;
    match settings {
        StageSettings::DataOpen(s) => {
            if s.path.trim().is_empty() {
                p.add("path", "`path` is missing: the folder with `new_joint_vecs`, `texts` and `train.txt`", "");
            }
        }
        StageSettings::DataSynthetic(s) => {
            p.positive("clips", s.clips);
            if s.clips > 1_000_000 {
                p.add("clips", format!("`clips` is {}; expected at most 1000000", s.clips), "");
            }
            p.fraction("val", s.val, true);
            p.fraction("test", s.test, true);
            if (0.0..1.0).contains(&s.val) && (0.0..1.0).contains(&s.test) && s.val + s.test >= 1.0 {
                p.add("test", "`val` and `test` leave no clips to train on; expected a sum below 1", "");
            }
        }
        StageSettings::TextEmbed(_) => {}
        StageSettings::TrainVae(s) => {
            latent(p, s.latent);
            network(p, &s.network);
            for (field, weight) in [
                ("loss.feature", s.loss.feature),
                ("loss.joint", s.loss.joint),
                ("loss.velocity", s.loss.velocity),
                ("loss.kl", s.loss.kl),
            ] {
                p.not_negative(field, weight);
            }
            if s.loss.feature == 0.0 && s.loss.joint == 0.0 {
                p.add("loss.feature", "`loss.feature` and `loss.joint` are both 0, so nothing is reconstructed", "");
            }
            p.fraction("loss.joint_from", s.loss.joint_from, false);
            p.fraction("windows.until", s.windows.until, false);
            if s.windows.until > 0.0 {
                if s.windows.min < 4 {
                    p.add("windows.min", format!("`windows.min` is {}; expected at least 4 frames", s.windows.min), "");
                }
                if s.windows.min > s.windows.max {
                    let (min, max) = (s.windows.min, s.windows.max);
                    p.add("windows.max", format!("`windows.max` is {max}, below `windows.min`, {min}"), "");
                }
                if s.windows.batch != 0 {
                    divides(p, "windows.batch", Batch { global: s.windows.batch, slices: s.training.batch.slices });
                }
            }
            p.fraction("ema", s.ema, true);
            training(p, &s.training);
        }
        StageSettings::EncodeLatents(s) => {
            p.positive("crops", s.crops);
            shards(p, s.shards);
        }
        StageSettings::TrainMld(s) => {
            network(p, &s.network);
            p.fraction("guidance_dropout", s.guidance_dropout, false);
            p.fraction("ema", s.ema, true);
            training(p, &s.training);
        }
        StageSettings::DistillLcm(s) => distillation(p, &s.distillation),
        StageSettings::DistillPcm(s) => {
            distillation(p, &s.distillation);
            p.positive("phases", s.phases);
            if let Some(grid) = grid(&s.distillation)
                && s.phases > grid
            {
                let message = format!(
                    "`phases` is {}, but the grid of `skip` {} has only {grid} points",
                    s.phases, s.distillation.skip
                );
                p.add("phases", message, "take fewer phases or a smaller `skip`");
            }
            p.not_negative("adversarial", s.adversarial);
            p.not_negative("discriminator_lr", s.discriminator_lr);
            optimizer(p, "discriminator_optimizer", &s.discriminator_optimizer);
        }
        StageSettings::EvaluateReconstruction(s) => shards(p, s.shards),
        StageSettings::EvaluateLatentFid(s) => {
            sampler(p, &s.sampler);
            p.positive("repeats", s.repeats);
            p.positive("samples", s.samples);
            p.positive("components", s.components);
            shards(p, s.shards);
        }
        StageSettings::TrainEvaluator(s) => {
            for (field, value) in [
                ("network.movement", s.network.movement),
                ("network.motion", s.network.motion),
                ("network.text", s.network.text),
                ("network.embedding", s.network.embedding),
            ] {
                p.positive(field, value);
            }
            p.fraction("network.dropout", s.network.dropout, true);
            p.fraction("movement.until", s.movement.until, true);
            if s.movement.until == 0.0 {
                p.add("movement.until", "`movement.until` is 0; movements must be trained before they are matched", "");
            }
            if s.movement.window < 8 {
                let message = format!("`movement.window` is {}; expected at least 8 frames", s.movement.window);
                p.add("movement.window", message, "two movements of four frames, so that they have a difference");
            }
            if s.movement.batch != 0 {
                divides(p, "movement.batch", Batch { global: s.movement.batch, slices: s.training.batch.slices });
            }
            p.not_negative("movement.sparsity", s.movement.sparsity);
            p.not_negative("movement.smoothness", s.movement.smoothness);
            p.above_zero("emphasis", s.emphasis);
            p.above_zero("margin", s.margin);
            p.fraction("ema", s.ema, true);
            training(p, &s.training);
            let batch = s.training.batch;
            if batch.slices > 0 && batch.global / batch.slices < 2 {
                let message = format!("a slice of {} and {} slices has no two captions", batch.global, batch.slices);
                p.add("batch.slices", message, "captions are told apart within a slice; take fewer slices");
            }
        }
        StageSettings::ImportEvaluator(s) => {
            if s.path.trim().is_empty() {
                p.add("path", "`path` is missing: the folder with `text_mot_match/model/finest.tar`", "");
            }
        }
        StageSettings::EvaluateT2m(s) => {
            if !s.real {
                sampler(p, &s.sampler);
            }
            p.positive("repeats", s.repeats);
            shards(p, s.shards);
            let MultiModality { captions, samples, pairs } = s.multimodality;
            if captions > 0 && !(1..=samples).contains(&pairs) {
                let message = format!("`multimodality.pairs` is {pairs}; expected 1 to `samples`, {samples}");
                p.add("multimodality.pairs", message, "");
            }
        }
        StageSettings::Register(s) => register(p, s),
    }
    workers(p, placement);
    problems.0
}

fn latent(p: &mut Problems, shape: LatentShape) {
    p.positive("latent.tokens", shape.tokens);
    p.positive("latent.dim", shape.dim);
    if shape.tokens.saturating_mul(shape.dim) > 1 << 20 {
        let message = format!("a latent of {}x{} is larger than any motion", shape.tokens, shape.dim);
        p.add("latent.tokens", message, "published: 1x256 and 16x32");
    }
}

fn network(p: &mut Problems, n: &Network) {
    for (field, value) in [
        ("network.width", n.width),
        ("network.layers", n.layers),
        ("network.heads", n.heads),
        ("network.feed_forward", n.feed_forward),
    ] {
        p.positive(field, value);
        if value > 65_536 {
            p.add(field, format!("`{field}` is {value}; expected at most 65536"), "");
        }
    }
    if n.layers > 0 && n.layers.is_multiple_of(2) {
        let message = format!("`network.layers` is {}; expected an odd number", n.layers);
        p.add("network.layers", message, "the skip stack has as many blocks before its middle block as after it");
    }
    if n.heads > 0 && !n.width.is_multiple_of(n.heads) {
        let message = format!("`network.heads` is {}, which does not divide `network.width`, {}", n.heads, n.width);
        p.add("network.heads", message, "");
    }
    p.fraction("network.dropout", n.dropout, true);
}

fn divides(p: &mut Problems, field: &str, batch: Batch) {
    if batch.slices > 0 && !batch.global.is_multiple_of(batch.slices) {
        let message = format!("`{field}` is {}, which {} slices do not divide", batch.global, batch.slices);
        p.add(field, message, "a slice is one forward and backward pass; all have the same size");
    }
}

fn training(p: &mut Problems, t: &Training) {
    if t.steps.0 == 0 {
        p.add("steps", "`steps` is 0; expected at least 1", "");
    }
    p.positive("batch.global", t.batch.global);
    p.positive("batch.slices", t.batch.slices);
    if t.batch.global > 0 {
        divides(p, "batch.global", t.batch);
    }
    p.above_zero("lr", t.lr);
    optimizer(p, "optimizer", &t.optimizer);
    p.not_negative("max_grad_norm", t.max_grad_norm);
}

fn optimizer(p: &mut Problems, field: &str, o: &Optimizer) {
    p.fraction(&format!("{field}.beta1"), o.beta1, true);
    p.fraction(&format!("{field}.beta2"), o.beta2, true);
    p.above_zero(&format!("{field}.eps"), o.eps);
    p.not_negative(&format!("{field}.weight_decay"), o.weight_decay);
}

/// Points of the solver grid; `None` if `skip` is wrong.
fn grid(d: &Distillation) -> Option<usize> {
    (d.skip > 0 && 1000usize.is_multiple_of(d.skip)).then(|| 1000 / d.skip)
}

fn distillation(p: &mut Problems, d: &Distillation) {
    let (low, high) = d.guidance;
    if low > high {
        p.add("guidance", format!("`guidance` is [{low}, {high}]; expected the smaller number first"), "");
    }
    if !(low >= 0.0 && high.is_finite()) {
        p.add("guidance", format!("`guidance` is [{low}, {high}]; expected numbers of 0 or more"), "");
    }
    if d.guidance_dim < 4 || !d.guidance_dim.is_multiple_of(2) {
        let message = format!("`guidance_dim` is {}; expected an even number of at least 4", d.guidance_dim);
        p.add("guidance_dim", message, "half of it are sines, half cosines");
    }
    if grid(d).is_none() {
        let message = format!("`skip` is {}; expected a divisor of the 1000 timesteps", d.skip);
        p.add("skip", message, "published: 100 (MotionLCM v2, MotionPCM) and 20 (MotionLCM v1)");
    }
    if d.distance == Distance::Huber {
        p.above_zero("huber_c", d.huber_c);
    }
    p.fraction("ema", d.ema, true);
    training(p, &d.training);
}

fn sampler(p: &mut Problems, s: &Sampler) {
    if !(1..=1000).contains(&s.steps) {
        p.add("sampler.steps", format!("`sampler.steps` is {}; expected 1 to 1000", s.steps), "");
    }
    p.not_negative("sampler.guidance", s.guidance);
    if let Some(t) = s.timesteps.iter().find(|t| **t > 999) {
        p.add("sampler.timesteps", format!("timestep {t} is out of range; expected 0 to 999"), "");
    }
    if s.timesteps.windows(2).any(|pair| pair[0] < pair[1]) {
        p.add("sampler.timesteps", "`sampler.timesteps` rise; expected the noisiest first", "");
    }
    if !s.timesteps.is_empty() && s.timesteps.len() != s.steps {
        let message =
            format!("`sampler.timesteps` has {} entries, but `sampler.steps` is {}", s.timesteps.len(), s.steps);
        p.add("sampler.timesteps", message, "");
    }
}

fn shards(p: &mut Problems, shards: usize) {
    if !(1..=100_000).contains(&shards) {
        p.add("shards", format!("`shards` is {shards}; expected 1 to 100000"), "");
    }
}

fn workers(p: &mut Problems, placement: &Placement) {
    let w = placement.workers;
    p.positive("workers.min", w.min);
    if w.max != 0 && w.max < w.min {
        let message = format!("`workers.max` is {}, below `workers.min`, {}", w.max, w.min);
        p.add("workers.max", message, "0 sets no upper bound");
    }
    let keep = &placement.checkpoint.keep;
    p.positive("checkpoint.keep.latest", keep.latest);
    if keep.metric.trim().is_empty() {
        p.add(
            "checkpoint.keep.metric",
            "`checkpoint.keep.metric` is empty; expected a value that the stage records",
            "",
        );
    } else if keep.best == 0 && keep.metric != Keep::default().metric {
        let message = format!("`checkpoint.keep.metric` is `{}`, but no best are kept", keep.metric);
        p.add("checkpoint.keep.metric", message, "set `checkpoint.keep.best` to how many");
    }
}

fn register(p: &mut Problems, s: &Register) {
    if s.model.is_empty() {
        p.add("model", "`model` is missing: the name under which versions are registered", "");
    } else if !is_name(&s.model) {
        let message = format!("`{}` is not a model name; expected letters, digits, `.`, `_`, `-`, at most 64", s.model);
        p.add("model", message, "");
    }
    if s.from.is_empty() {
        p.add(
            "from",
            "`from` is missing: the training stages whose denoisers become versions",
            "such as `from: [lcm, pcm]`",
        );
    }
    for (i, stage) in s.from.iter().enumerate() {
        if s.from[..i].contains(stage) {
            p.add("from", format!("`from` lists `{stage}` twice"), "");
        }
    }
    if s.metric.trim().is_empty() {
        p.add("metric", "`metric` is empty; expected the metric that decides which version is best", "");
    }
    if !s.promote.to.is_empty() && !is_name(&s.promote.to) {
        let message =
            format!("`{}` is not an alias; expected letters, digits, `.`, `_`, `-`, at most 64", s.promote.to);
        p.add("promote.to", message, "");
    }
    if s.promote.to.is_empty() && !s.promote.require.is_empty() {
        p.add("promote.require", "`promote.require` has gates, but `promote.to` names no alias", "");
    }
    for gate in &s.promote.require {
        if !is_gate(gate) {
            let message =
                format!("`{gate}` is not a gate; expected a metric, one of <= >= < >, and a number or an alias");
            p.add("promote.require", message, "such as \"latent_fid <= 0.3\"");
        }
    }
}

/// `metric <= number`, or with `alias`, `alias + number`, `alias - number` on the right.
fn is_gate(gate: &str) -> bool {
    let Some(at) = gate.find(['<', '>']) else { return false };
    let (metric, rest) = gate.split_at(at);
    let metric = metric.trim();
    let Some(right) = ["<=", ">=", "<", ">"].iter().find_map(|operator| rest.strip_prefix(operator)) else {
        return false;
    };
    let metric_fits = !metric.is_empty()
        && metric.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-' | b'@' | b'/'));
    let number = |text: &str| text.parse::<f64>().is_ok_and(f64::is_finite);
    let words: Vec<&str> = right.split_whitespace().collect();
    let right_fits = match words[..] {
        [bound] => number(bound) || (is_name(bound) && bound.parse::<f64>().is_err()),
        [alias, "+" | "-", offset] => is_name(alias) && number(offset),
        _ => false,
    };
    metric_fits && right_fits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gates_are_comparisons() {
        for good in [
            "latent_fid <= 0.3",
            "fid<=0.05",
            "fid.upper <= 0.05",
            "eval.r_precision_top1 >= staging - 0.005",
            "a > 1",
            "a < prod",
            "fid.upper <= 0.05",
        ] {
            assert!(is_gate(good), "{good}");
        }
        for bad in ["", "latent_fid", "<= 1", "a <= ", "a => 1", "a == 1", "a <= b c", "a b <= 1", "a <= nan"] {
            assert!(!is_gate(bad), "{bad}");
        }
    }

    #[test]
    fn defaults_are_valid_but_for_what_has_no_default() {
        for settings in StageSettings::all() {
            let fields: Vec<String> =
                stage(&settings, &Placement::default()).into_iter().map(|problem| problem.field).collect();
            let expected: &[&str] = match settings {
                StageSettings::DataOpen(_) | StageSettings::ImportEvaluator(_) => &["path"],
                StageSettings::Register(_) => &["model", "from"],
                _ => &[],
            };
            assert_eq!(fields, expected, "{}", settings.kind());
        }
    }
}
