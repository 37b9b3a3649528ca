//! The loop with every feature of a stage: a codebook that follows sums over the slices and resets unused codes, two
//! groups that take turns, a frozen group, and a first step that only gathers sums.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::sync::{Arc, Mutex};

use models::optim::{AdamW, LrSchedule};
use motion::Stream;
use protocol::stage::{Batch, CheckpointPolicy, Decay, Optimizer, Replicas, StageSettings, TrainVae, Training};
use protocol::{ArtifactKind, Seed, Steps};
use safetensors::SafeTensors;
use serde_json::json;

use stage_lab::{Bench, Script};
use stages::artifacts;
use stages::context::{GangContext, Outcome, StageError};
use stages::train::{
    AfterStep, Average, BufferPlan, Buffers, Clip, GroupPlan, Objective, SliceResult, SumPlan, TrainState, Trained,
    Turns, train,
};

const MU: f32 = 0.99;

/// Source of the rows to be quantised.
#[derive(Clone)]
enum Rows {
    /// `each` keyed draws of this width for each example.
    Drawn { each: usize, width: usize },
    /// Rows by example and by step; the first step is used twice if the codebook starts from it.
    Stored(Arc<Vec<Vec<Vec<f32>>>>),
}

/// Noise on repeated rows.
#[derive(Clone)]
enum Noise {
    Drawn,
    /// Noise for the initialisation, then for every update.
    Stored(Arc<Vec<Vec<f32>>>),
}

/// Rows are shifted and scaled by two trained groups and then quantised; the loss is the commitment of the rows to
/// their codes.
#[derive(Clone)]
struct Toy {
    rows: Rows,
    noise: Noise,
    codes: usize,
    width: usize,
    training: Training,
    /// Initial codebook, sums and counts; otherwise the first step's rows supply them.
    given: Option<[Vec<f32>; 3]>,
    shift: Vec<f32>,
    scale: Vec<f32>,
    codebook: Vec<f32>,
    /// Buffers after each step.
    seen: Arc<Mutex<Vec<Buffers>>>,
}

impl Toy {
    /// Number of steps that only gather sums.
    fn looks(&self) -> u64 {
        u64::from(self.given.is_none())
    }

    /// The rows of one slice before shift and scale.
    fn raw(&self, step: u64, slice: usize) -> Vec<f32> {
        match &self.rows {
            Rows::Drawn { each, width } => {
                let mut values = vec![0.0; each * width];
                Stream::new(Seed(3), "rows", slice as u64, step).fill_normal(&mut values);
                // A few clusters that move, so that codes fall out of use.
                let centre = (slice as f32 * 1.7 + step as f32 * 0.2).sin() * 3.0;
                values.iter_mut().for_each(|value| *value = *value * 0.3 + centre);
                values
            }
            Rows::Stored(steps) => steps[step.saturating_sub(self.looks()) as usize][slice].clone(),
        }
    }

    fn nearest(&self, row: &[f32]) -> usize {
        let distance = |code: &[f32]| row.iter().zip(code).map(|(r, c)| (r - c) * (r - c)).sum::<f32>();
        let all = self.codebook.chunks_exact(self.width).map(distance).enumerate();
        all.min_by(|a, b| a.1.total_cmp(&b.1)).expect("a codebook has codes").0
    }

    /// The first rows of the batch, one for each code, repeated with noise if there are fewer rows than codes.
    fn candidates(&self, after: &AfterStep<'_>, update: Option<u64>) -> Vec<f32> {
        let rows = after.sum("rows");
        let (wanted, deviation) = (self.codes * self.width, 0.01 / (self.width as f32).sqrt());
        if rows.len() >= wanted {
            return rows[..wanted].to_vec();
        }
        let len = rows.len() * wanted.div_ceil(rows.len());
        let noise = match &self.noise {
            Noise::Drawn => {
                let mut noise = vec![0.0; len];
                after.stream(if update.is_none() { "first codes" } else { "resets" }, 0).fill_normal(&mut noise);
                noise
            }
            Noise::Stored(all) => all[update.map_or(0, |update| update as usize + 1)].clone(),
        };
        rows.iter().cycle().zip(&noise).map(|(row, noise)| row + noise * deviation).take(wanted).collect()
    }
}

impl Objective for Toy {
    fn groups(&mut self) -> Vec<GroupPlan> {
        let steps = self.training.steps.0;
        let plan = |name, value: f32, turns: Turns| {
            GroupPlan {
                name,
                entries: Vec::new(),
                params: vec![value; self.width],
                optimizer: AdamW::from(&self.training.optimizer),
                lr: LrSchedule::from(&self.training),
                clip: Some(Clip { norm: 0.5, together: "encoder" }),
                average: Some(Average::of(0.9)),
                turns: Turns::ALWAYS,
            }
            .taking(turns, steps)
        };
        let trained = Turns::during(self.looks()..steps);
        vec![
            plan("shift", 0.0, trained.clone().one_in(2, 0)),
            plan("scale", 1.0, trained.one_in(2, 1)),
            plan("frozen", 2.0, Turns::NEVER),
        ]
    }

    fn buffers(&mut self) -> Vec<BufferPlan> {
        let empty = || {
            let numbers = |n| vec![0.0; n];
            [numbers(self.codes * self.width), numbers(self.codes * self.width), numbers(self.codes)]
        };
        let values = self.given.clone().unwrap_or_else(empty);
        let named = ["codebook", "sums", "counts"].into_iter().zip(values);
        named.map(|(name, values)| BufferPlan { name: name.into(), values }).chain([resets()]).collect()
    }

    fn terms(&self) -> Vec<&'static str> {
        vec!["loss"]
    }

    fn sums(&self) -> Vec<SumPlan> {
        let rows = (0..self.training.batch.slices).map(|slice| self.raw(0, slice).len()).sum::<usize>();
        let sum = |name: &str, len| SumPlan { name: name.into(), len };
        let all = self.codes * self.width;
        vec![sum("rows", rows.min(all)), sum("code sums", all), sum("code counts", self.codes)]
    }

    fn load(&mut self, state: &TrainState) {
        self.shift = state.params(0).to_vec();
        self.scale = state.params(1).to_vec();
        self.codebook = state.buffers.get("codebook").to_vec();
        self.seen.lock().unwrap().push(state.buffers.clone());
    }

    fn slice(&mut self, step: u64, slice: usize) -> Result<SliceResult, StageError> {
        let (width, raw) = (self.width, self.raw(step, slice));
        let encoded: Vec<f32> =
            raw.iter().enumerate().map(|(i, x)| x * self.scale[i % width] + self.shift[i % width]).collect();
        let plans = self.sums();
        let mut sums: Vec<Vec<f32>> = plans.iter().map(|plan| vec![0.0; plan.len]).collect();
        // Each slice writes its rows at their places in the batch; all others add zeros there.
        let first = slice * raw.len();
        for (place, value) in sums[0].iter_mut().skip(first).zip(&encoded) {
            *place = *value;
        }
        let all = (raw.len() * self.training.batch.slices) as f32;
        let (mut loss, mut shift, mut scale) = (0.0, vec![0.0; width], vec![0.0; width]);
        if step >= self.looks() {
            for (row, raw) in encoded.chunks_exact(width).zip(raw.chunks_exact(width)) {
                let code = self.nearest(row);
                sums[2][code] += 1.0;
                for i in 0..width {
                    sums[1][code * width + i] += row[i];
                    let off = row[i] - self.codebook[code * width + i];
                    loss += off * off / all;
                    shift[i] += 2.0 * off / all;
                    scale[i] += 2.0 * off * raw[i] / all;
                }
            }
        }
        let turn = |at| step >= self.looks() && (step - self.looks()) % 2 == at;
        let gradients = [(0, shift), (1, scale)].map(|(at, gradient)| if turn(at) { gradient } else { Vec::new() });
        Ok(SliceResult { gradients: gradients.into_iter().chain([Vec::new()]).collect(), terms: vec![loss], sums })
    }

    fn after(&mut self, after: &mut AfterStep<'_>) -> Result<(), StageError> {
        let Some(update) = after.step.checked_sub(self.looks()) else {
            let rows = self.candidates(after, None);
            after.buffers.get_mut("codebook").copy_from_slice(&rows);
            after.buffers.get_mut("sums").copy_from_slice(&rows);
            after.buffers.get_mut("counts").fill(1.0);
            return Ok(());
        };
        let follow = |kept: &mut [f32], new: &[f32]| {
            kept.iter_mut().zip(new).for_each(|(kept, new)| *kept = *kept * MU + (1.0 - MU) * new);
        };
        let (new_sums, new_counts) = (after.sum("code sums"), after.sum("code counts"));
        follow(after.buffers.get_mut("sums"), new_sums);
        follow(after.buffers.get_mut("counts"), new_counts);
        let rows = self.candidates(after, Some(update));
        let (sums, counts) = (after.buffers.get("sums").to_vec(), after.buffers.get("counts").to_vec());
        let mut resets = 0.0;
        for (code, count) in counts.iter().enumerate() {
            let range = code * self.width..(code + 1) * self.width;
            let codebook = &mut after.buffers.get_mut("codebook")[range.clone()];
            if *count >= 1.0 {
                codebook.iter_mut().zip(&sums[range]).for_each(|(code, sum)| *code = sum / count);
            } else {
                codebook.copy_from_slice(&rows[range]);
                resets += 1.0;
            }
        }
        after.buffers.get_mut("resets")[0] += resets;
        Ok(())
    }
}

fn resets() -> BufferPlan {
    BufferPlan { name: "resets".into(), values: vec![0.0] }
}

fn training(steps: u64, slices: usize, lr: f64) -> Training {
    Training {
        steps: Steps(steps),
        batch: Batch { global: slices, slices },
        lr,
        warmup: Steps(2),
        decay: Decay::Cosine,
        optimizer: Optimizer::default(),
        max_grad_norm: 1.0,
        sync: Replicas::default(),
        stop: None,
    }
}

fn toy(rows: Rows, codes: usize, width: usize, training: Training) -> Toy {
    Toy {
        rows,
        noise: Noise::Drawn,
        codes,
        width,
        training,
        given: None,
        shift: Vec::new(),
        scale: Vec::new(),
        codebook: Vec::new(),
        seen: Arc::default(),
    }
}

/// A stage around the objective; its output is its whole state.
fn stage(toy: &Toy, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let mut objective = toy.clone();
    match train(&mut objective, &toy.training, cx)? {
        Trained::Yielded { at } => Ok(Outcome::Yielded { at }),
        Trained::Finished { state, metrics } => {
            let bytes = state.saved(|pieces| pieces.concat());
            let output = artifacts::publish(cx, ArtifactKind::Report, json!({}), "state", bytes)?;
            Ok(Outcome::Finished { output, metrics })
        }
    }
}

const STEPS: u64 = 24;

fn world(members: usize) -> Bench {
    let mut bench = Bench::new(burn::tensor::Device::flex(), 7, members);
    bench.checkpoint = CheckpointPolicy { every: Steps(5), ..CheckpointPolicy::default() };
    bench
}

fn run(bench: &mut Bench, toy: &Toy) -> Result<protocol::Digest, StageError> {
    let settings = StageSettings::from(TrainVae { training: toy.training.clone(), ..TrainVae::default() });
    bench.run_gang("toy", &settings, &[], &|cx| stage(toy, cx)).map(|ran| ran.output())
}

/// Codes are reset in every step: with fewer rows than codes from keyed noise, with more from the batch.
fn toys() -> [Toy; 2] {
    [4, 24].map(|codes| toy(Rows::Drawn { each: 2, width: 3 }, codes, 3, training(STEPS, 6, 0.05)))
}

#[test]
fn p6_buffers_have_the_same_bits_for_any_number_of_members() {
    for toy in toys() {
        let expected = run(&mut world(1), &toy).unwrap();
        let last = toy.seen.lock().unwrap().last().unwrap().clone();
        assert!(last.get("resets")[0] > 3.0, "{} codes are reset", toy.codes);
        for members in [2, 3, 6] {
            assert_eq!(run(&mut world(members), &toy).unwrap(), expected, "{members} members");
        }
        // Joiners adopt the buffers of a peer, and one of them is lost. The first member stays: steps are so short that
        // it may be far ahead when they join.
        let mut bench = world(1);
        bench.script = Script { joins: vec![(1, 5), (2, 5)], lost: vec![(2, 17)], ..Script::default() };
        assert_eq!(run(&mut bench, &toy).unwrap(), expected, "members that come and go");
    }
}

/// A joiner has part of a peer's state in place of its own when the peer is lost. It continues from a checkpoint, or
/// from the beginning.
#[test]
fn p4_a_state_that_is_cut_short_on_its_way_is_not_used() {
    for toy in toys() {
        let expected = run(&mut world(1), &toy).unwrap();
        for every in [0, 5] {
            let mut bench = world(1);
            bench.checkpoint.every = Steps(every);
            bench.script = Script { joins: vec![(1, 7)], lost_donating: vec![1], ..Script::default() };
            assert_eq!(run(&mut bench, &toy).unwrap(), expected, "a checkpoint every {every} steps");
        }
    }
}

#[test]
fn p5_a_kill_at_every_step_changes_no_bit_of_the_buffers() {
    for toy in toys() {
        let expected = run(&mut world(1), &toy).unwrap();
        for step in 0..STEPS {
            for members in 1..=3 {
                let mut bench = world(members);
                bench.script = Script { lost: (0..members).map(|m| (m, step)).collect(), ..Script::default() };
                assert!(run(&mut bench, &toy).is_err(), "over before step {step}");
                bench.script = Script::default();
                bench.members = 4 - members;
                assert_eq!(run(&mut bench, &toy).unwrap(), expected, "{members} members killed at step {step}");
            }
        }
    }
}

#[test]
fn groups_take_turns_and_what_is_frozen_stays() {
    let (toy, mut bench) = (toys()[0].clone(), world(2));
    let digest = run(&mut bench, &toy).unwrap();
    let manifest = bench.manifest(digest).unwrap();
    let bytes = artifacts::file(&*bench.blobs(), &manifest, "state").unwrap();
    let state = SafeTensors::deserialize(&bytes).unwrap();
    let values = |name: &str| bytemuck::pod_collect_to_vec::<u8, f32>(state.tensor(name).unwrap().data());
    assert_eq!(values("frozen.params"), [2.0; 3]);
    assert!(values("frozen.m").is_empty() && values("frozen.average") == [2.0; 3]);
    for name in ["shift.m", "scale.m"] {
        assert!(values(name).iter().all(|m| *m != 0.0), "{name} is trained");
    }
    let names: Vec<_> = state.names().into_iter().filter(|name| name.starts_with("buffer.")).collect();
    assert_eq!(names.len(), 4, "{names:?}");
}

/// A result of another shape than planned is an explicit fault, not a wrong sum.
#[test]
fn a_slice_that_breaks_its_plan_is_refused() {
    struct Broken(Toy);
    impl Objective for Broken {
        fn groups(&mut self) -> Vec<GroupPlan> {
            self.0.groups()
        }
        fn terms(&self) -> Vec<&'static str> {
            self.0.terms()
        }
        fn load(&mut self, _: &TrainState) {}
        fn slice(&mut self, _: u64, _: usize) -> Result<SliceResult, StageError> {
            Ok(SliceResult { gradients: vec![vec![1.0; 3]; 3], terms: vec![0.0], sums: Vec::new() })
        }
    }
    let toy = toys()[0].clone();
    let settings = StageSettings::from(TrainVae { training: toy.training.clone(), ..TrainVae::default() });
    let body = |cx: &mut dyn GangContext| match train(&mut Broken(toy.clone()), &toy.training, cx)? {
        Trained::Yielded { at } | Trained::Finished { state: TrainState { step: at, .. }, .. } => {
            Ok(Outcome::Yielded { at })
        }
    };
    let error = world(1).run_gang("toy", &settings, &[], &body).unwrap_err().to_string();
    assert!(error.contains("a slice has gradients of [3, 3, 3] values"), "{error}");
}

/// Codebooks, sums and counts over several steps against those of the published quantiser (fixture `05_rvq_ema`): the
/// hook's result for sums over slices, one clip per slice.
#[test]
fn parity_ema_codebook() {
    let Some(folder) = fixtures::data("parity/05_rvq_ema") else { return };
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let config = std::fs::read(folder.join("config.json")).unwrap();
    let io = SafeTensors::deserialize(&bytes).unwrap();
    let config: serde_json::Value = serde_json::from_slice(&config).unwrap();
    let size = |value: &serde_json::Value| value.as_u64().unwrap() as usize;
    let (codes, width) = (size(&config["nb_code"]), size(&config["code_dim"]));
    let stored = |name: &str| {
        let tensor = io.tensor(name).unwrap();
        (tensor.shape().to_vec(), bytemuck::pod_collect_to_vec::<u8, f32>(tensor.data()))
    };
    for case in ["single", "loaded", "tile"] {
        let (steps, clips) = (size(&config[case]["steps"]), size(&config[case]["B"]));
        let (shape, rows) = stored(&format!("{case}/rows"));
        let each = shape[1] / clips * width;
        let of_step = |step: &[f32]| step.chunks_exact(each).map(<[f32]>::to_vec).collect();
        let rows = rows.chunks_exact(shape[1] * width).map(of_step).collect();
        let given = io
            .tensor(&format!("{case}/start_codebook"))
            .ok()
            .map(|_| ["codebook", "sum", "count"].map(|part| stored(&format!("{case}/start_{part}")).1));
        // A learning rate near zero: the rows must not change.
        let looks = u64::from(given.is_none());
        let settings = training(steps as u64 + looks, clips, f64::MIN_POSITIVE);
        let mut toy = Toy { given, ..toy(Rows::Stored(Arc::new(rows)), codes, width, settings) };
        if case == "tile" {
            let first = stored("tile/noise_init").1;
            let updates = stored("tile/noise_update").1;
            let updates = updates.chunks_exact(first.len()).map(<[f32]>::to_vec);
            toy.noise = Noise::Stored(Arc::new([first.clone()].into_iter().chain(updates).collect()));
        }
        run(&mut world(1), &toy).unwrap();
        let seen = toy.seen.lock().unwrap().split_off(1);
        assert_eq!(seen.len(), steps + looks as usize);
        let close = |found: &[f32], expected: &[f32], what: &str| {
            let scale = expected.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
            let off = found.iter().zip(expected).fold(0.0_f32, |most, (f, e)| most.max((f - e).abs()));
            assert!(found.len() == expected.len() && off <= 1e-5 * scale, "{what}: off by {off} of {scale}");
        };
        if looks == 1 {
            close(seen[0].get("codebook"), &stored(&format!("{case}/codebook_after_init")).1, "first codes");
        }
        for (name, theirs) in [("codebook", "codebook"), ("sums", "code_sum"), ("counts", "code_count")] {
            let expected = stored(&format!("{case}/{theirs}")).1;
            for (step, expected) in expected.chunks_exact(expected.len() / steps).enumerate() {
                close(seen[step + looks as usize].get(name), expected, &format!("{case} {theirs} after step {step}"));
            }
        }
    }
}
