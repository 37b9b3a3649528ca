//! A posable body: computes its joints from the positions of pelvis, spine, arms and feet.
//!
//! Legs are solved with two-bone inverse kinematics, and so are arms whose hand has a place in the world; the rest is
//! forward kinematics. Bone lengths are those of the uniform skeleton, so extraction does not change the body. Frame: y
//! up, metres, the body faces +z at yaw 0 and its left is +x.

use crate::quaternion::{self as quat, Quat, Vec3};
use crate::skeleton::Skeleton;

/// Height of the toe joint of a flat foot.
pub(super) const TOE: f64 = 0.02;

/// Directions of the bones of an upright body, for joints 1..22; the left side, mirrored for the right.
const UPRIGHT: [Vec3; 22] = [
    [0.0, 0.0, 0.0],
    [0.58, -0.80, -0.12],
    [-0.58, -0.80, -0.12],
    [0.0, 0.95, -0.30],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 0.98, 0.18],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 1.0, 0.05],
    [0.12, -0.42, 0.90],
    [-0.12, -0.42, 0.90],
    [0.0, 0.98, -0.14],
    [0.57, 0.80, -0.18],
    [-0.57, 0.80, -0.18],
    [0.0, 0.88, 0.45],
    [0.95, 0.24, -0.14],
    [-0.95, 0.24, -0.14],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
];

/// Directions of an arm's two bones in the frame of the chest, +x being outward on either side.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arm {
    pub(super) upper: Vec3,
    pub(super) fore: Vec3,
    /// A place in the world for the wrist, which replaces the directions.
    pub(super) reach: Option<Vec3>,
}

impl Arm {
    pub(super) fn new(upper: Vec3, fore: Vec3) -> Self {
        Self { upper: quat::unit(upper), fore: quat::unit(fore), reach: None }
    }

    /// An arm hanging beside the body, swung forward by `swing` radians, with the elbow bent by `bend`.
    pub(super) fn hanging(swing: f64, bend: f64) -> Self {
        let along = |angle: f64, out: f64| [out, -angle.cos(), angle.sin()];
        Self::new(along(swing, 0.16), along(swing + bend, 0.05))
    }

    /// Interpolates between this (0) and `other` (1).
    pub(super) fn toward(self, other: Self, share: f64) -> Self {
        let mix = |a: Vec3, b: Vec3| quat::add(quat::scale(a, 1.0 - share), quat::scale(b, share));
        Self::new(mix(self.upper, other.upper), mix(self.fore, other.fore))
    }
}

/// Position of a leg.
#[derive(Debug, Clone, Copy)]
pub(super) enum Leg {
    /// The toe joint of the flat foot would be at `toe`. The foot turns to `yaw` and tips by `pitch` (positive lifts
    /// the heel about the toe, negative the toe about the heel).
    Foot { toe: Vec3, yaw: f64, pitch: f64 },
    /// On the knee: the thigh points to `knee`, the shank along `shank`.
    Knee { knee: Vec3, shank: Vec3 },
}

impl Leg {
    /// Moves a foot by `by`.
    pub(super) fn moved(self, by: Vec3) -> Self {
        match self {
            Self::Foot { toe, yaw, pitch } => Self::Foot { toe: quat::add(toe, by), yaw, pitch },
            Self::Knee { knee, shank } => Self::Knee { knee: quat::add(knee, by), shank },
        }
    }

    /// Sets the pitch of a foot.
    pub(super) fn tipped(self, pitch: f64) -> Self {
        match self {
            Self::Foot { toe, yaw, .. } => Self::Foot { toe, yaw, pitch },
            knee @ Self::Knee { .. } => knee,
        }
    }
}

/// One frame of the body. Angles in radians; sides are `[left, right]`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub(super) pelvis: Vec3,
    pub(super) yaw: f64,
    /// Pitch of the pelvis, positive forward.
    pub(super) pitch: f64,
    /// Roll of the pelvis, positive raises the left hip.
    pub(super) roll: f64,
    /// Pitch of the chest against the pelvis, positive forward.
    pub(super) bend: f64,
    /// Turn of the chest against the pelvis, positive to the left.
    pub(super) twist: f64,
    /// Lean of the chest against the pelvis, positive to the left.
    pub(super) side: f64,
    /// Pitch of the head against the chest, positive forward.
    pub(super) nod: f64,
    pub(super) arms: [Arm; 2],
    pub(super) legs: [Leg; 2],
}

impl Pose {
    /// A standing body at the origin.
    pub(super) fn standing() -> Self {
        let leg = |side: f64| Leg::Foot { toe: [side * 0.11, TOE, 0.10], yaw: side * 0.12, pitch: 0.0 };
        Self {
            pelvis: [0.0, 0.970, 0.0],
            yaw: 0.0,
            pitch: 0.0,
            roll: 0.0,
            bend: 0.0,
            twist: 0.0,
            side: 0.0,
            nod: 0.0,
            arms: [Arm::hanging(0.0, 0.18); 2],
            legs: [leg(1.0), leg(-1.0)],
        }
    }
}

fn turn_x(angle: f64) -> Quat {
    quat::about([1.0, 0.0, 0.0], angle)
}

/// Rotation about the vertical.
pub(super) fn turn_y(angle: f64) -> Quat {
    quat::about([0.0, 1.0, 0.0], angle)
}

fn turn_z(angle: f64) -> Quat {
    quat::about([0.0, 0.0, 1.0], angle)
}

/// Middle joint and end of two bones from `from` toward `to`; the middle joint bends toward `pole`.
fn two_bones(from: Vec3, to: Vec3, lengths: [f64; 2], pole: Vec3) -> (Vec3, Vec3) {
    let [a, b] = lengths;
    let line = quat::sub(to, from);
    let distance = quat::norm(line).clamp((a - b).abs() + 0.02, 0.998 * (a + b));
    let along = quat::unit(line);
    let aside = quat::unit(quat::sub(pole, quat::scale(along, quat::dot(pole, along))));
    let cos = ((a * a + distance * distance - b * b) / (2.0 * a * distance)).clamp(-1.0, 1.0);
    let sin = (1.0 - cos * cos).sqrt();
    let middle = quat::add(from, quat::add(quat::scale(along, a * cos), quat::scale(aside, a * sin)));
    (middle, quat::add(from, quat::scale(along, distance)))
}

/// Joints `[22, 3]` of a pose. The pelvis is lowered if a standing foot would be out of the leg's reach.
pub(super) fn joints(pose: &Pose, skeleton: &Skeleton) -> [f64; 66] {
    let lengths = skeleton.bone_lengths.unwrap_or(&[]);
    let bone = |j: usize| quat::scale(quat::unit(UPRIGHT[j]), lengths[j]);
    let mut out = [0.0; 66];
    let pelvis_turn = quat::mul(quat::mul(turn_y(pose.yaw), turn_x(pose.pitch)), turn_z(pose.roll));
    let hip = |pelvis: Vec3, side: usize| quat::add(pelvis, quat::rotate(pelvis_turn, bone(1 + side)));

    // The pelvis sinks until both legs reach the ground.
    let mut pelvis = pose.pelvis;
    for side in 0..2 {
        let Leg::Foot { toe, yaw, pitch } = pose.legs[side] else { continue };
        let ankle = ankle_of(toe, yaw, pitch, bone(10 + side));
        let hip = hip(pelvis, side);
        let reach = 0.992 * (lengths[4 + side] + lengths[7 + side]);
        let flat = (hip[0] - ankle[0]).hypot(hip[2] - ankle[2]).min(0.9 * reach);
        pelvis[1] -= (hip[1] - ankle[1] - (reach * reach - flat * flat).sqrt()).max(0.0);
    }
    place(&mut out, 0, pelvis);

    for side in 0..2 {
        let hip = hip(pelvis, side);
        let thigh = lengths[4 + side];
        let shank = lengths[7 + side];
        let (knee, ankle, toe) = match pose.legs[side] {
            Leg::Foot { toe, yaw, pitch } => {
                let target = ankle_of(toe, yaw, pitch, bone(10 + side));
                // The knee points in the direction of the foot, and slightly in that of the pelvis.
                let ahead =
                    quat::add(quat::rotate(turn_y(yaw), [0.0, 0.15, 1.0]), quat::rotate(pelvis_turn, [0.0, 0.0, 0.7]));
                let (knee, ankle) = two_bones(hip, target, [thigh, shank], ahead);
                let foot = quat::mul(turn_y(yaw), turn_x(pitch));
                (knee, ankle, quat::add(ankle, quat::rotate(foot, bone(10 + side))))
            }
            Leg::Knee { knee, shank: direction } => {
                let knee = quat::add(hip, quat::scale(quat::unit(quat::sub(knee, hip)), thigh));
                let ankle = quat::add(knee, quat::scale(quat::unit(direction), shank));
                let sole = quat::unit(quat::add(quat::unit(direction), [0.0, -0.45, 0.0]));
                (knee, ankle, quat::add(ankle, quat::scale(sole, lengths[10 + side])))
            }
        };
        place(&mut out, 1 + side, hip);
        place(&mut out, 4 + side, knee);
        place(&mut out, 7 + side, ankle);
        place(&mut out, 10 + side, toe);
    }

    let (turn, at) = spine(&mut out, pose, (pelvis_turn, pelvis), bone);
    let neck = quat::add(at, quat::rotate(turn, bone(12)));
    let head = quat::mul(turn, turn_x(pose.nod));
    place(&mut out, 12, neck);
    place(&mut out, 15, quat::add(neck, quat::rotate(head, bone(15))));
    for side in 0..2 {
        arm(&mut out, &pose.arms[side], side, (at, turn), lengths, bone);
    }
    out
}

/// Places the spine from the pelvis up. Its bend is spread evenly over three joints; returns the turn and place of the
/// last.
fn spine(out: &mut [f64; 66], pose: &Pose, pelvis: (Quat, Vec3), bone: impl Fn(usize) -> Vec3) -> (Quat, Vec3) {
    let third = quat::mul(quat::mul(turn_y(pose.twist / 3.0), turn_x(pose.bend / 3.0)), turn_z(-pose.side / 3.0));
    let (mut turn, mut at) = pelvis;
    for j in [3, 6, 9] {
        turn = quat::mul(turn, third);
        at = quat::add(at, quat::rotate(turn, bone(j)));
        place(out, j, at);
    }
    (turn, at)
}

fn place(out: &mut [f64; 66], j: usize, at: Vec3) {
    out[3 * j..3 * j + 3].copy_from_slice(&at);
}

/// A foot with a lifted heel turns about its toe, one with a lifted toe about its heel.
fn ankle_of(toe: Vec3, yaw: f64, pitch: f64, foot: Vec3) -> Vec3 {
    quat::sub(toe, quat::rotate(quat::mul(turn_y(yaw), turn_x(pitch.max(0.0))), foot))
}

fn arm(
    out: &mut [f64; 66],
    arm: &Arm,
    side: usize,
    chest: (Vec3, Quat),
    lengths: &[f64],
    bone: impl Fn(usize) -> Vec3,
) {
    let (at, turn) = chest;
    let outward = if side == 0 { 1.0 } else { -1.0 };
    let in_chest = |v: Vec3| quat::rotate(turn, [v[0] * outward, v[1], v[2]]);
    // A raised arm raises the shoulder girdle.
    let shrug = turn_z(outward * 0.35 * (arm.upper[1] + 0.2).clamp(0.0, 1.0));
    let collar = quat::add(at, quat::rotate(turn, bone(13 + side)));
    let shoulder = quat::add(collar, quat::rotate(quat::mul(turn, shrug), bone(16 + side)));
    let upper = lengths[18 + side];
    let fore = lengths[20 + side];
    let (elbow, wrist) = match arm.reach {
        Some(target) => two_bones(shoulder, target, [upper, fore], in_chest([0.6, -0.3, -0.6])),
        None => {
            let elbow = quat::add(shoulder, quat::scale(in_chest(arm.upper), upper));
            (elbow, quat::add(elbow, quat::scale(in_chest(arm.fore), fore)))
        }
    };
    place(out, 13 + side, collar);
    place(out, 16 + side, shoulder);
    place(out, 18 + side, elbow);
    place(out, 20 + side, wrist);
}
