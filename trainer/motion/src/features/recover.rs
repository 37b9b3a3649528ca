//! Conversion of feature rows back to joints.

use crate::quaternion::{self as quat, Quat, Vec3};
use crate::skeleton::Skeleton;

/// Heading and root position in each frame: the running sums of the root's turn and velocity.
///
/// The turn feature is half the yaw angle, so its sum is the angle of the quaternion itself. Turn and velocity of a row
/// lead to the next frame; those of the last row are not used.
pub fn root_path(features: &[f32], skeleton: &Skeleton) -> Vec<(Quat, Vec3)> {
    let mut angle = 0.0_f64;
    let mut x = 0.0;
    let mut z = 0.0;
    let mut before: Option<&[f32]> = None;
    let mut path = Vec::with_capacity(features.len() / skeleton.features);
    for row in features.chunks_exact(skeleton.features) {
        if let Some(before) = before {
            angle += f64::from(before[0]);
        }
        let (sin, cos) = angle.sin_cos();
        let heading = [cos, 0.0, sin, 0.0];
        if let Some(before) = before {
            let step = [f64::from(before[1]), 0.0, f64::from(before[2])];
            let step = quat::rotate(quat::inverse(heading), step);
            x += step[0];
            z += step[2];
        }
        path.push((heading, [x, f64::from(row[3]), z]));
        before = Some(row);
    }
    path
}

/// Global joints `[L, J, 3]` from the position features of rows `[L, D]`, which must not be normalised.
///
/// The root of frame 0 is above the origin. Rotations, velocities and contacts are not read.
pub fn recover_joints(features: &[f32], skeleton: &Skeleton) -> Vec<f32> {
    recover_joints_wide(features, skeleton).into_iter().map(|v| v as f32).collect()
}

/// Like [`recover_joints`] without rounding the result, for differences of neighbouring frames.
pub fn recover_joints_wide(features: &[f32], skeleton: &Skeleton) -> Vec<f64> {
    let mut joints = Vec::with_capacity(features.len() / skeleton.features * skeleton.joints * 3);
    for (row, (heading, root)) in features.chunks_exact(skeleton.features).zip(root_path(features, skeleton)) {
        joints.extend(root);
        let back = quat::inverse(heading);
        for local in row[skeleton.layout().positions].chunks_exact(3) {
            let at = quat::rotate(back, [local[0], local[1], local[2]].map(f64::from));
            joints.extend([at[0] + root[0], at[1], at[2] + root[2]]);
        }
    }
    joints
}

/// Recomputes the displacements of joints in rows `[L, D]`, which must not be normalised, from positions, turns and the
/// root's path. The last row has no next frame and is unchanged.
pub fn follow_path(features: &mut [f32], skeleton: &Skeleton) {
    let joints = recover_joints_wide(features, skeleton);
    let frames: Vec<&[f64]> = joints.chunks_exact(3 * skeleton.joints).collect();
    let path = root_path(features, skeleton);
    let velocities = skeleton.layout().velocities;
    for ((row, pair), (heading, _)) in features.chunks_exact_mut(skeleton.features).zip(frames.windows(2)).zip(path) {
        for (j, to) in row[velocities.clone()].chunks_exact_mut(3).enumerate() {
            let moved: Vec3 = std::array::from_fn(|axis| pair[1][3 * j + axis] - pair[0][3 * j + axis]);
            let moved = quat::rotate(heading, moved);
            to.iter_mut().zip(moved).for_each(|(to, value)| *to = value as f32);
        }
    }
}

/// Global joints `[L, J, 3]` from the rotation features of rows `[L, D]` and the bone lengths `[J]`.
pub fn recover_from_rotations(features: &[f32], skeleton: &Skeleton, lengths: &[f64]) -> Vec<f32> {
    let width = 3 * skeleton.joints;
    let mut joints = vec![0.0_f32; features.len() / skeleton.features * width];
    let rows = features.chunks_exact(skeleton.features).zip(root_path(features, skeleton));
    for ((row, (heading, root)), frame) in rows.zip(joints.chunks_exact_mut(width)) {
        let rotations = &row[skeleton.layout().rotations];
        let mut at = vec![root; skeleton.joints];
        for chain in skeleton.chains {
            let mut global = quat::to_matrix(heading);
            for bone in chain.windows(2) {
                let c = &rotations[6 * (bone[1] - 1)..6 * bone[1]];
                let local = quat::matrix_from_6d([c[0], c[1], c[2], c[3], c[4], c[5]].map(f64::from));
                global = quat::matmul(global, local);
                let offset = quat::scale(skeleton.directions[bone[1]], lengths[bone[1]]);
                at[bone[1]] = quat::add(at[bone[0]], quat::apply(global, offset));
            }
        }
        for (out, value) in frame.iter_mut().zip(at.iter().flatten()) {
            *out = *value as f32;
        }
    }
    joints
}

/// The left/right mirrored motion: x negated, left and right joints swapped. Joints `[T, J, 3]`.
pub fn mirror_joints(joints: &[f32], skeleton: &Skeleton) -> Vec<f32> {
    let mut mirrored = joints.to_vec();
    for frame in mirrored.chunks_exact_mut(3 * skeleton.joints) {
        frame.iter_mut().step_by(3).for_each(|x| *x = -*x);
        for (left, right) in skeleton.mirror {
            for k in 0..3 {
                frame.swap(3 * left + k, 3 * right + k);
            }
        }
    }
    mirrored
}
