//! Kicks and punches.

use std::f64::consts::TAU;

use super::draw::{Draw, Motion, course, guard, hold, mix, outward, standing};
use crate::synthetic::body::{Arm, Leg, Pose, TOE};

pub(in crate::synthetic) fn kick(d: &Draw) -> Motion {
    let d = d.clone();
    let length = 1.25 / d.tempo;
    let count = ((d.seconds - 0.3) / (length + 0.35)).floor().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let u = (t % period - 0.5 * (period - length)) / length;
        let foot = d.side;
        let other = 1 - d.side;
        let x = 0.11 * outward(foot);
        let high = 0.55 * d.size;
        let [side, y, z, pitch] = course(
            u,
            &[
                (0.0, [x, TOE, 0.10, 0.0]),
                (0.30, [x, 0.24, -0.36, 1.0]),
                (0.52, [0.6 * x, high, 0.80, 0.1]),
                (0.62, [0.6 * x, high, 0.80, 0.2]),
                (1.0, [x, TOE, 0.10, 0.0]),
            ],
        );
        let mut pose = standing(&d, t);
        let off = hold(u, -0.12, 0.15, 0.85, 1.1);
        let strike = hold(u, 0.28, 0.52, 0.62, 0.95);
        pose.legs[foot] = Leg::Foot { toe: [side, y, z], yaw: 0.0, pitch };
        pose.pelvis[0] += 0.10 * off * outward(other);
        pose.pelvis[1] -= 0.015 * off;
        pose.pitch = 0.10 * hold(u, 0.0, 0.28, 0.32, 0.5) - 0.28 * strike;
        pose.bend = 0.22 * strike;
        pose.yaw = -0.15 * strike * outward(foot);
        pose.arms[foot] = Arm::hanging(-0.55 * strike + 0.4 * (off - strike), 0.4 + 0.3 * off);
        pose.arms[other] = Arm::hanging(0.85 * strike - 0.3 * (off - strike), 0.4 + 0.5 * off);
        pose
    })
}

/// Makes one punch of `side`, `reach` from 0 (guard) to 1.
fn punch_with(pose: &mut Pose, side: usize, reach: f64, height: f64) {
    let out = Arm::new([0.42, height, 0.95], [0.36, height, 1.0]);
    pose.arms[side] = pose.arms[side].toward(out, reach);
    pose.twist -= 0.50 * reach * outward(side);
    pose.pelvis[2] += 0.05 * reach;
    pose.bend += 0.08 * reach;
}

fn fighting(d: &Draw, t: f64) -> Pose {
    let mut pose = standing(d, t);
    let into = hold(t, 0.0, 0.5, d.seconds - 0.5, d.seconds);
    let lead = 1 - d.side;
    pose.legs[lead] = pose.legs[lead].moved([0.03 * outward(lead), 0.0, 0.16]);
    pose.legs[d.side] = pose.legs[d.side].moved([0.03 * outward(d.side), 0.0, -0.16]);
    pose.pelvis[1] -= 0.05 + 0.012 * (TAU * 1.8 * t).sin() * into;
    pose.bend += 0.12 * into;
    pose.arms = pose.arms.map(|arm| arm.toward(Arm::new([0.4, -0.85, 0.3], [0.1, -0.1, 1.0]), into.min(0.5) * 2.0));
    pose.arms = pose.arms.map(|arm| arm.toward(guard(), (into - 0.5).max(0.0) * 2.0));
    pose
}

pub(in crate::synthetic) fn punch(d: &Draw) -> Motion {
    let d = d.clone();
    let count = ((d.seconds - 1.0) / (1.1 / d.tempo)).round().max(1.0);
    let period = (d.seconds - 1.0) / count;
    Box::new(move |t| {
        let mut pose = fighting(&d, t);
        let u = (t - 0.5) / period;
        if (0.0..count).contains(&u) {
            let reach = hold(u.fract(), 0.15, 0.38, 0.45, 0.80) * d.size.min(1.0);
            punch_with(&mut pose, d.side, reach, mix(-0.1, 0.2, d.free[3]));
        }
        pose
    })
}

pub(in crate::synthetic) fn boxing(d: &Draw) -> Motion {
    let d = d.clone();
    let count = ((d.seconds - 1.0) / (0.62 / d.tempo)).round().max(2.0);
    let period = (d.seconds - 1.0) / count;
    Box::new(move |t| {
        let mut pose = fighting(&d, t);
        let u = (t - 0.5) / period;
        if (0.0..count).contains(&u) {
            let reach = hold(u.fract(), 0.05, 0.38, 0.45, 0.95) * d.size.min(1.0);
            punch_with(&mut pose, (d.side + u as usize) % 2, reach, mix(-0.05, 0.15, d.free[3]));
        }
        pose
    })
}
