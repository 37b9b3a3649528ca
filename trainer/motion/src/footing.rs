//! Root paths on which standing feet do not slide.
//!
//! A feature row holds the motion of the root and that of the pose separately. In generated rows the two agree only
//! roughly, so feet slide. Here the root's displacement `v` of each step is a least-squares compromise between the
//! row's own, `v_0`, and that of each ankle and ball that touches the ground:
//! `min_v LOOSE |v - v_0|^2 + sum_f c_f^2 |v + u_f|^2`. `u_f` is the foot's displacement in a body that stays, and
//! `c_f` the row's own contact. The correction is smoothed over five steps, so that the root does not jerk when feet
//! change. Poses, turns, heights and contacts stay; the path gets the length that the feet walked. Steps without
//! contact, as in a jump, keep their path.
//!
//! Ours, in a closed form; in inertial capture contacts usually decide the root's path (Yi et al., TransPose, SIGGRAPH
//! 2021).

use crate::features;
use crate::quaternion::{self as quat, Vec3};
use crate::skeleton::Skeleton;

/// Weight of the row's own displacement, relative to a foot in certain contact.
const LOOSE: f64 = 0.1;
/// Weights that smooth corrections: a binomial filter with a deviation of one step.
const SMOOTH: [f64; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];

/// Corrects the root of `rows` `[L, D]`, which must not be normalised, by the standing feet. The last row has no next
/// frame and is unchanged.
pub fn hold(rows: &mut [f32], skeleton: &Skeleton) {
    let corrections = corrections(rows, skeleton);
    if corrections.iter().flatten().all(|v| *v == 0.0) {
        return;
    }
    let steps = corrections.len();
    let reach = SMOOTH.len() / 2;
    // The correction is constant beyond the ends.
    let smooth = |t: usize, axis: usize| -> f64 {
        let near = SMOOTH.iter().enumerate();
        near.map(|(k, weight)| weight * corrections[(t + k).saturating_sub(reach).min(steps - 1)][axis]).sum()
    };
    let way = skeleton.layout().root_velocity;
    for (t, row) in rows.chunks_exact_mut(skeleton.features).enumerate().take(steps) {
        for (axis, v) in row[way.clone()].iter_mut().enumerate() {
            *v = (f64::from(*v) + smooth(t, axis)) as f32;
        }
    }
    features::follow_path(rows, skeleton);
}

/// Correction of each step's displacement, in the heading frame of the next frame.
fn corrections(rows: &[f32], skeleton: &Skeleton) -> Vec<[f64; 2]> {
    let layout = skeleton.layout();
    let rows: Vec<&[f32]> = rows.chunks_exact(skeleton.features).collect();
    let feet: Vec<usize> = skeleton.left_foot.into_iter().chain(skeleton.right_foot).collect();
    let place = |row: &[f32], j: usize| -> Vec3 {
        let at = layout.positions.start + 3 * (j - 1);
        [row[at], 0.0, row[at + 2]].map(f64::from)
    };
    let step = |pair: &[&[f32]]| {
        let from = pair[0];
        let to = pair[1];
        // The turn feature is already the angle of the quaternion.
        let (sin, cos) = f64::from(from[layout.yaw.start]).sin_cos();
        let turn = [cos, 0.0, sin, 0.0];
        let said = [f64::from(from[layout.root_velocity.start]), f64::from(from[layout.root_velocity.start + 1])];
        let mut sum = [0.0; 2];
        let mut all = LOOSE;
        for (foot, contact) in feet.iter().zip(&from[layout.contacts.clone()]) {
            let weight = f64::from(contact.clamp(0.0, 1.0)).powi(2);
            let moved = quat::sub(place(to, *foot), quat::rotate(turn, place(from, *foot)));
            all += weight;
            sum[0] -= weight * (said[0] + moved[0]);
            sum[1] -= weight * (said[1] + moved[2]);
        }
        sum.map(|s| s / all)
    };
    rows.windows(2).map(step).collect()
}

#[cfg(test)]
mod tests {
    use protocol::Seed;
    use protocol::stage::{DataFormat, DataSynthetic};

    use super::*;
    use crate::synthetic;

    /// Mean horizontal speed of feet in contact with the ground, m/s.
    fn slides(rows: &[f32], skeleton: &Skeleton) -> f64 {
        let joints = features::recover_joints_wide(rows, skeleton);
        let frames: Vec<&[f64]> = joints.chunks_exact(3 * skeleton.joints).collect();
        let mut sum = 0.0;
        let mut count = 0.0;
        for (row, pair) in rows.chunks_exact(skeleton.features).zip(frames.windows(2)) {
            let feet = skeleton.left_foot.iter().chain(&skeleton.right_foot);
            for (j, contact) in feet.zip(&row[skeleton.layout().contacts]) {
                let moved = |axis: usize| pair[1][3 * j + axis] - pair[0][3 * j + axis];
                sum += f64::from(*contact) * moved(0).hypot(moved(2)) * skeleton.fps;
                count += f64::from(*contact);
            }
        }
        sum / f64::max(count, 1.0)
    }

    #[test]
    fn a_path_that_glides_is_held_by_the_feet() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let dataset = synthetic::generate(&DataSynthetic { clips: 12, ..DataSynthetic::default() }, Seed(5));
        for clip in &dataset.clips[..12] {
            let true_path = features::root_path(&clip.features, skeleton);
            let mut rows = clip.features.to_vec();
            for row in rows.chunks_exact_mut(skeleton.features) {
                row[1] += 0.02;
                row[2] -= 0.03;
            }
            let before = slides(&rows, skeleton);
            let poses: Vec<f32> = rows.chunks_exact(skeleton.features).flat_map(|row| row[3..193].to_vec()).collect();
            hold(&mut rows, skeleton);
            let after = slides(&rows, skeleton);
            assert!(after < 0.4 * before, "{before} to {after} m/s");
            let found = features::root_path(&rows, skeleton);
            let away = |t: usize| (found[t].1[0] - true_path[t].1[0]).hypot(found[t].1[2] - true_path[t].1[2]);
            let glided = found.len() as f64 * 0.02_f64.hypot(0.03);
            println!("{before:.3} to {after:.3} m/s, ends {:.3} of {glided:.3} m away", away(found.len() - 1));
            let kept = rows.chunks_exact(skeleton.features).flat_map(|row| row[3..193].to_vec());
            assert!(kept.eq(poses), "poses stay");
        }
    }

    #[test]
    fn what_touches_nothing_keeps_its_path() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let skeleton = Skeleton::of(format);
            let mut rows: Vec<f32> = (0..9 * skeleton.features).map(|i| (i as f32 * 0.7).sin() * 0.1).collect();
            let contacts = skeleton.layout().contacts;
            rows.chunks_exact_mut(skeleton.features).for_each(|row| row[contacts.clone()].fill(0.0));
            let before = features::root_path(&rows, skeleton);
            hold(&mut rows, skeleton);
            for (a, b) in before.iter().zip(features::root_path(&rows, skeleton)) {
                assert!((a.1[0] - b.1[0]).abs() < 1e-6 && (a.1[2] - b.1[2]).abs() < 1e-6);
            }
            for few in [0, 1] {
                let mut rows = vec![1.0; few * skeleton.features];
                hold(&mut rows, skeleton);
                assert_eq!(rows, vec![1.0; few * skeleton.features]);
            }
        }
    }
}
