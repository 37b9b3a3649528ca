//! Locomotion on two feet: a root path, and footprints that stay in place while a foot stands.
//!
//! The path is integrated on a fine grid from speed and turn rate. A foot stands for the share `duty` of each stride.
//! Its print lies beside the path where the body is in the middle of that stand. In between the foot swings from print
//! to print. So a standing foot cannot skate on any path.

use std::f64::consts::{PI, TAU};

use super::body::{Arm, Leg, Pose, TOE, turn_y};
use crate::quaternion::{self as quat, Vec3};

/// Grid of the path integration, seconds.
const DT: f64 = 0.0125;
/// Duration of the known path before and after the clip, seconds.
const MARGIN: f64 = 2.5;

/// Parameters of a gait. Speeds in metres per second, lengths in metres, angles in radians.
#[derive(Debug, Clone)]
pub(super) struct Gait {
    pub(super) forward: f64,
    /// Speed to the left.
    pub(super) sideways: f64,
    /// Strides (two steps) per second.
    pub(super) cadence: f64,
    /// Share of a stride in which a foot stands.
    pub(super) duty: f64,
    /// Distance of a print from the path.
    pub(super) width: f64,
    /// Height of a swinging toe.
    pub(super) lift: f64,
    /// Height of the pelvis.
    pub(super) height: f64,
    /// Vertical movement of the pelvis; negative is lowest in the middle of a stand, as in running.
    pub(super) bounce: f64,
    pub(super) lean: f64,
    pub(super) arm_swing: f64,
    pub(super) elbow: f64,
    /// Largest pitch of the foot at push-off.
    pub(super) push: f64,
    /// Seconds in which the body starts and stops; 0 is a steady gait.
    pub(super) start: f64,
    pub(super) stop: f64,
}

impl Gait {
    pub(super) fn walking(speed: f64) -> Self {
        Self {
            forward: speed,
            sideways: 0.0,
            cadence: 0.55 + 0.33 * speed.abs(),
            duty: 0.62,
            width: 0.085,
            lift: 0.07,
            height: 0.955,
            bounce: 0.018,
            lean: 0.04 + 0.03 * speed.max(0.0),
            arm_swing: 0.18 + 0.25 * speed.abs(),
            elbow: 0.30,
            push: 0.75,
            start: 0.0,
            stop: 0.0,
        }
    }

    pub(super) fn running(speed: f64) -> Self {
        Self {
            cadence: 1.15 + 0.10 * speed,
            duty: 0.36,
            width: 0.06,
            lift: 0.20,
            height: 0.915,
            bounce: -0.045,
            lean: 0.16 + 0.03 * speed,
            arm_swing: 0.55 + 0.08 * speed,
            elbow: 1.45,
            push: 1.0,
            ..Self::walking(speed)
        }
    }
}

/// A point of the integrated path.
#[derive(Debug, Clone, Copy)]
struct Point {
    at: [f64; 2],
    yaw: f64,
    phase: f64,
    /// Share of the full speed, from 0 (standing) to 1.
    pace: f64,
}

/// The path of a whole clip.
#[derive(Debug)]
pub(super) struct Walk {
    gait: Gait,
    points: Vec<Point>,
}

fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

fn mix(a: f64, b: f64, share: f64) -> f64 {
    a + (b - a) * share
}

impl Walk {
    /// Follows `gait` for `seconds`, turning to the left by `turn(t)` radians per second.
    pub(super) fn new(gait: Gait, seconds: f64, phase: f64, turn: impl Fn(f64) -> f64) -> Self {
        let steps = ((seconds + 2.0 * MARGIN) / DT) as usize;
        let starting = gait.start;
        let stopping = gait.stop;
        let pace = move |t: f64| {
            let up = if starting > 0.0 { smooth(t / starting) } else { 1.0 };
            let down = if stopping > 0.0 { smooth((seconds - 0.15 - t) / stopping) } else { 1.0 };
            up * down
        };
        // A body that stands before or after has both feet down: a whole number of steps, just landed.
        let strides = |cadence: f64| {
            let mut first = 0.0;
            let mut sum = 0.0;
            for i in 0..steps {
                let t = i as f64 * DT - MARGIN;
                sum += cadence * pace(t).sqrt() * DT;
                if t < 0.0 {
                    first = sum;
                }
            }
            (first, sum)
        };
        let (before, total) = strides(gait.cadence);
        let mut gait = gait;
        let mut first = phase - before;
        if gait.start > 0.0 {
            first = 0.03;
        }
        if gait.stop > 0.0 && gait.start > 0.0 {
            gait.cadence *= (2.0 * total).round().max(1.0) / (2.0 * total);
        } else if gait.stop > 0.0 {
            first = 0.03 - total;
        }
        let mut point = Point { at: [0.0; 2], yaw: 0.0, phase: first, pace: 0.0 };
        let mut points = Vec::with_capacity(steps);
        for i in 0..steps {
            let t = i as f64 * DT - MARGIN;
            point.pace = pace(t);
            points.push(point);
            point.yaw += turn(t) * point.pace * DT;
            let step = quat::rotate(turn_y(point.yaw), [gait.sideways, 0.0, gait.forward]);
            point.at[0] += step[0] * point.pace * DT;
            point.at[1] += step[2] * point.pace * DT;
            point.phase += gait.cadence * point.pace.sqrt() * DT;
        }
        Self { gait, points }
    }

    fn at(&self, t: f64) -> Point {
        let x = ((t + MARGIN) / DT).clamp(0.0, (self.points.len() - 2) as f64);
        let a = self.points[x as usize];
        let b = self.points[x as usize + 1];
        let s = x.fract();
        Point {
            at: [mix(a.at[0], b.at[0], s), mix(a.at[1], b.at[1], s)],
            yaw: mix(a.yaw, b.yaw, s),
            phase: mix(a.phase, b.phase, s),
            pace: mix(a.pace, b.pace, s),
        }
    }

    /// The point of the path at which the stride counter reaches `phase`.
    fn at_phase(&self, phase: f64) -> Point {
        let i = self.points.partition_point(|p| p.phase < phase);
        let Some(next) = self.points.get(i) else { return self.points[self.points.len() - 1] };
        if i == 0 {
            return *next;
        }
        let before = self.points[i - 1];
        let s = (phase - before.phase) / (next.phase - before.phase).max(1e-12);
        self.at((i as f64 - 1.0 + s) * DT - MARGIN)
    }

    /// Toe position and direction of print `k` of a limb that lands at `offset` of the stride, `aside` (to the left)
    /// and `ahead` of the path.
    pub(super) fn print(&self, k: f64, offset: f64, aside: f64, ahead: f64) -> (Vec3, f64) {
        let body = self.at_phase(k + offset + 0.5 * self.gait.duty);
        let by = quat::rotate(turn_y(body.yaw), [aside, 0.0, ahead]);
        ([body.at[0] + by[0], TOE, body.at[1] + by[2]], body.yaw)
    }

    /// Stride number, share of the stride, and share of the swing (0 while standing) at `t`.
    pub(super) fn stride(&self, t: f64, offset: f64) -> (f64, f64, f64) {
        let p = self.at(t).phase - offset;
        let u = p - p.floor();
        (p.floor(), u, ((u - self.gait.duty) / (1.0 - self.gait.duty)).max(0.0))
    }

    /// Place on the ground and direction at `t`, and the share of the gait's speed.
    pub(super) fn body(&self, t: f64) -> ([f64; 2], f64, f64) {
        let p = self.at(t);
        (p.at, p.yaw, p.pace)
    }

    /// Position of a limb at `t`: on a print, or on the way to the next one, lifted by `lift`.
    pub(super) fn limb(&self, t: f64, offset: f64, aside: f64, ahead: f64, lift: f64) -> (Vec3, f64) {
        let (k, _, swing) = self.stride(t, offset);
        let (from, yaw) = self.print(k, offset, aside, ahead);
        if swing == 0.0 {
            return (from, yaw);
        }
        let (to, next_yaw) = self.print(k + 1.0, offset, aside, ahead);
        let s = swing - (TAU * swing).sin() / TAU * 0.75;
        let up = lift * (PI * swing.powf(0.85)).sin().powf(1.2);
        ([mix(from[0], to[0], s), TOE + up, mix(from[2], to[2], s)], mix(yaw, next_yaw, s))
    }

    /// Pose of the body at `t`.
    pub(super) fn pose(&self, t: f64) -> Pose {
        let g = &self.gait;
        let body = self.at(t);
        let mut pose = Pose::standing();
        let pace = body.pace;
        let toward: f64 = if g.forward < -0.01 { -1.0 } else { 1.0 };
        for (side, sign) in [(0, 1.0), (1, -1.0)] {
            let offset = 0.5 * side as f64;
            let (toe, yaw) = self.limb(t, offset, sign * g.width, 0.10, g.lift * (0.3 + 0.7 * pace));
            let (_, u, swing) = self.stride(t, offset);
            let push = g.push * pace * toward.max(0.35);
            let tip = if swing > 0.0 {
                // From the lifted heel of push-off to the lifted toe of the landing.
                mix(push, -0.28 * pace * toward, smooth(swing * 1.15))
            } else {
                let off = ((u - (g.duty - 0.24)) / 0.24).max(0.0);
                mix(-0.28 * pace * toward * (1.0 - u / 0.09).max(0.0), push, off * off)
            };
            pose.legs[side] = Leg::Foot { toe, yaw: yaw + sign * 0.10, pitch: tip };
        }
        // 0 is the middle of the left foot's stand. The pelvis moves over the standing foot.
        let middle = TAU * (body.phase - 0.5 * g.duty);
        let sway = 0.018 * pace * middle.cos();
        let aside = quat::rotate(turn_y(body.yaw), [sway, 0.0, 0.0]);
        let height = g.height + g.bounce * pace * (2.0 * middle).cos() + (0.970 - g.height) * (1.0 - pace) * 0.5;
        pose.pelvis = [body.at[0] + aside[0], height, body.at[1] + aside[2]];
        let swing = (TAU * body.phase).cos() * pace * toward;
        let counter = 0.10 * swing * (g.forward.abs() / 1.2).min(1.3);
        pose.yaw = body.yaw - counter;
        pose.twist = 1.9 * counter;
        pose.pitch = 0.5 * g.lean * pace;
        pose.bend = 0.5 * g.lean * pace;
        pose.roll = 0.03 * pace * middle.cos();
        pose.side = 0.03 * pace * middle.cos();
        pose.nod = -0.5 * g.lean * pace;
        let elbow = mix(0.18, g.elbow, pace);
        pose.arms = [-swing, swing].map(|s| Arm::hanging(s * g.arm_swing, elbow + 0.25 * (s * g.arm_swing).max(0.0)));
        pose
    }
}
