//! Movements on the spot.

use std::f64::consts::{PI, TAU};

use super::draw::{
    Draw, Motion, course, crouch, hold, lift, mix, outward, raised_forward, raised_sideways, ramp, standing,
};
use crate::synthetic::body::{Arm, Leg, TOE};

pub(in crate::synthetic) fn wave(d: &Draw) -> Motion {
    let d = d.clone();
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = hold(t, 0.15, 0.85, d.seconds - 0.95, d.seconds - 0.2);
        let beat = (TAU * 1.4 * d.tempo * t).sin() * 0.75 * d.size;
        let high = mix(0.10, 0.55, d.free[3]);
        let waving = Arm::new([0.85, high, 0.30], [0.15 + beat, 1.0, 0.25]);
        // Through the side, so that the arm does not pass through the body.
        let aside = Arm::new([0.8, -0.5, 0.3], [0.6, -0.1, 0.7]);
        let rest = pose.arms[d.side];
        pose.arms[d.side] = if up < 0.5 { rest.toward(aside, 2.0 * up) } else { aside.toward(waving, 2.0 * up - 1.0) };
        pose.side -= 0.06 * up * outward(d.side);
        pose
    })
}

pub(in crate::synthetic) fn sit(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.3 / d.tempo;
    let stands_up = d.free[3] < 0.6;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let from = 0.4;
        let up = d.seconds - 0.35 - time;
        let down = ramp(t, from, from + time) * if stands_up { 1.0 - ramp(t, up, up + time) } else { 1.0 };
        pose.pelvis[1] = mix(pose.pelvis[1], 0.50, down);
        pose.pelvis[2] -= 0.40 * down;
        let lean = (PI * down).sin();
        pose.pitch = 0.38 * lean + 0.02 * down;
        pose.bend = 0.30 * lean + 0.10 * down;
        pose.nod = -0.25 * lean;
        let lap = Arm::new([0.12, -0.85, 0.40 + 0.4 * lean], [-0.05, -0.35, 0.95]);
        pose.arms = pose.arms.map(|arm| arm.toward(lap, down));
        pose
    })
}

pub(in crate::synthetic) fn squat(d: &Draw) -> Motion {
    let d = d.clone();
    let count = (d.seconds / (2.1 / d.tempo)).round().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let u = (t / period).fract();
        let down = hold(u, 0.08, 0.45, 0.55, 0.92);
        let mut pose = standing(&d, t);
        for side in 0..2 {
            pose.legs[side] = pose.legs[side].moved([0.05 * outward(side), 0.0, 0.0]);
        }
        crouch(&mut pose, 0.44 * d.size.min(1.1) * down);
        pose.arms = [raised_forward(1.5 * down + 0.05); 2];
        pose
    })
}

pub(in crate::synthetic) fn raise_arms(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 0.95 / d.tempo;
    let forward = d.free[3] < 0.5;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = hold(t, 0.35, 0.35 + time, d.seconds - 0.35 - time, d.seconds - 0.3);
        let angle = 0.08 + 2.85 * d.size.min(1.05) * up;
        pose.arms = [if forward { raised_forward(angle) } else { raised_sideways(angle) }; 2];
        pose.nod -= 0.15 * up;
        pose.bend -= 0.06 * up;
        pose
    })
}

pub(in crate::synthetic) fn bow(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.0 / d.tempo;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let down = hold(t, 0.4, 0.4 + time, d.seconds - 0.5 - time, d.seconds - 0.4);
        let lean = 1.05 * d.size * down;
        pose.pitch = 0.55 * lean;
        pose.bend = 0.55 * lean;
        pose.nod = 0.15 * lean;
        pose.pelvis[2] -= 0.13 * lean;
        pose.arms = [Arm::hanging(0.75 * lean, 0.15); 2];
        pose
    })
}

pub(in crate::synthetic) fn clap(d: &Draw) -> Motion {
    let d = d.clone();
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = hold(t, 0.1, 0.8, d.seconds - 0.8, d.seconds - 0.1);
        let open = 0.5 + 0.5 * (TAU * 1.7 * d.tempo * t).cos();
        let inward = mix(-0.62, -0.05, open * d.size.min(1.15));
        let height = mix(-0.05, 0.35, d.free[3]);
        let hands = Arm::new([0.30 + 0.15 * open, -0.85, 0.50], [inward, height, 0.85]);
        pose.arms = pose.arms.map(|arm| arm.toward(hands, up));
        pose
    })
}

pub(in crate::synthetic) fn stretch(d: &Draw) -> Motion {
    let d = d.clone();
    let first = outward(d.side);
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = hold(t, 0.1, 1.0, d.seconds - 1.0, d.seconds - 0.1);
        let lean = first * up * (TAU * 0.30 * d.tempo * (t - 1.0).max(0.0)).sin() * 0.55 * d.size;
        for side in 0..2 {
            pose.legs[side] = pose.legs[side].moved([0.06 * outward(side), 0.0, 0.0]);
        }
        pose.side += lean;
        pose.pelvis[0] -= 0.09 * lean;
        pose.arms = [raised_sideways(0.08 + 2.95 * up); 2];
        pose
    })
}

pub(in crate::synthetic) fn jumping_jacks(d: &Draw) -> Motion {
    let d = d.clone();
    let count = (d.seconds / (1.3 / d.tempo).max(1.1)).floor().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let u = 2.0 * (t / period).fract();
        let open = hold(u, 0.05, 0.90, 1.05, 1.90);
        // Two hops per cycle, each while the feet move.
        let air = [(0.10, 0.80), (1.10, 1.80)].iter().map(|(a, b)| ((u - a) / (b - a)).clamp(0.0, 1.0));
        let up: f64 = air.map(|s| 0.36 * d.size * s * (1.0 - s)).sum();
        let mut pose = standing(&d, t);
        for side in 0..2 {
            pose.legs[side] = pose.legs[side].moved([0.22 * d.size * open * outward(side), 0.0, 0.0]).tipped(3.0 * up);
        }
        pose.pelvis[1] -= 0.05 + 0.02 * (1.0 - up / 0.1).clamp(0.0, 1.0);
        lift(&mut pose, [0.0, up, 0.0]);
        pose.arms = [raised_sideways(0.12 + 2.7 * open); 2];
        pose
    })
}

pub(in crate::synthetic) fn pick_up(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.25 / d.tempo;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let from = 0.35;
        let back = d.seconds - 0.5 - time;
        let down = hold(t, from, from + time, back.max(from + time + 0.1), back.max(from + time + 0.1) + time);
        crouch(&mut pose, 0.40 * down);
        pose.pitch += 0.22 * down;
        pose.bend += 0.38 * down;
        pose.nod += 0.25 * down;
        let lean = pose.pitch + pose.bend;
        let grip = Arm::hanging(lean * 0.85 + 0.25, 0.05);
        let brace = Arm::hanging(lean * 0.55, 0.7);
        pose.arms[d.side] = pose.arms[d.side].toward(grip, down);
        pose.arms[1 - d.side] = pose.arms[1 - d.side].toward(brace, down);
        // The picked object is held in front of the body on the way up.
        let carried = ramp(t, from + time, d.seconds - 0.6) * (1.0 - down);
        pose.arms[d.side] = pose.arms[d.side].toward(Arm::new([0.15, -0.95, 0.2], [-0.1, 0.2, 1.0]), carried);
        pose
    })
}

pub(in crate::synthetic) fn throw(d: &Draw) -> Motion {
    let d = d.clone();
    let length = 1.5 / d.tempo;
    let start = 0.45 * (d.seconds - length);
    Box::new(move |t| {
        let u = (t - start) / length;
        let arm = d.side;
        let other = 1 - d.side;
        let mut pose = standing(&d, t);
        let stance = hold(u, -0.1, 0.3, 0.9, 1.2);
        pose.legs[arm] = pose.legs[arm].moved([0.0, 0.0, -0.14]);
        pose.legs[other] = pose.legs[other].moved([0.0, 0.0, 0.14]);
        pose.pelvis[1] -= 0.03;
        let x = |keys: [[f64; 6]; 5]| {
            course(u, &[(0.0, keys[0]), (0.40, keys[1]), (0.56, keys[2]), (0.70, keys[3]), (1.1, keys[4])])
        };
        let rest = pose.arms[arm];
        let r = [rest.upper[0], rest.upper[1], rest.upper[2], rest.fore[0], rest.fore[1], rest.fore[2]];
        let a = x([
            r,
            [0.85, 0.15, -0.50, 0.10, 0.85, -0.50],
            [0.60, 0.45, 0.65, 0.05, 0.80, 0.60],
            [-0.10, -0.25, 0.95, -0.30, -0.45, 0.85],
            r,
        ]);
        pose.arms[arm] = Arm::new([a[0], a[1], a[2]], [a[3], a[4], a[5]]);
        pose.arms[other] =
            pose.arms[other].toward(Arm::new([0.4, -0.3, 0.85], [0.1, 0.1, 1.0]), hold(u, 0.0, 0.38, 0.45, 0.75));
        let [turn, bend, ahead] =
            course(u, &[(0.0, [0.0; 3]), (0.40, [0.55, -0.10, -0.08]), (0.70, [-0.55, 0.35, 0.10]), (1.15, [0.0; 3])]);
        pose.twist -= outward(arm) * -turn * d.size * stance;
        pose.bend += bend;
        pose.pelvis[2] += ahead;
        pose
    })
}

pub(in crate::synthetic) fn balance(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.0 / d.tempo;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = d.side;
        let on = 1 - d.side;
        let off = hold(t, 0.2, 0.2 + 0.8 * time, d.seconds - 0.9 * time, d.seconds - 0.15);
        let raised = hold(t, 0.5, 0.5 + time, d.seconds - 0.4 - time, d.seconds - 0.4);
        let wobble = raised * (TAU * 0.9 * t).sin();
        let x = 0.11 * outward(up);
        pose.pelvis[0] += (0.105 * off + 0.006 * wobble) * outward(on);
        let toe = [mix(x, 0.6 * x, raised), TOE + 0.40 * d.size * raised, 0.10 + 0.10 * raised];
        pose.legs[up] = Leg::Foot { toe, yaw: 0.0, pitch: 0.35 * raised };
        pose.side += 0.03 * wobble;
        let spread = mix(0.9, 1.5, d.free[3]);
        pose.arms = [0, 1].map(|side| raised_sideways(0.08 + spread * raised + 0.08 * wobble * outward(side)));
        pose
    })
}
