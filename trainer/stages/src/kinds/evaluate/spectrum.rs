//! `evaluate.spectrum`: the order in which a motion's frequencies settle during denoising. Source: Free-T2M (Chen et
//! al., 2025, figure 4).
//!
//! Captions and lengths of entries are drawn, keyed by (seed, entry). In every step of the sampler the model's
//! prediction of the clean motion is decoded if it is a latent. Its energy by frequency band is compared with that of
//! the entry's real crop and with that of the final motion.
//!
//! Departs: the figure shows one clip's spectrum; here it is a mean over motions, in numbers.

use std::collections::BTreeMap;
use std::rc::Rc;

use motion::Stream;
use motion::dataset::crop;
use protocol::stage::EvaluateSpectrum;
use serde_json::json;

use crate::context::{AttemptContext, Outcome, StageError};
use crate::evaluation::measured::measured;
use crate::evaluation::report::{no_entries, publish_report};
use crate::generate::generator::Batch;
use crate::kinds::shape::Plain;
use crate::metrics::spectrum::Bands;

/// Sums over motions of one sampler step.
#[derive(Debug, Clone, Default)]
struct Step {
    energy: Vec<f64>,
    /// Energy of the difference from the last step's prediction, by band.
    off: Vec<f64>,
}

fn add(to: &mut Vec<f64>, from: &[f64]) {
    to.resize(from.len(), 0.0);
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

/// Sums over motions of the energies by band.
#[derive(Debug, Default)]
struct Sums {
    /// The entries' crops.
    real: Vec<f64>,
    /// The final motions.
    last: Vec<f64>,
    /// The predictions of each sampler step.
    steps: Vec<Step>,
}

impl Sums {
    /// Adds a motion's predictions, one for each step of the sampler.
    fn add_predictions(&mut self, bands: &Bands, motions: &[Vec<f64>], width: usize) -> Result<(), StageError> {
        let Some(end) = motions.last() else {
            return Err(StageError::Fault("the sampler has no steps".into()));
        };
        add(&mut self.last, &bands.energy(end, width));
        self.steps.resize(motions.len(), Step::default());
        for (step, motion) in self.steps.iter_mut().zip(motions) {
            let off: Vec<f64> = motion.iter().zip(end).map(|(a, b)| a - b).collect();
            add(&mut step.energy, &bands.energy(motion, width));
            add(&mut step.off, &bands.energy(&off, width));
        }
        Ok(())
    }

    /// Energy of each band and step as a share of the real clips', and how far the step has settled on the last.
    fn metrics(&self) -> Result<BTreeMap<String, f64>, StageError> {
        let mut metrics = BTreeMap::new();
        for (s, step) in self.steps.iter().enumerate() {
            for b in 0..self.real.len() {
                let place = format!("{}/{}", b + 1, s + 1);
                metrics.insert(format!("energy/{place}"), step.energy[b] / self.real[b].max(f64::MIN_POSITIVE));
                metrics.insert(format!("settled/{place}"), 1.0 - step.off[b] / self.last[b].max(f64::MIN_POSITIVE));
            }
        }
        match metrics.iter().find(|(_, value)| !value.is_finite()) {
            None => Ok(metrics),
            Some((name, value)) => {
                Err(StageError::Input(format!("`{name}` is {value}: the model is not trained well enough")))
            }
        }
    }
}

impl Plain for EvaluateSpectrum {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (dataset, model) = measured(cx, &self.sampler)?;
        let entries: Vec<usize> = dataset.entries_of(self.split).into_iter().take(self.motions).collect();
        if entries.is_empty() {
            return Err(no_entries(self.split));
        }
        let seed = cx.task().seed;
        let width = dataset.mean.len();
        let fps = dataset.skeleton().fps;
        let stream = |what: &str, i: usize| Stream::new(seed, &format!("evaluate.spectrum/{what}"), 0, i as u64);
        let normalised = |rows: &[f32]| -> Vec<f64> {
            let mut rows = rows.to_vec();
            dataset.normalise(&mut rows);
            rows.into_iter().map(f64::from).collect()
        };
        let mut sums = Sums::default();
        let mut timesteps = Vec::new();
        for (done, e) in entries.iter().enumerate() {
            if cx.interrupted() {
                return Ok(Outcome::Yielded { at: 0 });
            }
            let entry = &dataset.entries[*e];
            let mut draw = stream("entry", done);
            let caption = entry.captions[draw.below(entry.captions.len())];
            let (start, length) = crop(&mut draw, entry.len, dataset.skeleton());
            let bands = Bands::new(length, fps, &self.bands);
            let rows = &dataset.features(entry)[start * width..(start + length) * width];
            add(&mut sums.real, &bands.energy(&normalised(rows), width));

            let texts: Vec<_> =
                model.embed(&[dataset.captions[caption].text.as_str()])?.into_iter().map(Rc::new).collect();
            let seeds = |k: usize, _| stream(&format!("noise {k}"), done);
            let batch = Batch { texts: &texts, lengths: &[length], seeds: &seeds, control: None };
            let predicted = model.predictions(batch, &self.sampler)?;
            let motions: Vec<Vec<f64>> = predicted.iter().map(|(_, motion)| normalised(motion)).collect();
            timesteps = predicted.iter().map(|(t, _)| *t).collect();
            sums.add_predictions(&bands, &motions, width)?;
            cx.progress(done as u64 + 1, entries.len() as u64, "motions", &[]);
        }
        let metrics = sums.metrics()?;
        let count = entries.len() as f64;
        let details = json!({
            "bands_hz": self.bands,
            "timesteps": timesteps,
            "real_energy": sums.real.iter().map(|sum| sum / count).collect::<Vec<_>>(),
            "motions": entries.len(),
            "split": self.split,
            "sampler": self.sampler,
        });
        publish_report(cx, metrics, details)
    }
}
