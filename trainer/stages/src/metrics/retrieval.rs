//! Retrieval of the partners of one set of vectors in another.
//!
//! Source: the R-precision and matching score of Guo et al. (Text2Motion). Departs: distances are computed directly in
//! f64 instead of by the expanded square in f32, which gives NaN for near-equal rows.

/// Shares of hits, and the mean distance between partners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Retrieval {
    /// Share of queries whose partner is among the k + 1 nearest, at index k.
    pub top: [f64; 3],
    /// Mean distance of a query to its partner.
    pub matching_score: f64,
}

/// Ranks row i of `targets` for row i of `queries` within consecutive groups of `group` rows; a partial group at the end is
/// left out.
///
/// # Panics
/// If there is no full group.
pub fn in_groups(queries: &[f64], targets: &[f64], dim: usize, group: usize) -> Retrieval {
    let groups = queries.len() / dim / group;
    assert!(groups > 0, "at least {group} rows are needed");
    let mut hits = [0usize; 3];
    let mut distances = 0.0;
    for start in (0..groups).map(|g| g * group) {
        for query in start..start + group {
            let to = |target: usize| squared(row(queries, query, dim), row(targets, target, dim));
            let own = to(query);
            // Of equal distances the first row counts, as in a stable sort.
            let rank = (start..start + group).filter(|&t| to(t) < own || (to(t) == own && t < query)).count();
            hits.iter_mut().skip(rank).for_each(|h| *h += 1);
            distances += own.sqrt();
        }
    }
    let count = (groups * group) as f64;
    Retrieval { top: hits.map(|h| h as f64 / count), matching_score: distances / count }
}

/// Number of `others` that are nearer to `query` than `own` is.
pub fn rank(query: &[f64], own: &[f64], others: impl Iterator<Item = impl AsRef<[f64]>>) -> usize {
    let distance = squared(query, own);
    others.filter(|other| squared(query, other.as_ref()) < distance).count()
}

/// Row `i` of rows of `dim` values.
pub fn row(values: &[f64], i: usize, dim: usize) -> &[f64] {
    &values[i * dim..(i + 1) * dim]
}

/// Squared Euclidean distance.
pub fn squared(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn partners_are_found_at_their_rank() {
        let targets = [0.0, 1.0, 2.0, 3.0, 99.0];
        let queries = [0.0, 1.9, 2.0, 0.0, 0.0];
        let found = in_groups(&queries, &targets, 1, 4);
        // Ranks are 0, 1, 0, 3; the fifth row belongs to no full group.
        assert_eq!(found.top, [0.5, 0.75, 0.75]);
        assert!((found.matching_score - (0.9 + 3.0) / 4.0).abs() < 1e-12);
        assert_eq!(rank(&[0.0], &[2.0], [[1.0], [3.0], [0.5]].iter()), 2);
    }
}
