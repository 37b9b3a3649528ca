//! The metrics of a repeat, from the embeddings of all shards.

use std::collections::{BTreeMap, BTreeSet};

use protocol::Digest;
use serde::Deserialize;

use super::plan::{EMBEDDINGS_FILE, Part, Plan, Unit};
use crate::artifacts::{self, Tensors};
use crate::context::{AttemptContext, StageError};
use crate::metrics::frechet::{Gaussian, to_f64};
use crate::metrics::retrieval::{Retrieval, in_groups};
use crate::metrics::spread;

/// All values of the shards, by unit.
#[derive(Default)]
pub(super) struct Gathered {
    text: BTreeMap<Unit, Vec<f64>>,
    made: BTreeMap<Unit, Vec<f64>>,
    real: BTreeMap<Unit, Vec<f64>>,
    many: BTreeMap<Unit, Vec<f64>>,
    skating: BTreeMap<Unit, Vec<f64>>,
}

pub(super) fn gather(cx: &dyn AttemptContext, plan: &Plan<'_>, shards: &[Digest]) -> Result<Gathered, StageError> {
    #[derive(Deserialize)]
    struct ShardMeta {
        units: Vec<Unit>,
    }
    let (blobs, width) = (cx.blobs(), plan.trained.width());
    let mut all = Gathered::default();
    for digest in shards {
        let manifest = cx.manifest(*digest)?;
        let ShardMeta { units } = artifacts::meta(&manifest, "a shard of the evaluation")?;
        let bytes = artifacts::mapped(&*blobs, &manifest, EMBEDDINGS_FILE)?;
        let mut tensors = Tensors::from_bytes(bytes, EMBEDDINGS_FILE)?;
        let mut take =
            |name: &str, rank| Ok::<_, StageError>(to_f64(&tensors.take(name, rank, EMBEDDINGS_FILE)?.values));
        let (text, made, real) = (take("text", 2)?, take("made", 2)?, take("real", 2)?);
        let (many, skating) = (take("many", 2)?, take("skating", 1)?);
        let (mut row, mut extra) = (0, 0);
        for unit in units {
            match unit.part {
                Part::Entries => {
                    let rows = row..row + plan.block(unit.block).len();
                    let cut = |values: &[f64]| values[rows.start * width..rows.end * width].to_vec();
                    all.text.insert(unit, cut(&text));
                    all.made.insert(unit, cut(&made));
                    all.real.insert(unit, cut(&real));
                    all.skating.insert(unit, skating[rows.clone()].to_vec());
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
    let found: BTreeSet<Unit> = all.made.keys().chain(all.many.keys()).copied().collect();
    let expected: BTreeSet<Unit> = plan.units().into_iter().collect();
    if found != expected {
        return Err(StageError::Fault(format!(
            "the shards have {} blocks of motions; expected {}",
            found.len(),
            expected.len()
        )));
    }
    Ok(all)
}

/// Reorders the rows of `values` by `rows`.
fn reorder(values: &[f64], rows: &[u32], width: usize) -> Vec<f64> {
    rows.iter().flat_map(|row| values[*row as usize * width..(*row as usize + 1) * width].iter().copied()).collect()
}

/// The metrics of one repeat, by name.
pub(super) fn measure(plan: &Plan<'_>, all: &Gathered, repeat: usize) -> BTreeMap<String, f64> {
    let (width, n) = (plan.trained.width(), plan.entries.len());
    let of = |parts: &BTreeMap<Unit, Vec<f64>>| -> Vec<f64> {
        parts.iter().filter(|(unit, _)| unit.repeat == repeat).flat_map(|(_, values)| values.iter().copied()).collect()
    };
    let order = |what: &str| plan.order(what, repeat, n);
    let (text, made, real, skating) = (of(&all.text), of(&all.made), of(&all.real), of(&all.skating));
    // Entries that do not fill a pool are at the end of its permutation.
    let pools = order("pools");
    let kept = &pools[..plan.kept()];
    let dealt = if plan.settings.shuffled { order("shuffled") } else { pools.clone() };
    let (text, found_in) = (reorder(&text, &dealt[..kept.len()], width), reorder(&made, kept, width));
    let mut metrics = BTreeMap::new();
    for (i, pool) in plan.settings.pools.iter().enumerate() {
        let suffix = if i == 0 { String::new() } else { format!("_pool{pool}") };
        retrieval(&mut metrics, &suffix, in_groups(&text, &found_in, width, *pool));
    }
    // In the order of the entries, so that only `drop_last` changes these.
    let mut rows = kept.to_vec();
    rows.sort_unstable();
    let (made, real) = (reorder(&made, &rows, width), reorder(&real, &rows, width));
    let pairs = spread::DIVERSITY_PAIRS.min(rows.len());
    let drawn = |what: &str| -> Vec<usize> {
        plan.order(what, repeat, rows.len()).into_iter().take(pairs).map(|i| i as usize).collect()
    };
    let (first, second) = (drawn("diversity 1"), drawn("diversity 2"));
    metrics.extend([
        ("fid".to_owned(), Gaussian::fit(&real, width).distance(&Gaussian::fit(&made, width)).max(0.0)),
        ("diversity".to_owned(), spread::diversity(&made, width, &first, &second)),
        ("skating_ratio".to_owned(), reorder(&skating, &rows, 1).iter().sum::<f64>() / rows.len() as f64),
    ]);
    if plan.settings.real {
        let order = plan.order("halves", repeat, rows.len());
        let (one, other) = order.split_at(rows.len() / 2);
        let half = |of: &[u32]| Gaussian::fit(&reorder(&made, of, width), width);
        metrics.insert("fid_halves".to_owned(), half(one).distance(&half(other)).max(0.0));
    }
    let many = of(&all.many);
    if !many.is_empty() {
        let of = plan.settings.multimodality;
        let drawn = |what: &str| -> Vec<usize> {
            plan.order(what, repeat, of.samples).into_iter().take(of.pairs).map(|i| i as usize).collect()
        };
        let (first, second) = (drawn("multimodality 1"), drawn("multimodality 2"));
        let value = spread::multimodality(&many, of.samples, width, &first, &second);
        metrics.insert("multimodality".to_owned(), value);
    }
    metrics
}

fn retrieval(metrics: &mut BTreeMap<String, f64>, suffix: &str, found: Retrieval) {
    for (k, top) in found.top.into_iter().enumerate() {
        metrics.insert(format!("r_precision_top{}{suffix}", k + 1), top);
    }
    metrics.insert(format!("mm_dist{suffix}"), found.matching_score);
}
