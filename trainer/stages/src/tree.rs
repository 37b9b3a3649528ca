//! The fixed tree along which the slices of a step are summed.
//!
//! A node is a range of slices; the root is all of them. A node of more than one slice splits so that its left part is the
//! largest power of two below its length. Floating-point addition is not associative, so the tree decides which two
//! numbers are added, and not the members. A gang over a network sums the same tree piece by piece (`worker::gang`).

use std::ops::Range;

use models::flat::recycle;

/// A range of slices that is a node of the tree.
pub type Node = Range<usize>;

/// Index at which a node splits, or `None` for a single slice.
pub fn split(node: &Node) -> Option<usize> {
    match node.len() {
        0 | 1 => None,
        n => Some(node.start + (n.next_power_of_two() >> 1)),
    }
}

/// The node of the tree over `0..slices` that splits into `node` and another one, and that other; `None` for the root.
fn parent(slices: usize, node: &Node) -> Option<(Node, Node)> {
    let mut above = 0..slices;
    loop {
        let middle = split(&above)?;
        let (left, right) = (above.start..middle, middle..above.end);
        let (into, other) = if node.start < middle { (left, right) } else { (right, left) };
        if into == *node {
            return Some((above, other));
        }
        above = into;
    }
}

/// The sums that one member has of a step: of disjoint nodes, in order.
#[derive(Debug, Default)]
pub(crate) struct Sums {
    slices: usize,
    /// Number of values from which they are added at once.
    large: usize,
    nodes: Vec<(Node, Vec<f32>)>,
}

impl Sums {
    pub(crate) fn new(slices: usize, large: usize) -> Self {
        Self { slices, large, nodes: Vec::new() }
    }

    /// The slices of `share` that no sum contains, once the sums that reach beyond it are dropped.
    pub(crate) fn missing(&mut self, share: &Range<usize>) -> Vec<usize> {
        self.nodes.retain(|(node, _)| share.start <= node.start && node.end <= share.end);
        share.clone().filter(|slice| !self.nodes.iter().any(|(node, _)| node.contains(slice))).collect()
    }

    /// Takes the values of a slice. Large ones are added to those of the node's other part as soon as both are there.
    pub(crate) fn insert(&mut self, slice: usize, values: Vec<f32>) {
        let at = self.nodes.partition_point(|(node, _)| node.start < slice);
        let is_large = values.len() >= self.large;
        self.nodes.insert(at, (slice..slice + 1, values));
        if is_large {
            self.fold(at);
        }
    }

    /// Adds the sum at `at` to the sum of the node's other part, if that is there, and repeats this one node higher.
    fn fold(&mut self, mut at: usize) {
        while let Some((above, other)) = parent(self.slices, &self.nodes[at].0) {
            let left = if other.start < self.nodes[at].0.start { at.checked_sub(1) } else { Some(at) };
            let Some(left) = left.filter(|left| self.nodes.get(left + 1).is_some()) else { return };
            let (before, after) = (&self.nodes[left].0, &self.nodes[left + 1].0);
            if before.start != above.start || before.end != after.start || after.end != above.end {
                return;
            }
            let (_, right) = self.nodes.remove(left + 1);
            let (node, sum) = &mut self.nodes[left];
            assert_eq!(sum.len(), right.len(), "slices give vectors of one length");
            sum.iter_mut().zip(&right).for_each(|(a, b)| *a += b);
            recycle(right);
            *node = above;
            at = left;
        }
    }

    /// The sums for an exchange, which may take them.
    pub(crate) fn parts(&mut self) -> &mut [(Node, Vec<f32>)] {
        &mut self.nodes
    }

    pub(crate) fn clear(&mut self) {
        self.nodes.drain(..).for_each(|(_, values)| recycle(values));
    }
}

/// The sum over `0..slices` of disjoint nodes that cover it, along the tree.
///
/// # Panics
/// If nodes are missing, or if their values have different lengths.
pub fn tree_sum(slices: usize, nodes: impl IntoIterator<Item = (Node, Vec<f32>)>) -> Vec<f32> {
    let mut sums = Sums::new(slices, 0);
    for (node, values) in nodes {
        let at = sums.nodes.partition_point(|(other, _)| other.start < node.start);
        sums.nodes.insert(at, (node, values));
        sums.fold(at);
    }
    match &mut sums.nodes[..] {
        [(node, sum)] if *node == (0..slices) => std::mem::take(sum),
        nodes => panic!("{} sums of {slices} slices do not cover them", nodes.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum by the definition of the tree.
    fn plain(node: Node, leaf: &dyn Fn(usize) -> f32) -> f32 {
        match split(&node) {
            None => leaf(node.start),
            Some(middle) => plain(node.start..middle, leaf) + plain(middle..node.end, leaf),
        }
    }

    fn leaf(slice: usize) -> f32 {
        0.1 + slice as f32 * 1e7 / 3.0
    }

    #[test]
    fn any_order_of_leaves_gives_the_bits_of_the_definition() {
        for slices in 1..20 {
            for stride in 1..slices + 1 {
                let order = (0..stride).flat_map(|first| (first..slices).step_by(stride));
                let sum = tree_sum(slices, order.map(|slice| (slice..slice + 1, vec![leaf(slice), 1.0])));
                assert_eq!(sum, [plain(0..slices, &leaf), slices as f32], "{slices} by {stride}");
            }
        }
    }

    #[test]
    fn large_values_are_added_as_they_come_and_small_ones_are_kept() {
        let nodes = |sums: &Sums| sums.nodes.iter().map(|(node, _)| node.clone()).collect::<Vec<_>>();
        let mut sums = Sums::new(7, 8);
        let mut most = 0;
        for slice in 0..6 {
            sums.insert(slice, vec![leaf(slice); 8]);
            most = most.max(sums.nodes.len());
        }
        assert_eq!((nodes(&sums), most), (vec![0..4, 4..6], 2));
        assert_eq!(sums.nodes[1].1[7], leaf(4) + leaf(5));
        // A node that reaches beyond a smaller share is computed again, a larger share keeps all.
        assert_eq!(sums.missing(&(0..7)), [6]);
        assert_eq!(sums.missing(&(2..6)), [2, 3]);
        assert_eq!(nodes(&sums), vec![4..6; 1]);

        let mut sums = Sums::new(7, 8);
        (0..4).for_each(|slice| sums.insert(slice, vec![leaf(slice)]));
        assert_eq!(sums.missing(&(1..5)), [4]);
        assert_eq!(nodes(&sums), [1..2, 2..3, 3..4]);
    }
}
