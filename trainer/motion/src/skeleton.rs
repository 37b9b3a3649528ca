//! The two skeletons and the numbers that depend on them.
//!
//! Source: the public HumanML3D and KIT-ML feature definitions (joint order, chains, raw bone directions, contact
//! thresholds). The bone lengths are those of HumanML3D's uniform skeleton, rounded to 10 micrometres. The lengths of
//! KIT-ML's uniform skeleton (clip `03950`) are not public, so a caller that extracts KIT features supplies them.

use protocol::stage::DataFormat;

/// Properties of a body that the feature definition uses.
#[derive(Debug, Clone, PartialEq)]
pub struct Skeleton {
    /// The data format it belongs to.
    pub format: DataFormat,
    /// Number of joints J.
    pub joints: usize,
    /// D, the width of a feature row: `4 + 9 (J - 1) + 3 J + 4`.
    pub features: usize,
    /// Frames per second.
    pub fps: f64,
    /// Metres in one unit of the data, the only definition for losses, metrics and drawings. HumanML3D is in metres.
    /// KIT-ML's unit is not published. MLD's code divides by 0.75/480 m, with which its mean root is .87 m high. Others
    /// assume a millimetre, so that their values in mm are smaller by 1.5625.
    pub metres_per_unit: f64,
    /// Clips with fewer feature frames are not used.
    pub min_frames: usize,
    /// Clips with this many feature frames or more are not used.
    pub max_frames: usize,
    /// Lengths of examples are multiples of this.
    pub unit: usize,
    /// Names of the joints in order.
    pub names: &'static [&'static str],
    /// Kinematic chains. Each starts from the root's heading, for any first joint.
    pub chains: &'static [&'static [usize]],
    /// Parent of each joint; the root is its own.
    pub parents: &'static [usize],
    /// Direction of the bone that ends in each joint, without rotation.
    pub directions: &'static [[f64; 3]],
    /// Right hip, left hip, right shoulder, left shoulder: the joints that define the facing direction.
    pub face: [usize; 4],
    /// The two joints of the foot that the feature row lists first.
    pub left_foot: [usize; 2],
    /// The two joints of the foot that the feature row lists last.
    pub right_foot: [usize; 2],
    /// The two bones whose lengths define a body's size: thigh and shank.
    pub legs: [usize; 2],
    /// Squared displacement per frame below which a foot joint is in contact, in squared units.
    pub contact_threshold: f64,
    /// Pairs of joints that mirroring swaps.
    pub mirror: &'static [(usize, usize)],
    /// Joints of the left side of the body.
    pub left: &'static [usize],
    /// Joints of the right side of the body.
    pub right: &'static [usize],
    /// Bone length by its end joint, if the uniform skeleton is public.
    pub bone_lengths: Option<&'static [f64]>,
}

/// Range of each feature group in a row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// Half the yaw increment, radians per frame.
    pub yaw: std::ops::Range<usize>,
    /// Root displacement along x and z in the heading frame.
    pub root_velocity: std::ops::Range<usize>,
    pub root_height: std::ops::Range<usize>,
    /// Positions of joints 1..J in the heading frame.
    pub positions: std::ops::Range<usize>,
    /// 6D rotations of joints 1..J.
    pub rotations: std::ops::Range<usize>,
    /// Displacements of joints 0..J in the heading frame.
    pub velocities: std::ops::Range<usize>,
    /// Four foot contacts.
    pub contacts: std::ops::Range<usize>,
}

impl Layout {
    /// The groups in order; a training `Std` is constant inside each.
    pub fn groups(&self) -> [std::ops::Range<usize>; 7] {
        [
            self.yaw.clone(),
            self.root_velocity.clone(),
            self.root_height.clone(),
            self.positions.clone(),
            self.rotations.clone(),
            self.velocities.clone(),
            self.contacts.clone(),
        ]
    }
}

impl Skeleton {
    /// The skeleton of a data format.
    pub fn of(format: DataFormat) -> &'static Skeleton {
        match format {
            DataFormat::Humanml3d => &HUMANML3D,
            DataFormat::Kit => &KIT,
        }
    }

    /// Range of each feature group in a row.
    pub fn layout(&self) -> Layout {
        let positions = 4 + 3 * (self.joints - 1);
        let rotations = positions + 6 * (self.joints - 1);
        let velocities = rotations + 3 * self.joints;
        Layout {
            yaw: 0..1,
            root_velocity: 1..3,
            root_height: 3..4,
            positions: 4..positions,
            rotations: positions..rotations,
            velocities: rotations..velocities,
            contacts: velocities..velocities + 4,
        }
    }

    /// Bone lengths from a table of offsets `[J, 3]` (direction times length), the form in which target skeletons are
    /// published.
    pub fn lengths_of_offsets(&self, offsets: &[f32]) -> Vec<f64> {
        offsets.chunks_exact(3).map(|o| o.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt()).collect()
    }

    /// Bone lengths of a pose `[J, 3]`; the root's is 0.
    pub fn lengths_of_pose(&self, pose: &[f64]) -> Vec<f64> {
        (0..self.joints)
            .map(|j| {
                let p = self.parents[j];
                (0..3).map(|k| (pose[3 * j + k] - pose[3 * p + k]).powi(2)).sum::<f64>().sqrt()
            })
            .collect()
    }
}

const O: [f64; 3] = [0.0, 0.0, 0.0];
const XP: [f64; 3] = [1.0, 0.0, 0.0];
const XN: [f64; 3] = [-1.0, 0.0, 0.0];
const YP: [f64; 3] = [0.0, 1.0, 0.0];
const YN: [f64; 3] = [0.0, -1.0, 0.0];
const ZP: [f64; 3] = [0.0, 0.0, 1.0];

static HUMANML3D: Skeleton = Skeleton {
    format: DataFormat::Humanml3d,
    joints: 22,
    features: 263,
    fps: 20.0,
    metres_per_unit: 1.0,
    min_frames: 40,
    max_frames: 200,
    unit: 4,
    names: DataFormat::Humanml3d.joints(),
    chains: &[&[0, 2, 5, 8, 11], &[0, 1, 4, 7, 10], &[0, 3, 6, 9, 12, 15], &[9, 14, 17, 19, 21], &[9, 13, 16, 18, 20]],
    parents: &[0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19],
    directions: &[O, XP, XN, YP, YN, YN, YP, YN, YN, YP, ZP, ZP, YP, XP, XN, ZP, YN, YN, YN, YN, YN, YN],
    face: [2, 1, 17, 16],
    left_foot: [7, 10],
    right_foot: [8, 11],
    legs: [5, 8],
    contact_threshold: 0.002,
    mirror: &[(1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21)],
    left: &[1, 4, 7, 10, 13, 16, 18, 20],
    right: &[2, 5, 8, 11, 14, 17, 19, 21],
    bone_lengths: Some(&[
        0.0, 0.10307, 0.10988, 0.13157, 0.39362, 0.39019, 0.14319, 0.43243, 0.42564, 0.05736, 0.14338, 0.14942,
        0.21936, 0.13749, 0.14338, 0.10304, 0.13161, 0.12298, 0.25684, 0.26309, 0.26601, 0.26988,
    ]),
};

// KIT's joint names and the feature definition disagree on the "left" joints. The feature code uses 11 as right hip and
// 5 as right shoulder and lists [19, 20] as the left foot. The published mean pose shows the same on a right-handed
// body, so it is used here too.
static KIT: Skeleton = Skeleton {
    format: DataFormat::Kit,
    joints: 21,
    features: 251,
    fps: 12.5,
    metres_per_unit: 0.001_562_5,
    min_frames: 24,
    max_frames: 200,
    unit: 4,
    names: DataFormat::Kit.joints(),
    chains: &[&[0, 11, 12, 13, 14, 15], &[0, 16, 17, 18, 19, 20], &[0, 1, 2, 3, 4], &[3, 5, 6, 7], &[3, 8, 9, 10]],
    parents: &[0, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19],
    directions: &[O, YP, YP, YP, YP, XP, YN, YN, XN, YN, YN, XP, YN, YN, ZP, ZP, XN, YN, YN, ZP, ZP],
    face: [11, 16, 5, 8],
    left_foot: [19, 20],
    right_foot: [14, 15],
    legs: [17, 18],
    contact_threshold: 0.05,
    mirror: &[(5, 8), (6, 9), (7, 10), (11, 16), (12, 17), (13, 18), (14, 19), (15, 20)],
    left: &[8, 9, 10, 16, 17, 18, 19, 20],
    right: &[5, 6, 7, 11, 12, 13, 14, 15],
    bone_lengths: None,
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_agree_with_each_other() {
        for skeleton in [&HUMANML3D, &KIT] {
            assert_eq!(skeleton.names.len(), skeleton.joints);
            assert_eq!(skeleton.directions.len(), skeleton.joints);
            assert_eq!(skeleton.layout().contacts.end, skeleton.features);
            let mut parents = vec![0; skeleton.joints];
            for chain in skeleton.chains {
                for bone in chain.windows(2) {
                    parents[bone[1]] = bone[0];
                }
            }
            assert_eq!(parents, skeleton.parents);
            assert!(skeleton.bone_lengths.is_none_or(|l| l.len() == skeleton.joints));
        }
    }
}
