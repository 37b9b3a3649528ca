//! Measures of a motion that need no other motion: skating, jerk, penetration of the floor, and bones that change their
//! lengths. Beside the same of real motion they show if a motion looks right.
//!
//! Sources: skating as in [`super::skating`], jerk as in [`super::jerk`]. Penetration as in PhysDiff (Yuan et al.,
//! arXiv:2212.02500): the depth of the lowest point below the floor, a mean over frames. Departs: joints where the paper
//! has the vertices of a body, so no depth is counted for flesh. The change of bones is ours.

use motion::Skeleton;
use motion::features::recover_joints;
use protocol::stage::PHYSICS;

use super::{jerk, skating};

const AXES: usize = 3;
const MILLIMETRES: f64 = 1000.0;

/// Measures of one motion, in the order of [`PHYSICS`]: the share of steps in which a foot skates; the mean jerk of feet
/// and wrists in m/s^3; the depth of the lowest joint below the floor in millimetres, a mean over frames; the standard
/// deviation of a bone's length over frames in millimetres, a mean over bones.
pub fn physics(metres: &[f64], skeleton: &Skeleton) -> [f64; PHYSICS.len()] {
    let Skeleton { joints: count, format, fps, .. } = *skeleton;
    let jerks = jerk::jerk(metres, count, jerk::joints_of(format), fps);
    [
        skating::ratio(metres, count, skating::feet(format), fps),
        mean(&jerks),
        MILLIMETRES * mean(&depths(metres, count)),
        MILLIMETRES * mean(&changes(metres, skeleton)),
    ]
}

/// The same of features in the data's own scale, `[L, D]`.
pub fn physics_of_features(features: &[f32], skeleton: &Skeleton) -> [f64; PHYSICS.len()] {
    let joints = recover_joints(features, skeleton);
    let metres: Vec<f64> = joints.iter().map(|value| f64::from(*value) * skeleton.metres_per_unit).collect();
    physics(&metres, skeleton)
}

/// Means over motions, by name; `rows` are the measures of one motion after the other.
pub fn mean_physics(rows: &[f64]) -> impl Iterator<Item = (String, f64)> + '_ {
    let motions = rows.len() / PHYSICS.len();
    PHYSICS.iter().enumerate().map(move |(i, name)| {
        let sum: f64 = rows.iter().skip(i).step_by(PHYSICS.len()).sum();
        ((*name).to_owned(), sum / motions as f64)
    })
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Depth of the lowest joint below the floor, by frame.
fn depths(metres: &[f64], count: usize) -> Vec<f64> {
    let lowest = |pose: &[f64]| pose.chunks_exact(AXES).map(|joint| joint[1]).fold(f64::INFINITY, f64::min);
    metres.chunks_exact(count * AXES).map(|pose| (-lowest(pose)).max(0.0)).collect()
}

/// The standard deviation of each bone's length over frames.
fn changes(metres: &[f64], skeleton: &Skeleton) -> Vec<f64> {
    let poses = || metres.chunks_exact(skeleton.joints * AXES);
    let of_bone = |(joint, parent): (usize, &usize)| {
        let length = |pose: &[f64]| {
            (0..AXES).map(|axis| (pose[joint * AXES + axis] - pose[parent * AXES + axis]).powi(2)).sum::<f64>().sqrt()
        };
        let lengths: Vec<f64> = poses().map(length).collect();
        let middle = mean(&lengths);
        mean(&lengths.iter().map(|length| (length - middle).powi(2)).collect::<Vec<_>>()).sqrt()
    };
    skeleton.parents.iter().enumerate().skip(1).map(of_bone).collect()
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;

    use super::*;

    #[test]
    fn a_still_figure_has_none_and_each_fault_shows_in_its_own_measure() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let pose: Vec<f64> = (0..skeleton.joints).flat_map(|j| [0.1 * j as f64, 0.2, 0.0]).collect();
        let still: Vec<f64> = pose.iter().copied().cycle().take(8 * pose.len()).collect();
        assert!(physics(&still, skeleton).iter().all(|value| value.abs() < 1e-9));

        // Lower by .3 m in two of eight frames: 10 cm below the floor, no bone changes.
        let mut sunk = still.clone();
        sunk[2 * pose.len()..4 * pose.len()].chunks_exact_mut(AXES).for_each(|joint| joint[1] -= 0.3);
        let [_, jerk, penetration, bones] = physics(&sunk, skeleton);
        assert!((penetration - 25.0).abs() < 1e-9 && bones.abs() < 1e-9 && jerk > 0.0, "{penetration} {bones} {jerk}");

        // The last joint is 2 cm farther from its parent in every other frame: 1 cm in one of 21 bones.
        let mut stretched = still;
        let joint = skeleton.joints - 1;
        let parent = skeleton.parents[joint];
        let away = (0.1 * (joint as f64 - parent as f64)).signum();
        stretched.chunks_exact_mut(pose.len()).step_by(2).for_each(|pose| pose[joint * AXES] += 0.02 * away);
        let [skating, _, penetration, bones] = physics(&stretched, skeleton);
        assert!((bones - 10.0 / 21.0).abs() < 1e-9, "{bones}");
        assert!(skating.abs() < 1e-9 && penetration.abs() < 1e-9);
    }

    #[test]
    fn a_motion_of_one_frame_has_no_jerk_and_no_skating() {
        let skeleton = Skeleton::of(DataFormat::Kit);
        assert_eq!(physics(&vec![0.5; skeleton.joints * AXES], skeleton), [0.0; 4]);
    }
}
