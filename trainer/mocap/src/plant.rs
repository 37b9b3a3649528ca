//! Keeps standing feet in place.
//!
//! Generated figures let a standing foot slide. A foot counts as standing while its ball (the joint after the ankle) is
//! low and slow for at least a tenth of a second. It is moved horizontally to the mean of its places in that time, the
//! ankle with it. Before and after, the shift fades over a fifth of a second. The knee follows so that thigh and shank
//! keep their lengths in every frame and the direction of their bend; hips and everything above are unchanged. A foot
//! that slides more than 15 cm either way is gliding and is left alone. A foot out of the leg's reach is moved to the
//! limit of the leg.
//!
//! The thresholds are our choice: a walking foot swings at 2 m/s and more, and a sliding one seldom exceeds .5 m/s.

use motion::Skeleton;
use motion::quaternion::{self as quat, Vec3};

/// Speed in metres per second below which a ball may stand.
const SLOW: f64 = 0.5;
/// Height in metres above its usual lowest height below which a ball may stand.
const LOW: f64 = 0.05;
/// Shortest time in seconds that a foot stands.
const SHORTEST: f64 = 0.1;
/// Time in seconds in which a shift fades.
const FADE: f64 = 0.2;
/// Largest shift of a foot, in metres.
const FARTHEST: f64 = 0.15;
/// Largest share of a leg's full length, so that the leg always has a bend.
const REACH: f64 = 0.9995;

/// Joints of a leg.
struct Leg<'a> {
    hip: usize,
    knee: usize,
    ankle: usize,
    /// The ball, and the joints after it.
    foot: &'a [usize],
}

/// Moves standing feet of joints `[T, J, 3]` in place. Values that are not finite, or no whole frames, are returned
/// unchanged.
pub fn plant(joints: &[f32], skeleton: &Skeleton) -> Vec<f32> {
    let width = 3 * skeleton.joints;
    if joints.is_empty() || !joints.len().is_multiple_of(width) || !joints.iter().all(|v| v.is_finite()) {
        return joints.to_vec();
    }
    let point = |p: &[f32]| [p[0], p[1], p[2]].map(f64::from);
    let mut frames: Vec<Vec<Vec3>> =
        joints.chunks_exact(width).map(|frame| frame.chunks_exact(3).map(point).collect()).collect();
    for chain in skeleton.chains {
        if let [_, hip, knee, ankle, foot @ ..] = chain
            && skeleton.face[..2].contains(hip)
            && !foot.is_empty()
        {
            plant_leg(&mut frames, &Leg { hip: *hip, knee: *knee, ankle: *ankle, foot }, skeleton);
        }
    }
    frames.iter().flatten().flatten().map(|v| *v as f32).collect()
}

fn plant_leg(frames: &mut [Vec<Vec3>], leg: &Leg<'_>, skeleton: &Skeleton) {
    let unit = skeleton.metres_per_unit;
    let ball: Vec<Vec3> = frames.iter().map(|frame| frame[leg.foot[0]]).collect();
    let mut shifts = vec![[0.0; 2]; frames.len()];
    for span in standing(&ball, skeleton) {
        let places = &ball[span.clone()];
        let mean = [0, 2].map(|axis| places.iter().map(|p| p[axis]).sum::<f64>() / places.len() as f64);
        let shift = |p: &Vec3| [mean[0] - p[0], mean[1] - p[2]];
        if places.iter().map(shift).any(|[x, z]| x.hypot(z) * unit > FARTHEST) {
            continue;
        }
        let fade = (FADE * skeleton.fps).round().max(1.0);
        let first = shift(&places[0]);
        let last = shift(&places[places.len() - 1]);
        for (t, sum) in shifts.iter_mut().enumerate() {
            let (shift, away) = match t {
                t if t < span.start => (first, span.start - t),
                t if t >= span.end => (last, t + 1 - span.end),
                t => (shift(&ball[t]), 0),
            };
            let share = (1.0 - away as f64 / (fade + 1.0)).max(0.0);
            let smooth = share * share * (3.0 - 2.0 * share);
            *sum = [0, 1].map(|k| sum[k] + smooth * shift[k]);
        }
    }
    // Direction of the knee, for frames with a straight leg.
    let mut before = None;
    for (frame, [x, z]) in frames.iter_mut().zip(shifts) {
        if x != 0.0 || z != 0.0 {
            let hips = quat::sub(frame[skeleton.face[1]], frame[skeleton.face[0]]);
            let ahead = before.unwrap_or_else(|| quat::cross(hips, [0.0, 1.0, 0.0]));
            before = bend(frame, leg, [x, 0.0, z], ahead).or(before);
        }
    }
}

/// Ranges of frames in which a ball stands.
fn standing(ball: &[Vec3], skeleton: &Skeleton) -> Vec<std::ops::Range<usize>> {
    let unit = skeleton.metres_per_unit;
    let mut heights: Vec<f64> = ball.iter().map(|p| p[1] * unit).collect();
    heights.sort_by(f64::total_cmp);
    let floor = heights[heights.len() / 20];
    let speed = |a: &Vec3, b: &Vec3| (b[0] - a[0]).hypot(b[2] - a[2]) * unit * skeleton.fps;
    let slow = |t: usize| {
        let next = ball.get(t + 1).map(|next| speed(&ball[t], next));
        let before = t.checked_sub(1).map(|before| speed(&ball[before], &ball[t]));
        next.into_iter().chain(before).fold(0.0, f64::max) < SLOW
    };
    let stands: Vec<bool> = (0..ball.len()).map(|t| ball[t][1] * unit - floor < LOW && slow(t)).collect();
    let mut spans = Vec::new();
    let mut at = 0;
    for run in stands.chunk_by(|a, b| a == b) {
        if run[0] && run.len() as f64 >= SHORTEST * skeleton.fps {
            spans.push(at..at + run.len());
        }
        at += run.len();
    }
    spans
}

/// Moves a foot and its knee. Returns the direction of the knee.
fn bend(frame: &mut [Vec3], leg: &Leg<'_>, shift: Vec3, ahead: Vec3) -> Option<Vec3> {
    let Leg { hip, knee, ankle, foot } = *leg;
    let thigh = quat::norm(quat::sub(frame[knee], frame[hip]));
    let shank = quat::norm(quat::sub(frame[ankle], frame[knee]));
    let way = quat::sub(quat::add(frame[ankle], shift), frame[hip]);
    let length = quat::norm(way);
    if thigh.min(shank) < 1e-9 || length < 1e-9 {
        return None;
    }
    let to = quat::scale(way, 1.0 / length);
    // Never straighter than before, or than the limit of a bent leg.
    let was = quat::norm(quat::sub(frame[ankle], frame[hip]));
    let length = length.min((REACH * (thigh + shank)).max(was)).max((thigh - shank).abs());
    let across = |v: Vec3| quat::sub(v, quat::scale(to, quat::dot(v, to)));
    let own = across(quat::sub(frame[knee], frame[hip]));
    let pole = if quat::norm(own) > 0.01 * thigh { own } else { across(ahead) };
    if quat::norm(pole) < 1e-9 {
        return None;
    }
    let pole = quat::unit(pole);
    let along = (thigh * thigh - shank * shank + length * length) / (2.0 * length);
    let off = (thigh * thigh - along * along).max(0.0).sqrt();
    let moved = quat::add(frame[hip], quat::scale(to, length));
    let shift = quat::sub(moved, frame[ankle]);
    frame[knee] = quat::add(frame[hip], quat::add(quat::scale(to, along), quat::scale(pole, off)));
    frame[ankle] = moved;
    for joint in foot {
        frame[*joint] = quat::add(frame[*joint], shift);
    }
    Some(pole)
}

#[cfg(test)]
mod tests {
    use motion::{features, synthetic};
    use protocol::Seed;
    use protocol::stage::{DataFormat, DataSynthetic};

    use super::*;

    fn distance(frame: &[f32], a: usize, b: usize) -> f64 {
        (0..3).map(|k| f64::from(frame[3 * a + k] - frame[3 * b + k]).powi(2)).sum::<f64>().sqrt()
    }

    /// Mean horizontal speed of both balls while they stand in `of`, m/s.
    fn slide(joints: &[f32], of: &[f32], skeleton: &Skeleton) -> (f64, usize) {
        let mut sum = 0.0;
        let mut count = 0;
        for ball in [skeleton.left_foot[1], skeleton.right_foot[1]] {
            let track = |joints: &[f32]| -> Vec<Vec3> {
                joints.chunks(66).map(|f| [0, 1, 2].map(|k| f64::from(f[3 * ball + k]))).collect()
            };
            let moved = track(joints);
            let given = track(of);
            for span in standing(&given, skeleton) {
                for pair in moved[span].windows(2) {
                    sum += (pair[1][0] - pair[0][0]).hypot(pair[1][2] - pair[0][2]) * skeleton.fps;
                    count += 1;
                }
            }
        }
        (sum / f64::from(u32::try_from(count.max(1)).unwrap()), count)
    }

    #[test]
    fn feet_stay_and_legs_keep_their_lengths() {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        let dataset = synthetic::generate(&DataSynthetic { clips: 12, ..DataSynthetic::default() }, Seed(5));
        let mut stood = 0;
        for clip in &dataset.clips[..12] {
            let mut joints = features::recover_joints(&clip.features, skeleton);
            joints.truncate(80 * 66);
            // The whole figure drifts by 20 cm, and so does a foot that should stand.
            for (t, frame) in joints.chunks_mut(66).enumerate() {
                frame.iter_mut().step_by(3).for_each(|x| *x += 0.0025 * t as f32);
            }
            let planted = plant(&joints, skeleton);
            let ((before, count), (after, _)) = (slide(&joints, &joints, skeleton), slide(&planted, &joints, skeleton));
            stood += count;
            if count > 10 {
                println!("{count} frames: {before:.3} to {after:.3} m/s");
                assert!(after < 0.5 * before, "{before} to {after}");
            }
            for (given, moved) in joints.chunks(66).zip(planted.chunks(66)) {
                for (joint, parent) in skeleton.parents.iter().enumerate().skip(1) {
                    let apart = distance(given, joint, *parent) - distance(moved, joint, *parent);
                    assert!(apart.abs() < 1e-5, "bone to {joint}: {apart}");
                    let leg = [4, 5, 7, 8, 10, 11].contains(&joint);
                    let shift = (0..3).map(|k| f64::from(given[3 * joint + k] - moved[3 * joint + k]).abs());
                    let shift = shift.fold(0.0, f64::max);
                    assert!(if leg { shift < 0.4 } else { shift == 0.0 }, "{joint} moves by {shift}");
                }
            }
            let fastest = [&joints, &planted].map(|joints| {
                let step = |a: &[f32], b: &[f32], knee: usize| {
                    (0..3).map(|k| f64::from(a[3 * knee + k] - b[3 * knee + k]).powi(2)).sum::<f64>().sqrt()
                };
                let frames: Vec<&[f32]> = joints.chunks(66).collect();
                let steps = frames.windows(2).flat_map(|pair| [4, 5].map(|knee| step(pair[0], pair[1], knee)));
                steps.fold(0.0, f64::max)
            });
            assert!(fastest[1] < fastest[0] + 0.15, "knees do not jump: {fastest:?} m a frame");
        }
        assert!(stood > 100, "feet stand in {stood} frames");
    }

    #[test]
    fn what_is_no_motion_or_stands_still_comes_back() {
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let skeleton = Skeleton::of(format);
            assert!(plant(&[], skeleton).is_empty());
            assert_eq!(plant(&[1.0; 7], skeleton), [1.0; 7]);
            let still = vec![0.5; 4 * 3 * skeleton.joints];
            assert_eq!(plant(&still, skeleton), still, "a point has no legs");
            let mut broken = still.clone();
            broken[5] = f32::NAN;
            assert!(plant(&broken, skeleton)[5].is_nan());
        }
    }
}
