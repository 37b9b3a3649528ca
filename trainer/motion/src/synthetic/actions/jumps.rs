//! Movements with a flight phase.

use super::draw::{Draw, Motion, course, crouch, hold, lift, outward, standing};
use crate::synthetic::body::{Arm, Leg};

/// Pelvis and foot height of a jump cycle, `u` in `[0, 1)`: crouch, take-off, flight over `air`, landing.
fn jump_cycle(u: f64, crouching: f64, height: f64, air: (f64, f64)) -> (f64, f64) {
    let (off, on) = air;
    let up = 4.0 * height * flight(u, air) * (1.0 - flight(u, air));
    let rest = 1.0 - on;
    let landing = hold(u, on - 0.02, on + 0.28 * rest, on + 0.34 * rest, on + 0.96 * rest);
    (crouching * (hold(u, 0.12 * off, 0.66 * off, 0.71 * off, off) + 0.75 * landing), up)
}

/// Share of the flight at `u`.
fn flight(u: f64, air: (f64, f64)) -> f64 {
    ((u - air.0) / (air.1 - air.0)).clamp(0.0, 1.0)
}

/// The height that gravity allows for a flight of `seconds`.
fn ballistic(seconds: f64) -> f64 {
    9.81 * seconds * seconds / 8.0
}

/// Flight phase of a jump, as shares of its cycle.
const JUMP_AIR: (f64, f64) = (0.42, 0.70);
const HOP_AIR: (f64, f64) = (0.34, 0.76);

fn jump_period(d: &Draw) -> f64 {
    let count = (d.seconds / (1.6 / d.tempo).max(1.25)).floor().max(1.0);
    d.seconds / count
}

pub(in crate::synthetic) fn jump(d: &Draw) -> Motion {
    let (d, period) = (d.clone(), jump_period(d));
    Box::new(move |t| {
        let u = (t / period).fract();
        let (down, up) = jump_cycle(u, 0.24 * d.size, d.size * ballistic(0.28 * period).min(0.30), JUMP_AIR);
        let mut pose = standing(&d, t);
        crouch(&mut pose, down);
        lift(&mut pose, [0.0, up, 0.0]);
        let tip = 0.75 * hold(u, 0.38, 0.46, 0.60, 0.68);
        pose.legs = pose.legs.map(|leg| leg.tipped(tip));
        let swing = course(u, &[(0.0, [0.0]), (0.26, [-0.6]), (0.52, [1.8 * d.size]), (0.80, [0.4]), (1.0, [0.0])])[0];
        pose.arms = [Arm::hanging(swing, 0.35); 2];
        pose
    })
}

pub(in crate::synthetic) fn jump_forward(d: &Draw) -> Motion {
    let (d, period) = (d.clone(), jump_period(d).max(1.4));
    Box::new(move |t| {
        let n = (t / period).floor();
        let u = (t / period).fract();
        let (down, up) = jump_cycle(u, 0.28, d.size * ballistic(0.28 * period).min(0.22), JUMP_AIR);
        let mut pose = standing(&d, t);
        crouch(&mut pose, down);
        lift(&mut pose, [0.0, up, 0.75 * d.size * (n + flight(u, JUMP_AIR))]);
        pose.pelvis[2] += 0.16 * hold(u, 0.28, 0.42, 0.44, 0.60);
        let tip = course(u, &[(0.3, [0.0]), (0.44, [0.7]), (0.66, [-0.2]), (0.72, [0.0])])[0];
        pose.legs = pose.legs.map(|leg| leg.tipped(tip));
        let swing = course(u, &[(0.0, [0.0]), (0.26, [-0.8]), (0.52, [1.6]), (0.80, [0.4]), (1.0, [0.0])])[0];
        pose.arms = [Arm::hanging(swing, 0.3); 2];
        pose
    })
}

pub(in crate::synthetic) fn hop(d: &Draw) -> Motion {
    let d = d.clone();
    let count = (d.seconds / (0.75 / d.tempo)).round().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let n = (t / period).floor();
        let u = (t / period).fract();
        let (down, up) = jump_cycle(u, 0.10, d.size * ballistic(0.42 * period), HOP_AIR);
        let mut pose = standing(&d, t);
        let on = d.side;
        let off = 1 - d.side;
        pose.pelvis[0] += 0.085 * outward(on);
        pose.roll = 0.06 * outward(on);
        crouch(&mut pose, 0.03 + down);
        pose.legs[off] = Leg::Foot { toe: [0.10 * outward(off), 0.26, -0.28], yaw: 0.0, pitch: 1.0 };
        pose.legs[on] = pose.legs[on].tipped(0.6 * hold(u, 0.28, 0.42, 0.62, 0.76));
        lift(&mut pose, [0.0, up, 0.16 * d.size * (n + flight(u, HOP_AIR))]);
        let flap = 0.35 + 0.35 * up / 0.11;
        pose.arms = [Arm::new([0.45 + 0.3 * flap, -0.8, 0.2], [0.35, -0.2 - 0.2 * flap, 0.8]); 2];
        pose
    })
}
