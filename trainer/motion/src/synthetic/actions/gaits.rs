//! Locomotion on the ground.

use std::f64::consts::{PI, TAU};

use super::draw::{Draw, Motion, mix, outward, raised_forward, ramp};
use crate::quaternion::{self as quat};
use crate::synthetic::body::{Leg, Pose, turn_y};
use crate::synthetic::gait::{Gait, Walk};

fn gait(d: &Draw, gait: Gait, turn: impl Fn(f64) -> f64) -> Walk {
    Walk::new(gait, d.seconds, d.free[0], turn)
}

/// A gait that starts or stops inside the clip in some of the clips.
fn with_ends(d: &Draw, mut gait: Gait) -> Gait {
    if d.free[1] < 0.35 {
        gait.start = 0.9;
    }
    if d.free[2] < 0.35 {
        gait.stop = 0.9;
    }
    gait
}

fn walking(d: &Draw) -> Gait {
    let mut gait = Gait::walking(1.1 * d.tempo * mix(0.9, 1.1, d.free[3]));
    gait.arm_swing *= d.size;
    gait.lift *= d.size;
    gait
}

pub(in crate::synthetic) fn walk(d: &Draw) -> Motion {
    let path = gait(d, with_ends(d, walking(d)), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn walk_backward(d: &Draw) -> Motion {
    let mut back = Gait::walking(-0.7 * d.tempo);
    (back.lean, back.push, back.arm_swing) = (0.02, 0.5, 0.22 * d.size);
    let path = gait(d, with_ends(d, back), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn run(d: &Draw) -> Motion {
    let path = gait(d, Gait::running(2.5 * d.tempo), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn walk_and_turn(d: &Draw) -> Motion {
    let angle = outward(d.side) * mix(1.2, 1.9, d.free[4]);
    let from = 0.30 * d.seconds;
    let to = 0.70 * d.seconds;
    let middle = 0.5 * (from + to);
    let rate = angle / (middle - from);
    let path = gait(d, walking(d), move |t| rate * ramp(t, from, middle) * (1.0 - ramp(t, middle, to)));
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn walk_in_circle(d: &Draw) -> Motion {
    let rate = outward(d.side) * TAU * mix(0.85, 1.15, d.free[4]) / d.seconds;
    let path = gait(d, walking(d), move |_| rate);
    Box::new(move |t| {
        let mut pose = path.pose(t);
        pose.side += 0.06 * rate.signum();
        pose
    })
}

pub(in crate::synthetic) fn turn_in_place(d: &Draw) -> Motion {
    let mut still = Gait::walking(0.0);
    (still.cadence, still.lift, still.width, still.push) = (1.0 * d.tempo, 0.06, 0.11, 0.3);
    (still.start, still.stop) = (0.4, 0.4);
    let rate = outward(d.side) * PI * mix(0.9, 1.1, d.free[4]) / (d.seconds - 0.9);
    let path = gait(d, still, move |_| rate);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn side_step(d: &Draw) -> Motion {
    let mut aside = Gait::walking(0.0);
    aside.sideways = outward(d.side) * 0.36 * d.tempo;
    (aside.cadence, aside.width, aside.push, aside.lift) = (0.85 * d.tempo, 0.21, 0.25, 0.06 * d.size);
    let path = gait(d, with_ends(d, aside), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn sneak(d: &Draw) -> Motion {
    let mut low = Gait::walking(0.6 * d.tempo);
    (low.height, low.bounce, low.lean, low.lift) = (0.79, 0.01, 0.75, 0.16 * d.size);
    (low.arm_swing, low.elbow, low.push) = (0.25, 1.2, 0.5);
    let path = gait(d, low, |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn march(d: &Draw) -> Motion {
    let mut high = Gait::walking(if d.free[4] < 0.5 { 0.0 } else { 0.55 });
    (high.cadence, high.lift, high.push) = (0.95 * d.tempo, 0.36 * d.size, 0.45);
    (high.arm_swing, high.elbow, high.width) = (0.75 * d.size, 0.7, 0.10);
    let path = gait(d, high, |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(in crate::synthetic) fn zombie(d: &Draw) -> Motion {
    let mut stiff = Gait::walking(0.55 * d.tempo);
    (stiff.lift, stiff.push, stiff.lean) = (0.05, 0.3, 0.1);
    let path = gait(d, stiff, |_| 0.0);
    let size = d.size;
    Box::new(move |t| {
        let mut pose = path.pose(t);
        pose.arms = [0.0, 0.9].map(|shift| raised_forward(0.47 * PI + 0.08 * size * (3.0 * t + shift).sin()));
        pose.side += 0.12 * size * (TAU * 0.6 * t).sin();
        pose
    })
}

pub(in crate::synthetic) fn crawl(d: &Draw) -> Motion {
    let mut low = Gait::walking(0.34 * d.tempo);
    low.cadence = 0.80 * d.tempo;
    let path = gait(d, low, |_| 0.0);
    let lift = 0.07 * d.size;
    Box::new(move |t| {
        let ([x, z], yaw, _) = path.body(t);
        let (_, u, _) = path.stride(t, 0.0);
        let sway = (TAU * (u - 0.3)).cos();
        let mut pose = Pose::standing();
        pose.yaw = yaw + 0.05 * sway;
        pose.pelvis = [x + 0.02 * sway, 0.475, z];
        (pose.pitch, pose.bend, pose.nod) = (1.22, 0.22, -0.75);
        pose.side = 0.06 * sway;
        for side in 0..2 {
            let aside = outward(side);
            // Diagonal: the left hand moves with the right knee.
            let (knee, _) = path.limb(t, 0.5 * side as f64, aside * 0.10, 0.02, lift);
            let (hand, _) = path.limb(t, 0.5 - 0.5 * side as f64, aside * 0.19, 0.56, lift * 1.4);
            let shank = quat::rotate(turn_y(yaw), [aside * 0.03, 0.10, -1.0]);
            pose.legs[side] = Leg::Knee { knee: quat::add(knee, [0.0, 0.03, 0.0]), shank };
            pose.arms[side].reach = Some(hand);
        }
        pose
    })
}
