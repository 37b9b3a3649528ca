//! Proposes a joint map for a file: a built-in one with the file's names, else one by the skeleton's shape.
//!
//! By shape, the pelvis is the first node with three long branches. The two branches with the most similar bones are
//! the legs. The other leads to the chest, the next node with three branches; its two most similar ones are the arms. A
//! leg is hip, knee, ankle, foot; an arm is collar, shoulder, elbow, wrist. Left is the direction up x forward in frame
//! 0, with feet in front of ankles. Nodes at their parent's position are skipped.

use std::collections::BTreeMap;
use std::path::Path;

use motion::quaternion::{self as quat, Vec3};

use super::{Along, JointMap, MapError, Proposal, SHIPPED, Source};
use crate::bvh::Bvh;

impl JointMap {
    /// Proposes a map for a file: a built-in one by names, else one by the skeleton's shape.
    ///
    /// # Errors
    /// The skeleton does not have the shape of a figure either.
    pub fn propose(bvh: &Bvh) -> Result<Proposal, MapError> {
        for (name, text) in SHIPPED {
            let map = Self::parse(Path::new(name), text)?;
            if let Ok(map) = map.renamed(bvh) {
                return Ok(Proposal { map, shipped: Some(name) });
            }
        }
        let map = by_shape(bvh).map_err(|what| MapError::None { what })?;
        Ok(Proposal { map, shipped: None })
    }
}

struct Shape<'a> {
    bvh: &'a Bvh,
    /// Positions in frame 0.
    at: Vec<Vec3>,
    children: Vec<Vec<usize>>,
    /// Length of the longest path down in nodes, itself included, without those at their parent's position.
    depth: Vec<usize>,
}

fn by_shape(bvh: &Bvh) -> Result<JointMap, String> {
    let shape = Shape::new(bvh);
    let pelvis = shape.fork(0, 4).ok_or("no node has two legs and a spine")?;
    let (legs, rest) = shape.pair(pelvis, 4).ok_or("no two legs have four joints each")?;
    let chest = rest.into_iter().find_map(|branch| shape.fork(branch, 2)).ok_or("no node has two arms and a neck")?;
    let (arms, rest) = shape.pair(chest, 3).ok_or("no two arms have three joints each")?;
    let neck = *rest.first().ok_or("no neck between the arms")?;

    let legs = legs.map(|branch| shape.chain(branch));
    let ahead = legs.iter().fold([0.0; 3], |sum, leg| quat::add(sum, quat::sub(shape.at[leg[3]], shape.at[leg[2]])));
    let up = legs.iter().fold([0.0; 3], |sum, leg| quat::add(sum, quat::sub(shape.at[chest], shape.at[leg[2]])));
    let left = quat::cross(up, ahead);
    let is_left = |a: usize, b: usize| quat::dot(quat::sub(shape.at[a], shape.at[b]), left) > 0.0;
    let legs = if is_left(legs[0][0], legs[1][0]) { legs } else { [legs[1].clone(), legs[0].clone()] };
    let arms = arms.map(|branch| shape.chain(branch));
    let arms = if is_left(arms[0][1], arms[1][1]) { arms } else { [arms[1].clone(), arms[0].clone()] };

    let name = |i: usize| bvh.nodes[i].name.clone();
    let along = |from: usize, towards: usize, fraction| {
        Source::Along(Along { from: name(from), towards: name(towards), fraction })
    };
    let mut joints = BTreeMap::new();
    let mut put = |joint: &str, source: Source| joints.insert(joint.to_owned(), source);
    put("pelvis", Source::Node(name(pelvis)));
    for (side, (leg, arm)) in ["left", "right"].iter().zip(legs.iter().zip(&arms)) {
        for (joint, node) in ["hip", "knee", "ankle", "foot"].iter().zip(leg) {
            put(&format!("{side}_{joint}"), Source::Node(name(*node)));
        }
        let without_collar = shape.bones(arm[0]) < 4;
        let arm_names = if without_collar {
            &["shoulder", "elbow", "wrist"][..]
        } else {
            &["collar", "shoulder", "elbow", "wrist"]
        };
        for (joint, node) in arm_names.iter().zip(arm) {
            put(&format!("{side}_{joint}"), Source::Node(name(*node)));
        }
        if without_collar {
            put(&format!("{side}_collar"), along(chest, arm[0], 0.5));
        }
    }
    let spine = shape.way(pelvis, chest);
    let [first, middle, last] = match spine[..] {
        [] => return Err("no spine between legs and arms".into()),
        [one] => [along(pelvis, one, 1.0 / 3.0), along(pelvis, one, 2.0 / 3.0), Source::Node(name(one))],
        [one, two] => [Source::Node(name(one)), Source::Node(name(two)), along(two, neck, 0.25)],
        _ => [spine[0], spine[spine.len() / 2], chest].map(|i| Source::Node(name(i))),
    };
    put("spine1", first);
    put("spine2", middle);
    put("spine3", last);
    let neck = shape.chain(neck);
    put("neck", Source::Node(name(neck[0])));
    put("head", Source::Node(name(*neck.get(1).unwrap_or(&neck[0]))));
    Ok(JointMap { name: "by shape".into(), joints })
}

impl<'a> Shape<'a> {
    fn new(bvh: &'a Bvh) -> Self {
        let count = bvh.nodes.len();
        let mut at: Vec<Vec3> = vec![];
        let mut turned = vec![];
        for (node, (offset, rotation)) in bvh.nodes.iter().zip(bvh.pose(0)) {
            let (origin, outer) = node.parent.map_or(([0.0; 3], quat::IDENTITY), |parent| (at[parent], turned[parent]));
            at.push(quat::add(origin, quat::rotate(outer, offset)));
            turned.push(quat::mul(outer, rotation));
        }
        let mut children = vec![vec![]; count];
        let mut depth = vec![0; count];
        for i in (0..count).rev() {
            let below = children[i].iter().map(|child: &usize| depth[*child]).max().unwrap_or(0);
            let parent = bvh.nodes[i].parent;
            let own = parent.is_none_or(|parent| quat::norm(quat::sub(at[i], at[parent])) > 0.0);
            depth[i] = below + usize::from(own && !bvh.nodes[i].end);
            if let Some(parent) = parent {
                children[parent].insert(0, i);
            }
        }
        Self { bvh, at, children, depth }
    }

    /// Branches of a node; helper nodes at its position are skipped.
    fn branches(&self, node: usize) -> Vec<usize> {
        let mut found = vec![];
        let mut next: Vec<usize> = self.children[node].iter().rev().copied().collect();
        while let Some(child) = next.pop() {
            if quat::norm(quat::sub(self.at[child], self.at[node])) > 0.0 {
                found.push(child);
            } else {
                next.extend(self.children[child].iter().rev());
            }
        }
        found
    }

    fn long(&self, node: usize, least: usize) -> Vec<usize> {
        self.branches(node).into_iter().filter(|child| self.depth[*child] >= least).collect()
    }

    /// The first node from `node` downwards with three branches, two of them with `least` joints.
    fn fork(&self, node: usize, least: usize) -> Option<usize> {
        let mut node = node;
        loop {
            if self.branches(node).len() >= 3
                && self.long(node, least.min(3)).len() >= 2
                && self.pair(node, least.min(3)).is_some()
            {
                return Some(node);
            }
            node = self.branches(node).into_iter().max_by_key(|child| self.depth[*child])?;
        }
    }

    /// The two branches with `least` joints and the most similar bones, and the other branches, longest first.
    fn pair(&self, node: usize, least: usize) -> Option<([usize; 2], Vec<usize>)> {
        let long = self.long(node, least);
        let mut best: Option<(f64, [usize; 2])> = None;
        for (i, a) in long.iter().enumerate() {
            for b in &long[i + 1..] {
                let lengths = |branch: usize| -> Vec<f64> {
                    let chain = self.chain(branch);
                    let before = std::iter::once(&node).chain(&chain);
                    chain
                        .iter()
                        .zip(before)
                        .take(least)
                        .map(|(c, p)| quat::norm(quat::sub(self.at[*c], self.at[*p])))
                        .collect()
                };
                let one = lengths(*a);
                let two = lengths(*b);
                let apart = one.iter().zip(&two).map(|(a, b)| (a - b).abs()).sum::<f64>()
                    / (one.iter().sum::<f64>() + two.iter().sum::<f64>());
                if best.is_none_or(|(least, _)| apart < least) {
                    best = Some((apart, [*a, *b]));
                }
            }
        }
        let (apart, pair) = best?;
        let mut rest = self.branches(node);
        rest.retain(|branch| !pair.contains(branch));
        rest.sort_by_key(|branch| std::cmp::Reverse(self.depth[*branch]));
        (apart < 0.05).then_some((pair, rest))
    }

    /// The longest path from the top of a branch down, with the end site if it is the only continuation.
    fn chain(&self, branch: usize) -> Vec<usize> {
        let mut chain = vec![branch];
        let mut node = branch;
        while let Some(next) = self.branches(node).into_iter().max_by_key(|child| self.depth[*child]) {
            chain.push(next);
            node = next;
        }
        chain
    }

    /// Number of joints in the chain of a branch up to its fork.
    fn bones(&self, branch: usize) -> usize {
        let mut count = 1;
        let mut node = branch;
        while let [next] = self.branches(node)[..] {
            if self.bvh.nodes[next].end {
                break;
            }
            count += 1;
            node = next;
        }
        count
    }

    /// Nodes on the path below `from` down to `to`.
    fn way(&self, from: usize, to: usize) -> Vec<usize> {
        let mut way = vec![];
        let mut node = Some(to);
        while let Some(i) = node.filter(|i| *i != from) {
            let parent = self.bvh.nodes[i].parent;
            if parent.is_some_and(|parent| quat::norm(quat::sub(self.at[i], self.at[parent])) > 0.0) {
                way.push(i);
            }
            node = parent;
        }
        way.reverse();
        way
    }
}
