//! Sums along the fixed binary tree over a step's slices ([`stages::tree::split`]).
//!
//! The sums of any set of disjoint nodes that cover a node give the same bits for it.

use std::ops::Range;

pub(crate) use stages::tree::{Node, split};

/// Floats summed at once: all inputs' blocks and the scratch stay in the CPU cache.
const BLOCK: usize = 4096;

/// The largest nodes of the tree over `0..slices` inside `range`, in order; together they are `range`.
pub(crate) fn cover(slices: usize, range: &Range<usize>) -> Vec<Node> {
    fn visit(node: Node, range: &Range<usize>, out: &mut Vec<Node>) {
        if node.start >= range.end || node.end <= range.start {
            return;
        }
        if range.start <= node.start && node.end <= range.end {
            out.push(node);
            return;
        }
        let middle = split(&node).expect("a slice lies in a range or does not");
        visit(node.start..middle, range, out);
        visit(middle..node.end, range, out);
    }
    let mut out = Vec::new();
    if !range.is_empty() {
        visit(0..slices, range, &mut out);
    }
    out
}

/// The slices of rank `rank` of `members`: contiguous, in order of rank, and no more than an even cut gives to one.
///
/// A member sends a partial sum for each node of its share. So the borders lie, within these limits, where large nodes
/// begin: three members have 6, 4 and 6 of 16 slices, which are six nodes; 5, 5 and 6 are seven.
pub(crate) fn share(slices: usize, rank: usize, members: usize) -> Range<usize> {
    let most = slices.div_ceil(members);
    let least = usize::from(slices >= members);
    let mut own = 0..0;
    for at in 1..=rank + 1 {
        let after = members - at;
        let fits = |end: &usize| {
            (own.end + least..=own.end + most).contains(end) && (after * least..=after * most).contains(&(slices - end))
        };
        let even = slices * at / members;
        let ends = even..=(slices * at).div_ceil(members);
        let end = ends.filter(fits).max_by_key(|end| end.trailing_zeros());
        own = own.end..end.expect("an even cut fits");
    }
    own
}

/// The part of a buffer of `length` numbers that rank `rank` of `members` sums.
pub(crate) fn chunk(length: usize, rank: usize, members: usize) -> Range<usize> {
    length * rank / members..length * (rank + 1) / members
}

/// Sums `known` into `out` along the tree. `known` holds disjoint nodes in order that cover `node`, each with as many
/// numbers as `out`.
///
/// # Panics
/// If `known` does not cover `node`; callers build it from [`cover`].
pub(crate) fn sum(node: &Node, known: &[(Node, &[f32])], out: &mut [f32]) {
    let mut scratch = Vec::new();
    for (i, block) in out.chunks_mut(BLOCK).enumerate() {
        sum_block(node, known, i * BLOCK, block, &mut scratch);
    }
}

fn sum_block(node: &Node, known: &[(Node, &[f32])], at: usize, out: &mut [f32], scratch: &mut Vec<Vec<f32>>) {
    if let [(only, numbers)] = known
        && only == node
    {
        out.copy_from_slice(&numbers[at..at + out.len()]);
        return;
    }
    let middle = split(node).unwrap_or_else(|| panic!("no sum contains slice {}", node.start));
    let (left, right) = known.split_at(known.partition_point(|(node, _)| node.start < middle));
    sum_block(&(node.start..middle), left, at, out, scratch);
    if let [(only, numbers)] = right
        && *only == (middle..node.end)
    {
        add(out, &numbers[at..at + out.len()]);
        return;
    }
    let mut other = scratch.pop().unwrap_or_else(|| vec![0.0; BLOCK]);
    sum_block(&(middle..node.end), right, at, &mut other[..out.len()], scratch);
    add(out, &other[..out.len()]);
    scratch.push(other);
}

fn add(out: &mut [f32], other: &[f32]) {
    for (a, b) in out.iter_mut().zip(other) {
        *a += b;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The definition, computed one number at a time.
    fn plain(node: Node, slices: &[Vec<f32>], at: usize) -> f32 {
        match split(&node) {
            None => slices[node.start][at],
            Some(m) => plain(node.start..m, slices, at) + plain(m..node.end, slices, at),
        }
    }

    #[test]
    fn nodes_are_the_largest_aligned_ones() {
        assert_eq!(cover(8, &(0..8)), vec![0..8; 1]);
        assert_eq!(cover(8, &(3..8)), [3..4, 4..8]);
        assert_eq!(cover(7, &(2..7)), [2..4, 4..7]);
        assert!(cover(5, &(5..5)).is_empty());
    }

    #[test]
    fn borders_lie_where_large_nodes_begin() {
        let lengths =
            |slices, members| -> Vec<usize> { (0..members).map(|r| share(slices, r, members).len()).collect() };
        assert_eq!(lengths(16, 3), [6, 4, 6]);
        assert_eq!(lengths(8, 5), [2, 2, 1, 1, 2]);
        assert_eq!(lengths(16, 16), [1; 16]);
    }

    proptest! {
        #[test]
        fn any_partition_gives_the_same_bits(
            slices in 1usize..20, cuts in proptest::collection::vec(0usize..20, 0..4), length in 1usize..9000, seed in 0u32..1000,
        ) {
            let data: Vec<Vec<f32>> = (0..slices)
                .map(|s| (0..length).map(|i| ((seed as usize + s * 7919 + i * 104_729) % 10_007) as f32 * 0.37 - 1e3).collect())
                .collect();
            let mut bounds: Vec<usize> = cuts.into_iter().map(|c| c % (slices + 1)).chain([0, slices]).collect();
            bounds.sort_unstable();
            // Each range sums its own nodes; the sums are combined afterwards.
            let mut partial: Vec<(Node, Vec<f32>)> = Vec::new();
            for pair in bounds.windows(2) {
                for node in cover(slices, &(pair[0]..pair[1])) {
                    let leaves: Vec<(Node, &[f32])> = node.clone().map(|s| (s..s + 1, data[s].as_slice())).collect();
                    let mut out = vec![0.0; length];
                    sum(&node, &leaves, &mut out);
                    partial.push((node, out));
                }
            }
            let known: Vec<(Node, &[f32])> = partial.iter().map(|(n, v)| (n.clone(), v.as_slice())).collect();
            let mut out = vec![0.0; length];
            sum(&(0..slices), &known, &mut out);
            for at in [0, length / 2, length - 1] {
                prop_assert_eq!(out[at].to_bits(), plain(0..slices, &data, at).to_bits());
            }
        }

        #[test]
        fn shares_and_chunks_cover_without_overlap(slices in 0usize..70, members in 1usize..20) {
            for cut in [share, chunk] {
                let all: Vec<usize> = (0..members).flat_map(|r| cut(slices, r, members)).collect();
                prop_assert_eq!(all, (0..slices).collect::<Vec<_>>());
            }
        }

        #[test]
        fn shares_are_as_small_as_even_ones_and_of_no_more_nodes(slices in 1usize..70, members in 1usize..20) {
            let nodes = |cut: fn(usize, usize, usize) -> Range<usize>| -> Vec<usize> {
                (0..members).map(|r| cover(slices, &cut(slices, r, members)).len()).collect()
            };
            let (ours, even) = (nodes(share), nodes(chunk));
            prop_assert!(ours.iter().sum::<usize>() <= even.iter().sum(), "{:?} for {:?}", ours, even);
            prop_assert!(ours.iter().max() <= even.iter().max(), "{:?} for {:?}", ours, even);
            let largest = (0..members).map(|r| share(slices, r, members).len()).max();
            prop_assert_eq!(largest, Some(slices.div_ceil(members)));
            prop_assert!(slices < members || (0..members).all(|r| !share(slices, r, members).is_empty()));
        }
    }
}
