//! The metrics of a repeat, from the embeddings of all shards.

use std::collections::BTreeMap;

use protocol::Digest;
use protocol::stage::PHYSICS;

use super::plan::{EMBEDDINGS_FILE, Part, Plan, Unit};
use crate::context::{AttemptContext, StageError};
use crate::evaluation::entry_draws::{Ranking, reorder};
use crate::metrics::frechet::{Gaussian, to_f64};
use crate::metrics::physics::mean_physics;
use crate::metrics::spread;
use crate::shards::{self, Units};

/// All values of the shards, by unit.
#[derive(Default)]
pub(super) struct Gathered {
    text: BTreeMap<Unit, Vec<f64>>,
    made: BTreeMap<Unit, Vec<f64>>,
    real: BTreeMap<Unit, Vec<f64>>,
    many: BTreeMap<Unit, Vec<f64>>,
    physics: BTreeMap<Unit, Vec<f64>>,
}

pub(super) fn gather(cx: &dyn AttemptContext, plan: &Plan<'_>, digests: &[Digest]) -> Result<Gathered, StageError> {
    let width = plan.of.trained.width();
    let mut all = Gathered::default();
    for shard in shards::read::<Units<Unit>>(cx, digests, "evaluation", EMBEDDINGS_FILE) {
        let (Units { units }, mut tensors) = shard?;
        let mut take =
            |name: &str, rank| Ok::<_, StageError>(to_f64(&tensors.take(name, rank, EMBEDDINGS_FILE)?.values));
        let text = take("text", 2)?;
        let made = take("made", 2)?;
        let real = take("real", 2)?;
        let many = take("many", 2)?;
        let physics = take("physics", 2)?;
        let mut row = 0;
        let mut extra = 0;
        for unit in units {
            match unit.part {
                Part::Entries => {
                    let rows = row..row + plan.of.block(unit.block).len();
                    let cut = |values: &[f64], width: usize| values[rows.start * width..rows.end * width].to_vec();
                    all.text.insert(unit, cut(&text, width));
                    all.made.insert(unit, cut(&made, width));
                    all.real.insert(unit, cut(&real, width));
                    all.physics.insert(unit, cut(&physics, PHYSICS.len()));
                    row = rows.end;
                }
                Part::Many => {
                    let end = extra + plan.settings.multimodality.samples;
                    all.many.insert(unit, many[extra * width..end * width].to_vec());
                    extra = end;
                }
            }
        }
    }
    shards::expect_units(all.made.keys().chain(all.many.keys()).copied(), plan.units())?;
    Ok(all)
}

/// The metrics of one repeat, by name.
pub(super) fn measure(plan: &Plan<'_>, all: &Gathered, repeat: usize) -> BTreeMap<String, f64> {
    let width = plan.of.trained.width();
    let of = |parts: &BTreeMap<Unit, Vec<f64>>| -> Vec<f64> {
        parts.iter().filter(|(unit, _)| unit.repeat == repeat).flat_map(|(_, values)| values.iter().copied()).collect()
    };
    let text = of(&all.text);
    let made = of(&all.made);
    let real = of(&all.real);
    let physics = of(&all.physics);
    let ranking = Ranking { pools: &plan.settings.pools, kept: plan.kept(), shuffled: plan.settings.shuffled };
    let mut metrics = plan.of.in_space(repeat, (&text, &made, &real), &ranking);
    let rows = plan.of.kept(repeat, plan.kept());
    metrics.extend(mean_physics(&reorder(&physics, &rows, PHYSICS.len())));
    if plan.settings.real {
        let made = reorder(&made, &rows, width);
        let order = plan.of.order("halves", repeat, rows.len());
        let (one, other) = order.split_at(rows.len() / 2);
        let half = |of: &[u32]| Gaussian::fit(&reorder(&made, of, width), width);
        metrics.insert("fid_halves".to_owned(), half(one).distance(&half(other)).max(0.0));
    }
    let many = of(&all.many);
    if !many.is_empty() {
        let of = plan.settings.multimodality;
        let [first, second] =
            ["multimodality 1", "multimodality 2"].map(|what| plan.of.some(what, repeat, of.samples, of.pairs));
        let value = spread::multimodality(&many, of.samples, width, &first, &second);
        metrics.insert("multimodality".to_owned(), value);
    }
    metrics
}
