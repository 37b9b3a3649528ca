//! The draws of a clip, and the building blocks of movements.

use std::f64::consts::TAU;

use crate::quaternion::{self as quat, Vec3};
use crate::synthetic::body::{Arm, Pose};

/// The draws of one clip.
#[derive(Debug, Clone)]
pub(in crate::synthetic) struct Draw {
    pub(in crate::synthetic) seconds: f64,
    /// Tempo, where 1 is an ordinary speed.
    pub(in crate::synthetic) tempo: f64,
    /// Size, where 1 is an ordinary size.
    pub(in crate::synthetic) size: f64,
    /// The leading side: 0 left, 1 right.
    pub(in crate::synthetic) side: usize,
    /// Free numbers in `[0, 1)`.
    pub(in crate::synthetic) free: [f64; 6],
}

/// Maps a time in seconds to a pose.
pub(in crate::synthetic) type Motion = Box<dyn Fn(f64) -> Pose>;

pub(super) fn ramp(t: f64, from: f64, to: f64) -> f64 {
    let x = ((t - from) / (to - from)).clamp(0.0, 1.0);
    x * x * x * (x * (6.0 * x - 15.0) + 10.0)
}

/// Rises from `a` to `b`, stays at 1, and falls from `c` to `d`.
pub(super) fn hold(t: f64, a: f64, b: f64, c: f64, d: f64) -> f64 {
    ramp(t, a, b) * (1.0 - ramp(t, c, d))
}

pub(super) fn mix(a: f64, b: f64, share: f64) -> f64 {
    a + (b - a) * share
}

/// Interpolates (time, value) pairs smoothly.
pub(super) fn course<const N: usize>(t: f64, keys: &[(f64, [f64; N])]) -> [f64; N] {
    let mut value = keys[0].1;
    for pair in keys.windows(2) {
        if t >= pair[0].0 {
            let share = ramp(t, pair[0].0, pair[1].0);
            value = std::array::from_fn(|k| mix(pair[0].1[k], pair[1].1[k], share));
        }
    }
    value
}

pub(super) fn outward(side: usize) -> f64 {
    if side == 0 { 1.0 } else { -1.0 }
}

/// A standing body with a slow sway.
pub(super) fn standing(d: &Draw, t: f64) -> Pose {
    let mut pose = Pose::standing();
    let wave = |rate: f64, k: usize| (TAU * (rate * t + d.free[k])).sin();
    pose.pelvis[0] += 0.008 * wave(0.23, 0);
    pose.pelvis[2] += 0.006 * wave(0.31, 1);
    pose.twist += 0.025 * wave(0.17, 2);
    pose.side += 0.012 * wave(0.21, 3);
    pose.nod += 0.03 * wave(0.27, 4);
    let stance = mix(-0.03, 0.05, d.free[5]);
    for side in 0..2 {
        pose.legs[side] = pose.legs[side].moved([outward(side) * stance, 0.0, 0.0]);
        pose.arms[side] = Arm::hanging(0.03 * wave(0.29, side), 0.16 + 0.10 * d.free[side + 2]);
    }
    pose
}

/// Bends hips and knees: moves the pelvis down by `depth` and back, and the trunk forward.
pub(super) fn crouch(pose: &mut Pose, depth: f64) {
    pose.pelvis[1] -= depth;
    pose.pelvis[2] -= 0.42 * depth;
    pose.pitch += 0.8 * depth;
    pose.bend += 0.35 * depth;
    pose.nod -= 0.5 * depth;
}

pub(super) fn raised_sideways(angle: f64) -> Arm {
    Arm::new([angle.sin() + 0.12, -angle.cos(), 0.05], [angle.sin(), -angle.cos(), 0.12])
}

pub(super) fn raised_forward(angle: f64) -> Arm {
    Arm::new([0.14, -angle.cos(), angle.sin()], [0.05, -(angle + 0.1).cos(), (angle + 0.1).sin()])
}

pub(super) const GUARD: ([f64; 3], [f64; 3]) = ([0.35, -0.85, 0.25], [-0.25, 0.75, 0.75]);

pub(super) fn guard() -> Arm {
    Arm::new(GUARD.0, GUARD.1)
}

/// Lifts the whole body by moving pelvis and both feet.
pub(super) fn lift(pose: &mut Pose, by: Vec3) {
    pose.pelvis = quat::add(pose.pelvis, by);
    pose.legs = pose.legs.map(|leg| leg.moved(by));
}
