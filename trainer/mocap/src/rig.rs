//! Conversion of joints to rotations of a rigid skeleton, and back.
//!
//! The features' rotations are not a pose of a skeleton: every chain starts again from the heading. Animation formats
//! need a tree in which a joint rotates everything attached to it. [`Rig::fit`] computes one: bone lengths are
//! constant, the root moves and all other joints rotate.
//!
//! A joint with one child points its bone at it by the shortest rotation from the rest pose, so limbs have no twist of
//! their own: joints do not show any. A joint with several children (pelvis, chest) uses the frame of them: x from the
//! right child to the left one, y as near as possible to the middle one. If these children do not keep their places in
//! that frame (a generated figure's hips are not rigid), the child gets a *pivot*. This is a node of zero length
//! between both, which rotates that one bone. With pivots every motion of constant bone lengths is reproduced up to
//! rounding; a pivot is added only if needed. It is named after its child, `left_collar_pivot`.
//!
//! Changing bone lengths are replaced by their means over time, and joints are placed by directions and mean lengths:
//! [`Rig::error`] is the resulting distance.
//!
//! The rest pose is a T-pose facing +z, left at +x; the children of pelvis and chest rest at their average places.

use motion::Skeleton;
use motion::quaternion::{self as quat, Quat, Vec3};

use crate::bvh::{self, Bvh, Channel};

/// Largest displacement of a child, in metres, that needs no pivot.
const RIGID_METRES: f64 = 1e-4;
/// Length of the bone drawn at the end of a limb, as a share of the bone before it.
const END: f64 = 0.5;

/// The joints are not a motion of a skeleton.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RigError {
    /// The array is not a whole number of frames, or empty.
    #[error("has {values} joint coordinates; expected frames of {joints} joints x 3")]
    Shape {
        /// Number of values in the array.
        values: usize,
        /// Number of joints J.
        joints: usize,
    },
    /// NaN or infinity among the joints.
    #[error("joint {joint} of frame {frame} is not finite")]
    NotFinite { frame: usize, joint: usize },
}

/// A joint of the tree, or a pivot.
#[derive(Debug, Clone, PartialEq)]
pub struct RigNode {
    /// Name of the joint in [`Skeleton::names`], or the child's name and `_pivot`.
    pub name: String,
    /// Index of the joint; `None` for a pivot.
    pub joint: Option<usize>,
    /// Index of a node before this one; `None` for the root.
    pub parent: Option<usize>,
    /// Offset from the parent in the rest pose, without rotation, in the joints' unit; zero for the root.
    pub offset: Vec3,
}

/// A motion as rotations of a rigid skeleton.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// Nodes, parents before children.
    pub nodes: Vec<RigNode>,
    /// Positions of the root, `[T]`.
    pub roots: Vec<Vec3>,
    /// Rotation of each node relative to its parent, `[T, nodes]`; the quaternion's sign is continuous over frames.
    pub local: Vec<Quat>,
    /// Largest distance of a joint from its given position, in the joints' unit.
    pub error: f64,
}

impl Rig {
    /// Fits a rig to joints `[T, J, 3]` of a skeleton, y up.
    ///
    /// # Errors
    /// If the shape does not match, or values are not finite.
    pub fn fit(joints: &[f32], skeleton: &Skeleton) -> Result<Self, RigError> {
        let width = 3 * skeleton.joints;
        if joints.is_empty() || !joints.len().is_multiple_of(width) {
            return Err(RigError::Shape { values: joints.len(), joints: skeleton.joints });
        }
        if let Some(at) = joints.iter().position(|v| !v.is_finite()) {
            return Err(RigError::NotFinite { frame: at / width, joint: at % width / 3 });
        }
        let frames: Vec<Vec<Vec3>> = joints
            .chunks_exact(width)
            .map(|frame| frame.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect())
            .collect();
        let mut rig = Fit::new(&frames, skeleton).rig();
        let placed = rig.joints(skeleton.joints);
        let given = joints.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(f64::from));
        rig.error = placed
            .chunks_exact(3)
            .zip(given)
            .map(|(p, q)| quat::norm(quat::sub([p[0], p[1], p[2]], q)))
            .fold(0.0, f64::max);
        Ok(rig)
    }

    /// Number of frames T.
    pub fn frames(&self) -> usize {
        self.roots.len()
    }

    /// Position and rotation of every node in the world, `[T, nodes]`.
    pub fn global(&self) -> Vec<(Vec3, Quat)> {
        let mut all: Vec<(Vec3, Quat)> = Vec::with_capacity(self.local.len());
        for (root, local) in self.roots.iter().zip(self.local.chunks_exact(self.nodes.len())) {
            let first = all.len();
            for (node, rotation) in self.nodes.iter().zip(local) {
                all.push(match node.parent {
                    None => (*root, *rotation),
                    Some(parent) => {
                        let (at, turned) = all[first + parent];
                        (quat::add(at, quat::rotate(turned, node.offset)), quat::mul(turned, *rotation))
                    }
                });
            }
        }
        all
    }

    /// Forward kinematics: `[T, joints, 3]`.
    pub fn joints(&self, joints: usize) -> Vec<f64> {
        let mut positions = vec![0.0; self.frames() * joints * 3];
        let global = self.global();
        for (frame, nodes) in positions.chunks_exact_mut(3 * joints).zip(global.chunks_exact(self.nodes.len())) {
            for (node, (at, _)) in self.nodes.iter().zip(nodes) {
                if let Some(joint) = node.joint {
                    frame[3 * joint..3 * joint + 3].copy_from_slice(at);
                }
            }
        }
        positions
    }

    /// Nodes without children, with the offset of a bone that may be drawn at their end.
    pub fn ends(&self) -> Vec<(usize, Vec3)> {
        let leaf = |i: &usize| self.nodes.iter().all(|node| node.parent != Some(*i));
        (0..self.nodes.len()).filter(leaf).map(|i| (i, quat::scale(self.nodes[i].offset, END))).collect()
    }

    /// Converts the motion to BVH with lengths multiplied by `units` (100 writes metres as centimetres) at `rate`
    /// frames per second. The root has positions; all other nodes have only rotations. A leaf has an end site of half
    /// its bone.
    pub fn to_bvh(&self, rate: f64, units: f64) -> Bvh {
        let order = self.depth_first();
        let ends = self.ends();
        let mut nodes: Vec<bvh::Node> = vec![];
        // Index of a node of ours in the file, which has end sites in between.
        let mut written = vec![0; self.nodes.len()];
        for i in &order {
            let node = &self.nodes[*i];
            written[*i] = nodes.len();
            let positions: &[Channel] = if node.parent.is_none() {
                &[Channel::Position(0), Channel::Position(1), Channel::Position(2)]
            } else {
                &[]
            };
            let channels = positions.iter().chain(&bvh::ROTATIONS).copied().collect();
            let parent = node.parent.map(|parent| written[parent]);
            nodes.push(bvh::Node {
                name: node.name.clone(),
                parent,
                offset: quat::scale(node.offset, units),
                channels,
                end: false,
            });
            if let Some((_, offset)) = ends.iter().find(|(end, _)| end == i) {
                let parent = Some(written[*i]);
                nodes.push(bvh::Node {
                    name: format!("{}_end", node.name),
                    parent,
                    offset: quat::scale(*offset, units),
                    channels: vec![],
                    end: true,
                });
            }
        }
        let mut before = vec![[0.0; 3]; self.nodes.len()];
        let mut values = Vec::with_capacity(self.frames() * (3 + 3 * self.nodes.len()));
        for (root, local) in self.roots.iter().zip(self.local.chunks_exact(self.nodes.len())) {
            values.extend(quat::scale(*root, units));
            for i in &order {
                before[*i] = bvh::angles(local[*i], before[*i]);
                values.extend(before[*i]);
            }
        }
        Bvh { nodes, frame_time: 1.0 / rate, rate, frames: self.frames(), values }
    }

    /// The nodes in depth-first order, as of nested braces.
    fn depth_first(&self) -> Vec<usize> {
        let mut order = Vec::with_capacity(self.nodes.len());
        let mut next = vec![0];
        while let Some(i) = next.pop() {
            order.push(i);
            next.extend((0..self.nodes.len()).rev().filter(|child| self.nodes[*child].parent == Some(i)));
        }
        order
    }
}

/// Properties of a motion that a fit uses.
struct Fit<'a> {
    frames: &'a [Vec<Vec3>],
    skeleton: &'a Skeleton,
    children: Vec<Vec<usize>>,
    /// Offset of each joint from its parent in the rest pose, `[J]`.
    rest: Vec<Vec3>,
    /// Frames of joints with several children, `[T]` each; empty for others.
    bodies: Vec<Vec<Quat>>,
    /// True for a joint that is attached by a pivot.
    pivoted: Vec<bool>,
}

impl<'a> Fit<'a> {
    fn new(frames: &'a [Vec<Vec3>], skeleton: &'a Skeleton) -> Self {
        let mut children = vec![vec![]; skeleton.joints];
        for (joint, parent) in skeleton.parents.iter().enumerate().skip(1) {
            children[*parent].push(joint);
        }
        let mut rest: Vec<Vec3> = (0..skeleton.joints).map(|joint| rest_direction(skeleton, joint)).collect();
        let mut bodies = vec![vec![]; skeleton.joints];
        let mut pivoted = vec![false; skeleton.joints];
        for joint in 1..skeleton.joints {
            let parent = skeleton.parents[joint];
            let bone = |frame: &Vec<Vec3>| quat::sub(frame[joint], frame[parent]);
            let length = frames.iter().map(|frame| quat::norm(bone(frame))).sum::<f64>() / frames.len() as f64;
            if children[parent].len() > 1 {
                if bodies[parent].is_empty() {
                    bodies[parent] = body_frames(frames, skeleton, parent, &children[parent]);
                }
                let seen: Vec<Vec3> = frames
                    .iter()
                    .zip(&bodies[parent])
                    .map(|(frame, body)| quat::rotate(quat::inverse(*body), bone(frame)))
                    .collect();
                let mean = seen.iter().fold([0.0; 3], |sum, v| quat::add(sum, *v));
                if quat::norm(mean) > 1e-9 {
                    rest[joint] = quat::unit(mean);
                }
                let place = quat::scale(rest[joint], length);
                let threshold = RIGID_METRES / skeleton.metres_per_unit;
                pivoted[joint] = seen.iter().any(|v| off_direction(*v, place) > threshold);
            }
            rest[joint] = quat::scale(rest[joint], length);
        }
        Self { frames, skeleton, children, rest, bodies, pivoted }
    }

    fn rig(&self) -> Rig {
        let skeleton = self.skeleton;
        let mut nodes =
            vec![RigNode { name: skeleton.names[0].into(), joint: Some(0), parent: None, offset: [0.0; 3] }];
        let mut node_of = vec![0; skeleton.joints];
        // Every joint's parent has a smaller index, so one pass is enough.
        for joint in 1..skeleton.joints {
            let mut parent = node_of[skeleton.parents[joint]];
            if self.pivoted[joint] {
                nodes.push(RigNode {
                    name: format!("{}_pivot", skeleton.names[joint]),
                    joint: None,
                    parent: Some(parent),
                    offset: [0.0; 3],
                });
                parent = nodes.len() - 1;
            }
            node_of[joint] = nodes.len();
            nodes.push(RigNode {
                name: skeleton.names[joint].into(),
                joint: Some(joint),
                parent: Some(parent),
                offset: self.rest[joint],
            });
        }
        let count = nodes.len();
        let mut local = vec![quat::IDENTITY; self.frames.len() * count];
        let mut global = vec![quat::IDENTITY; count];
        for t in 0..self.frames.len() {
            for (i, node) in nodes.iter().enumerate() {
                let outer = node.parent.map_or(quat::IDENTITY, |parent| global[parent]);
                let before = if t == 0 { quat::IDENTITY } else { local[(t - 1) * count + i] };
                let rotation = self.rotation(t, &nodes, i, outer).unwrap_or(before);
                let flip = rotation.iter().zip(before).map(|(a, b)| a * b).sum::<f64>() < 0.0;
                let rotation = if flip { rotation.map(|v| -v) } else { rotation };
                local[t * count + i] = rotation;
                global[i] = quat::normalise(quat::mul(outer, rotation));
            }
        }
        let roots = self.frames.iter().map(|frame| frame[0]).collect();
        Rig { nodes, roots, local, error: 0.0 }
    }

    /// Rotation of a node relative to its parent's, `outer`. `None` if joints coincide, so that the previous rotation
    /// can be kept.
    fn rotation(&self, t: usize, nodes: &[RigNode], i: usize, outer: Quat) -> Option<Quat> {
        let towards = |joint: usize| {
            let bone = quat::sub(self.frames[t][joint], self.frames[t][self.skeleton.parents[joint]]);
            shortest(self.rest[joint], quat::rotate(quat::inverse(outer), bone))
        };
        let Some(joint) = nodes[i].joint else {
            return towards(nodes.get(i + 1)?.joint?);
        };
        match self.children[joint][..] {
            [] => Some(quat::IDENTITY),
            [child] => towards(child),
            _ => Some(quat::mul(quat::inverse(outer), self.bodies[joint][t])),
        }
    }
}

/// Distance of `v` from the direction of `place`, measured at its length.
fn off_direction(v: Vec3, place: Vec3) -> f64 {
    let lengths = quat::norm(v) * quat::norm(place);
    if lengths < 1e-18 { 0.0 } else { quat::norm(quat::sub(quat::scale(v, quat::norm(place) / quat::norm(v)), place)) }
}

/// Direction in a T-pose of the bone that ends in a joint.
fn rest_direction(skeleton: &Skeleton, joint: usize) -> Vec3 {
    let arm = skeleton.names[joint].contains("shoulder")
        || skeleton.names[joint].contains("elbow")
        || skeleton.names[joint].contains("wrist");
    let arm = arm || skeleton.names[joint].contains("collar");
    match (arm, skeleton.left.contains(&joint)) {
        (true, true) => [1.0, 0.0, 0.0],
        (true, false) => [-1.0, 0.0, 0.0],
        _ if skeleton.names[joint] == "head" => [0.0, 1.0, 0.0],
        _ => skeleton.directions[joint],
    }
}

/// The frame of a joint's children in each frame of the motion.
fn body_frames(frames: &[Vec<Vec3>], skeleton: &Skeleton, joint: usize, children: &[usize]) -> Vec<Quat> {
    let side = |side: &[usize]| children.iter().copied().find(|child| side.contains(child)).unwrap_or(joint);
    let left = side(skeleton.left);
    let right = side(skeleton.right);
    let middle = children.iter().copied().find(|child| *child != left && *child != right).unwrap_or(joint);
    let mut before = quat::IDENTITY;
    frames
        .iter()
        .map(|frame| {
            let across = quat::sub(frame[left], frame[right]);
            let forward = quat::cross(across, quat::sub(frame[middle], frame[joint]));
            if quat::norm(across) > 1e-9 && quat::norm(forward) > 1e-9 * quat::norm(across) {
                let x = quat::unit(across);
                let z = quat::unit(forward);
                before = from_columns(x, quat::cross(z, x), z);
            }
            before
        })
        .collect()
}

/// The rotation whose matrix has these orthonormal columns.
fn from_columns(x: Vec3, y: Vec3, z: Vec3) -> Quat {
    // The largest of the four components is computed first, so that no division is by a small number.
    let trace = x[0] + y[1] + z[2];
    let parts = [trace, x[0], y[1], z[2]];
    let largest = (1..4).fold(0, |best, i| if parts[i] > parts[best] { i } else { best });
    let q = match largest {
        0 => [1.0 + trace, y[2] - z[1], z[0] - x[2], x[1] - y[0]],
        1 => [y[2] - z[1], 1.0 + 2.0 * x[0] - trace, y[0] + x[1], z[0] + x[2]],
        2 => [z[0] - x[2], y[0] + x[1], 1.0 + 2.0 * y[1] - trace, z[1] + y[2]],
        _ => [x[1] - y[0], z[0] + x[2], z[1] + y[2], 1.0 + 2.0 * z[2] - trace],
    };
    quat::normalise(q)
}

/// The shortest rotation from the direction of `a` to that of `b`; for opposite directions a half turn about a
/// perpendicular axis. `None` if one of them has no length.
fn shortest(a: Vec3, b: Vec3) -> Option<Quat> {
    let la = quat::norm(a);
    let lb = quat::norm(b);
    if la < 1e-9 || lb < 1e-9 {
        return None;
    }
    let a = quat::scale(a, 1.0 / la);
    let b = quat::scale(b, 1.0 / lb);
    let half = quat::add(a, b);
    if quat::norm(half) < 1e-7 {
        let axis = if a[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let axis = quat::unit(quat::cross(a, axis));
        return Some([0.0, axis[0], axis[1], axis[2]]);
    }
    // Through the direction halfway: exact up to rounding also for angles near a half turn.
    let half = quat::unit(half);
    let axis = quat::cross(a, half);
    Some(quat::normalise([quat::dot(a, half), axis[0], axis[1], axis[2]]))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use motion::random::Stream;
    use protocol::Seed;
    use protocol::stage::DataFormat;

    use super::*;

    /// A figure whose bones keep their lengths and drift: rigid at pelvis and chest, or each bone separately.
    fn wander(skeleton: &Skeleton, frames: usize, rigid: bool, change: f64) -> Vec<f32> {
        let scale = 0.25 / skeleton.metres_per_unit;
        let mut joints = vec![];
        for t in 0..frames {
            let mut at = vec![[0.0; 3]; skeleton.joints];
            let mut turned = vec![quat::IDENTITY; skeleton.joints];
            at[0] = [0.1 * t as f64 * scale, 4.0 * scale, 0.0];
            for joint in 0..skeleton.joints {
                let parent = skeleton.parents[joint];
                let mut draw = Stream::new(Seed(3), "wander", 0, if rigid { parent } else { joint } as u64);
                let axis = quat::unit([draw.range(-1.0, 1.0), draw.range(-1.0, 1.0), draw.range(-1.0, 1.0)]);
                let angle = draw.range(0.4, 1.1) * (t as f64 * draw.range(0.02, 0.1) + draw.range(0.0, 6.0)).sin();
                turned[joint] = quat::mul(turned[parent], quat::about(axis, angle));
                if joint > 0 {
                    let length = scale * (1.0 + change * (t as f64 * 0.3).sin());
                    at[joint] = quat::add(
                        at[parent],
                        quat::rotate(turned[joint], quat::scale(rest_direction(skeleton, joint), length)),
                    );
                }
            }
            joints.extend(at.iter().flatten().map(|v| *v as f32));
        }
        joints
    }

    #[test]
    fn constant_bones_come_back_and_changing_ones_say_how_far_off() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let skeleton = Skeleton::of(format);
            for rigid in [true, false] {
                let joints = wander(skeleton, 60, rigid, 0.0);
                let rig = Rig::fit(&joints, skeleton).unwrap();
                let metres = rig.error * skeleton.metres_per_unit;
                let pivots = rig.nodes.iter().filter(|node| node.joint.is_none()).count();
                println!("{format:?}, rigid {rigid}: {metres:.1e} m, {pivots} pivots");
                assert!(metres < 1e-6, "{metres}");
                assert_eq!(pivots > 0, !rigid);
                // In centimetres, through the text form.
                let units = 100.0 * skeleton.metres_per_unit;
                let text = rig.to_bvh(skeleton.fps, units).to_text();
                let back = Bvh::parse(Path::new("x.bvh"), text.as_bytes()).unwrap();
                assert_eq!((back.frames, back.rate), (60, skeleton.fps));
                let at = |name: &str| back.nodes.iter().position(|node| node.name == name).unwrap();
                let columns: Vec<usize> = skeleton.names.iter().map(|name| at(name)).collect();
                let positions = back.positions();
                let mut worst = 0.0_f64;
                for (t, frame) in positions.chunks_exact(3 * back.nodes.len()).enumerate() {
                    for (j, column) in columns.iter().enumerate() {
                        for k in 0..3 {
                            let given = f64::from(joints[(t * skeleton.joints + j) * 3 + k]) * skeleton.metres_per_unit;
                            worst = worst.max((frame[3 * column + k] / 100.0 - given).abs());
                        }
                    }
                }
                println!("  through text: {worst:.1e} m");
                assert!(worst < 1e-5, "{worst}");
            }
            let changing = Rig::fit(&wander(skeleton, 60, false, 0.1), skeleton).unwrap();
            let metres = changing.error * skeleton.metres_per_unit;
            assert!((0.01..1.0).contains(&metres), "{metres}");
        }
    }

    #[test]
    fn what_is_no_motion_is_refused_and_a_point_is_survived() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        assert!(matches!(Rig::fit(&[], skeleton), Err(RigError::Shape { .. })));
        assert!(matches!(Rig::fit(&[0.0; 67], skeleton), Err(RigError::Shape { .. })));
        let mut joints = vec![0.0; 132];
        let rig = Rig::fit(&joints, skeleton).unwrap();
        assert!(rig.error == 0.0 && rig.local.iter().flatten().all(|v| v.is_finite()));
        joints[70] = f32::NAN;
        assert_eq!(Rig::fit(&joints, skeleton), Err(RigError::NotFinite { frame: 1, joint: 1 }));
    }

    #[test]
    fn opposite_directions_have_a_rotation() {
        for (a, b) in [
            ([0.0, 1.0, 0.0], [0.0, -2.0, 0.0]),
            ([1.0, 0.0, 0.0], [-1.0, 1e-9, 0.0]),
            ([0.3, 0.4, 0.5], [0.3, -0.4, 0.1]),
        ] {
            let turned = quat::rotate(shortest(a, b).unwrap(), quat::unit(a));
            assert!(quat::norm(quat::sub(turned, quat::unit(b))) < 1e-8, "{a:?} {b:?} {turned:?}");
        }
    }
}
