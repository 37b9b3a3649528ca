//! Variety of motions: Diversity over a set, MultiModality within the motions of one caption.
//!
//! Source: Guo et al. (text-to-motion). Diversity is the mean distance of pairs of two draws from the set.
//! MultiModality is the same within each caption's motions, with one draw for all captions. The caller makes the draws.

use super::retrieval::{row, squared};

/// Number of pairs that Diversity compares if the set is large enough.
pub const DIVERSITY_PAIRS: usize = 300;

/// Mean distance of row `first[i]` to row `second[i]`.
///
/// # Panics
/// If the draws are empty or of different lengths.
pub fn diversity(rows: &[f64], dim: usize, first: &[usize], second: &[usize]) -> f64 {
    assert!(!first.is_empty() && first.len() == second.len(), "as many first as second rows, at least one");
    let distance = |(a, b): (&usize, &usize)| squared(row(rows, *a, dim), row(rows, *b, dim)).sqrt();
    first.iter().zip(second).map(distance).sum::<f64>() / first.len() as f64
}

/// Mean distance within each caption: `rows` are `[captions, samples, dim]`, and the draws are of samples.
///
/// # Panics
/// As [`diversity`], and if the rows are not whole captions.
pub fn multimodality(rows: &[f64], samples: usize, dim: usize, first: &[usize], second: &[usize]) -> f64 {
    assert!(!rows.is_empty() && rows.len().is_multiple_of(samples * dim), "whole captions");
    let captions = rows.len() / (samples * dim);
    rows.chunks_exact(samples * dim).map(|rows| diversity(rows, dim, first, second)).sum::<f64>() / captions as f64
}
