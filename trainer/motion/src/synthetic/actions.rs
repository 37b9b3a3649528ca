//! What the synthetic body does: one function a movement, from the clip's draw to the pose at a time.
//!
//! Times and sizes depend on the draw (tempo, size, side, a few free numbers), so that no two clips of a movement are equal.

use std::f64::consts::{PI, TAU};

use super::body::{Arm, Leg, Pose, TOE, turn_y};
use super::gait::{Gait, Walk};
use crate::quaternion::{self as quat, Vec3};

/// What was drawn for one clip.
#[derive(Debug, Clone)]
pub(super) struct Draw {
    pub(super) seconds: f64,
    /// 1 is an ordinary speed.
    pub(super) tempo: f64,
    /// 1 is an ordinary size.
    pub(super) size: f64,
    /// Which side leads: 0 left, 1 right.
    pub(super) side: usize,
    /// Free numbers in `[0, 1)`.
    pub(super) free: [f64; 6],
}

/// The pose at a time in seconds.
pub(super) type Motion = Box<dyn Fn(f64) -> Pose>;

fn ramp(t: f64, from: f64, to: f64) -> f64 {
    let x = ((t - from) / (to - from)).clamp(0.0, 1.0);
    x * x * x * (x * (6.0 * x - 15.0) + 10.0)
}

/// Rises from `a` to `b`, stays, and falls from `c` to `d`.
fn hold(t: f64, a: f64, b: f64, c: f64, d: f64) -> f64 {
    ramp(t, a, b) * (1.0 - ramp(t, c, d))
}

fn mix(a: f64, b: f64, share: f64) -> f64 {
    a + (b - a) * share
}

/// A smooth course through (time, value) pairs.
fn course<const N: usize>(t: f64, keys: &[(f64, [f64; N])]) -> [f64; N] {
    let mut value = keys[0].1;
    for pair in keys.windows(2) {
        if t >= pair[0].0 {
            let share = ramp(t, pair[0].0, pair[1].0);
            value = std::array::from_fn(|k| mix(pair[0].1[k], pair[1].1[k], share));
        }
    }
    value
}

fn outward(side: usize) -> f64 {
    if side == 0 { 1.0 } else { -1.0 }
}

/// Standing, with the slow sway of somebody who stands.
fn standing(d: &Draw, t: f64) -> Pose {
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

/// Bends hips and knees: the pelvis goes down by `depth` and back, the trunk forward.
fn crouch(pose: &mut Pose, depth: f64) {
    pose.pelvis[1] -= depth;
    pose.pelvis[2] -= 0.42 * depth;
    pose.pitch += 0.8 * depth;
    pose.bend += 0.35 * depth;
    pose.nod -= 0.5 * depth;
}

fn raised_sideways(angle: f64) -> Arm {
    Arm::new([angle.sin() + 0.12, -angle.cos(), 0.05], [angle.sin(), -angle.cos(), 0.12])
}

fn raised_forward(angle: f64) -> Arm {
    Arm::new([0.14, -angle.cos(), angle.sin()], [0.05, -(angle + 0.1).cos(), (angle + 0.1).sin()])
}

const GUARD: ([f64; 3], [f64; 3]) = ([0.35, -0.85, 0.25], [-0.25, 0.75, 0.75]);

fn guard() -> Arm {
    Arm::new(GUARD.0, GUARD.1)
}

/// Lifts the whole body: pelvis and both feet.
fn lift(pose: &mut Pose, by: Vec3) {
    pose.pelvis = quat::add(pose.pelvis, by);
    pose.legs = pose.legs.map(|leg| leg.moved(by));
}

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

pub(super) fn walk(d: &Draw) -> Motion {
    let path = gait(d, with_ends(d, walking(d)), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn walk_backward(d: &Draw) -> Motion {
    let mut back = Gait::walking(-0.7 * d.tempo);
    (back.lean, back.push, back.arm_swing) = (0.02, 0.5, 0.22 * d.size);
    let path = gait(d, with_ends(d, back), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn run(d: &Draw) -> Motion {
    let path = gait(d, Gait::running(2.5 * d.tempo), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn walk_and_turn(d: &Draw) -> Motion {
    let angle = outward(d.side) * mix(1.2, 1.9, d.free[4]);
    let (from, to) = (0.30 * d.seconds, 0.70 * d.seconds);
    let middle = 0.5 * (from + to);
    let rate = angle / (middle - from);
    let path = gait(d, walking(d), move |t| rate * ramp(t, from, middle) * (1.0 - ramp(t, middle, to)));
    Box::new(move |t| path.pose(t))
}

pub(super) fn walk_in_circle(d: &Draw) -> Motion {
    let rate = outward(d.side) * TAU * mix(0.85, 1.15, d.free[4]) / d.seconds;
    let path = gait(d, walking(d), move |_| rate);
    Box::new(move |t| {
        let mut pose = path.pose(t);
        pose.side += 0.06 * rate.signum();
        pose
    })
}

pub(super) fn turn_in_place(d: &Draw) -> Motion {
    let mut still = Gait::walking(0.0);
    (still.cadence, still.lift, still.width, still.push) = (1.0 * d.tempo, 0.06, 0.11, 0.3);
    (still.start, still.stop) = (0.4, 0.4);
    let rate = outward(d.side) * PI * mix(0.9, 1.1, d.free[4]) / (d.seconds - 0.9);
    let path = gait(d, still, move |_| rate);
    Box::new(move |t| path.pose(t))
}

pub(super) fn side_step(d: &Draw) -> Motion {
    let mut aside = Gait::walking(0.0);
    aside.sideways = outward(d.side) * 0.36 * d.tempo;
    (aside.cadence, aside.width, aside.push, aside.lift) = (0.85 * d.tempo, 0.21, 0.25, 0.06 * d.size);
    let path = gait(d, with_ends(d, aside), |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn sneak(d: &Draw) -> Motion {
    let mut low = Gait::walking(0.6 * d.tempo);
    (low.height, low.bounce, low.lean, low.lift) = (0.79, 0.01, 0.75, 0.16 * d.size);
    (low.arm_swing, low.elbow, low.push) = (0.25, 1.2, 0.5);
    let path = gait(d, low, |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn march(d: &Draw) -> Motion {
    let mut high = Gait::walking(if d.free[4] < 0.5 { 0.0 } else { 0.55 });
    (high.cadence, high.lift, high.push) = (0.95 * d.tempo, 0.36 * d.size, 0.45);
    (high.arm_swing, high.elbow, high.width) = (0.75 * d.size, 0.7, 0.10);
    let path = gait(d, high, |_| 0.0);
    Box::new(move |t| path.pose(t))
}

pub(super) fn zombie(d: &Draw) -> Motion {
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

pub(super) fn crawl(d: &Draw) -> Motion {
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
            // Diagonal: the left hand goes with the right knee.
            let (knee, _) = path.limb(t, 0.5 * side as f64, aside * 0.10, 0.02, lift);
            let (hand, _) = path.limb(t, 0.5 - 0.5 * side as f64, aside * 0.19, 0.56, lift * 1.4);
            let shank = quat::rotate(turn_y(yaw), [aside * 0.03, 0.10, -1.0]);
            pose.legs[side] = Leg::Knee { knee: quat::add(knee, [0.0, 0.03, 0.0]), shank };
            pose.arms[side].reach = Some(hand);
        }
        pose
    })
}

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

/// The height that gravity allows for a flight of so many seconds.
fn ballistic(seconds: f64) -> f64 {
    9.81 * seconds * seconds / 8.0
}

/// When the feet are in the air in a jump, as shares of its cycle.
const JUMP_AIR: (f64, f64) = (0.42, 0.70);
const HOP_AIR: (f64, f64) = (0.34, 0.76);

fn jump_period(d: &Draw) -> f64 {
    let count = (d.seconds / (1.6 / d.tempo).max(1.25)).floor().max(1.0);
    d.seconds / count
}

pub(super) fn jump(d: &Draw) -> Motion {
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

pub(super) fn jump_forward(d: &Draw) -> Motion {
    let (d, period) = (d.clone(), jump_period(d).max(1.4));
    Box::new(move |t| {
        let (n, u) = ((t / period).floor(), (t / period).fract());
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

pub(super) fn hop(d: &Draw) -> Motion {
    let d = d.clone();
    let count = (d.seconds / (0.75 / d.tempo)).round().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let (n, u) = ((t / period).floor(), (t / period).fract());
        let (down, up) = jump_cycle(u, 0.10, d.size * ballistic(0.42 * period), HOP_AIR);
        let mut pose = standing(&d, t);
        let (on, off) = (d.side, 1 - d.side);
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

pub(super) fn wave(d: &Draw) -> Motion {
    let d = d.clone();
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let up = hold(t, 0.15, 0.85, d.seconds - 0.95, d.seconds - 0.2);
        let beat = (TAU * 1.4 * d.tempo * t).sin() * 0.75 * d.size;
        let high = mix(0.10, 0.55, d.free[3]);
        let waving = Arm::new([0.85, high, 0.30], [0.15 + beat, 1.0, 0.25]);
        // By way of the side, so that the arm does not pass through the body.
        let aside = Arm::new([0.8, -0.5, 0.3], [0.6, -0.1, 0.7]);
        let rest = pose.arms[d.side];
        pose.arms[d.side] = if up < 0.5 { rest.toward(aside, 2.0 * up) } else { aside.toward(waving, 2.0 * up - 1.0) };
        pose.side -= 0.06 * up * outward(d.side);
        pose
    })
}

pub(super) fn kick(d: &Draw) -> Motion {
    let d = d.clone();
    let length = 1.25 / d.tempo;
    let count = ((d.seconds - 0.3) / (length + 0.35)).floor().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let u = (t % period - 0.5 * (period - length)) / length;
        let (foot, other) = (d.side, 1 - d.side);
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

/// One punch of `side`, `reach` from 0 (guard) to 1.
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

pub(super) fn punch(d: &Draw) -> Motion {
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

pub(super) fn boxing(d: &Draw) -> Motion {
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

pub(super) fn sit(d: &Draw) -> Motion {
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

pub(super) fn squat(d: &Draw) -> Motion {
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

pub(super) fn raise_arms(d: &Draw) -> Motion {
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

pub(super) fn bow(d: &Draw) -> Motion {
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

pub(super) fn clap(d: &Draw) -> Motion {
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

pub(super) fn stretch(d: &Draw) -> Motion {
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

pub(super) fn jumping_jacks(d: &Draw) -> Motion {
    let d = d.clone();
    let count = (d.seconds / (1.3 / d.tempo).max(1.1)).floor().max(1.0);
    let period = d.seconds / count;
    Box::new(move |t| {
        let u = 2.0 * (t / period).fract();
        let open = hold(u, 0.05, 0.90, 1.05, 1.90);
        // Two hops a cycle, each while the feet move.
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

pub(super) fn pick_up(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.25 / d.tempo;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let (from, back) = (0.35, d.seconds - 0.5 - time);
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
        // What was picked up is held in front of the body on the way up.
        let carried = ramp(t, from + time, d.seconds - 0.6) * (1.0 - down);
        pose.arms[d.side] = pose.arms[d.side].toward(Arm::new([0.15, -0.95, 0.2], [-0.1, 0.2, 1.0]), carried);
        pose
    })
}

pub(super) fn throw(d: &Draw) -> Motion {
    let d = d.clone();
    let length = 1.5 / d.tempo;
    let start = 0.45 * (d.seconds - length);
    Box::new(move |t| {
        let u = (t - start) / length;
        let (arm, other) = (d.side, 1 - d.side);
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

pub(super) fn balance(d: &Draw) -> Motion {
    let d = d.clone();
    let time = 1.0 / d.tempo;
    Box::new(move |t| {
        let mut pose = standing(&d, t);
        let (up, on) = (d.side, 1 - d.side);
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
