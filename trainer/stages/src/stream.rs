//! Motion without end: segments, each of which goes on where the one before it stopped.
//!
//! Source: MotionLCM (Dai et al., ECCV 2024), Fig. 1: the end of one motion is the control of the next. A segment of a model with a control part is
//! told, in its first frames, the positions of the last frames of the stream, turned and shifted so that they begin above the origin and face z
//! ("re-canonicalised"); as many frames and those joints that the part was trained with. Those frames are not given out a second time. What is drawn behind them is placed
//! in the world by the same turn and shift.
//!
//! Departs, where the paper says nothing:
//! - a masked token model keeps the tokens of the last frames and fills in the rest (`Infilling`);
//! - any other model draws a motion of its own, whose first frame is laid on the last one of the stream;
//! - a segment without waypoints is then turned and shifted so that its root is where the stream's is at the junction, and faces the same way: where the model does not quite
//!   begin where it was told, the body does not glide there. With waypoints it stays where they are;
//! - what the two still differ by at the junction fades within `blend` frames ([`Fade`]), joint by joint, so bones change their length a little
//!   there.
//!
//! Joints are metres in one world frame: y is up, the stream starts with its root at x = z = 0 and faces z. A stream is a function of (model, what is
//! asked, settings); each segment has its own seed. Its memory is bounded: only as many frames as the model draws at once are kept.

use motion::features::{recover_joints_wide, root_path};
use motion::placement::{BEFORE, Fade, Placement};
use motion::quaternion::{self as quat, Vec3};
use motion::waypoints::Waypoint;
use motion::{Skeleton, Stream};
use protocol::Seed;
use protocol::stage::{ControlSetting, Sampler};

use crate::context::StageError;
use crate::control::Heed;
use crate::generate::Generator;
use crate::hint::{Hint, share};

/// Percent of a segment that are frames of the one before it, where the control part's training does not say: tau of MotionLCM.
const OVERLAP_PERCENT: f64 = 25.0;
/// Frames in which the rest of a difference fades: half a second of HumanML3D. Ours.
pub const BLEND: usize = 10;

/// How a stream is drawn.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The model's own without one.
    pub sampler: Option<Sampler>,
    /// Another one gives another stream.
    pub seed: Seed,
    /// How told positions are heeded.
    pub heed: Heed,
    /// Frames of the last segment that the next one is told; without it a share of the segment.
    pub overlap: Option<usize>,
    /// Frames in which what differs at a junction fades.
    pub blend: usize,
}

/// How a segment comes to go on where the last one stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Joining {
    /// A control part is told the last frames.
    Control,
    /// A masked token model keeps their tokens.
    Infilling,
    /// Its first frame is laid on the last one.
    Placement,
}

impl Joining {
    /// For people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Control => "control",
            Self::Infilling => "infilling",
            Self::Placement => "placement",
        }
    }
}

/// What a segment should be.
#[derive(Debug, Clone, Default)]
pub struct Ask {
    /// In words.
    pub caption: String,
    /// How many new frames there should be; there are fewer if the model draws no more at once. Without it the model says.
    pub frames: Option<usize>,
    /// Where joints should be, in metres of the world; the first new frame is frame 0.
    pub waypoints: Vec<Waypoint>,
}

/// New frames of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// `[frames, joints, 3]` in metres of the world.
    pub joints: Vec<f64>,
    /// How many.
    pub frames: usize,
    /// Frames of the stream's end that it was drawn with.
    pub overlap: usize,
    /// How far it was off at the junction before that faded: the farthest joint, metres.
    pub offset: f64,
    /// Distances from the waypoints that lie in it, metres.
    pub missed: Vec<f64>,
}

/// The end of a stream.
#[derive(Debug, Clone, Default)]
struct Tail {
    /// Feature rows as the model drew them, in the data's own scale.
    features: Vec<f32>,
    /// `[frames, joints, 3]`, metres of the world, as they were given out.
    joints: Vec<f64>,
    /// Where a clip lies that begins at each frame.
    places: Vec<Placement>,
}

impl Tail {
    fn frames(&self) -> usize {
        self.places.len()
    }

    /// Leaves only frames `range`.
    fn keep(&mut self, range: std::ops::Range<usize>, skeleton: &Skeleton) {
        let (row, frame) = (skeleton.features, 3 * skeleton.joints);
        self.features.truncate(range.end * row);
        self.features.drain(..range.start * row);
        self.joints.truncate(range.end * frame);
        self.joints.drain(..range.start * frame);
        self.places.truncate(range.end);
        self.places.drain(..range.start);
    }
}

/// A stream of motion.
#[derive(Debug, Clone)]
pub struct MotionStream {
    settings: Settings,
    joining: Joining,
    skeleton: &'static Skeleton,
    /// Joints that the control part is told of the last frames.
    told: Vec<usize>,
    /// Percent of a segment that the last frames make up.
    percent: f64,
    /// Lengths of segments are multiples of this.
    unit: usize,
    /// Frames of the longest segment, with what it is told.
    longest: usize,
    tail: Tail,
    /// Frames of the last segment.
    last: usize,
    segments: u64,
}

impl MotionStream {
    /// A stream of a model that has not begun.
    ///
    /// # Errors
    /// A sampler that the model does not have, or an overlap that leaves nothing new.
    pub fn new(generator: &Generator, settings: Settings) -> Result<Self, StageError> {
        let skeleton = Skeleton::of(generator.format());
        if let Some(sampler) = &settings.sampler {
            generator.check_sampler(sampler)?;
        }
        let (joining, unit) = match (generator.control(), generator.infilling_unit()) {
            (Some(_), _) => (Joining::Control, skeleton.unit),
            (None, Some(unit)) => (Joining::Infilling, unit),
            (None, None) => (Joining::Placement, skeleton.unit),
        };
        let (mut told, mut percent) = (Vec::new(), OVERLAP_PERCENT);
        if let Some(control) = generator.control() {
            told = control.format.joints_of_all(&control.hints.joints).map_err(StageError::Input)?;
            if control.hints.setting == ControlSetting::Temporal {
                percent = control.hints.density.1;
            }
        }
        // What it could draw beyond the longest clips of the benchmark it has never seen.
        let longest = generator.longest().min(skeleton.max_frames - 1) / unit * unit;
        let stream = Self {
            settings,
            joining,
            skeleton,
            told,
            percent,
            unit,
            longest,
            tail: Tail::default(),
            last: 0,
            segments: 0,
        };
        // As much as the stream can ever be told.
        let overlap = stream.overlap(longest, usize::MAX);
        if overlap >= longest {
            return Err(StageError::Input(format!(
                "an overlap of {overlap} frames leaves nothing new of segments of at most {longest} frames"
            )));
        }
        Ok(stream)
    }

    /// How its segments are joined.
    pub fn joining(&self) -> Joining {
        self.joining
    }

    /// Its skeleton.
    pub fn skeleton(&self) -> &'static Skeleton {
        self.skeleton
    }

    /// Where its root stands, metres of the world; the origin before it begins.
    pub fn root(&self) -> Vec3 {
        self.joint(self.tail.frames().saturating_sub(1), 0).unwrap_or_default()
    }

    /// Draws the next segment.
    ///
    /// # Errors
    /// What the model refuses; waypoints for a model without a control part.
    pub fn draw(&mut self, generator: &Generator, ask: &Ask) -> Result<Segment, StageError> {
        if !ask.waypoints.is_empty() && self.joining != Joining::Control {
            return Err(StageError::Input("the model has no control part, and so cannot be told where to go".into()));
        }
        let seed = Seed(Stream::new(self.settings.seed, "stream/segment", self.segments, 0).bits());
        let total = match ask.frames {
            Some(frames) => self.total(frames),
            None => self.total_for_all(generator.frames(&ask.caption, seed)?).max(self.total(1)),
        };
        let overlap = self.overlap(total, self.tail.frames());
        let start = self.tail.frames() - overlap;
        let place = self.place(start);
        let drawn = self.features(generator, ask, seed, (total, overlap), place)?;
        let width = self.skeleton.features;
        let frames = (drawn.len() / width).saturating_sub(overlap).min(ask.frames.unwrap_or(usize::MAX));
        if frames == 0 {
            return Err(StageError::Input(format!(
                "the model drew {} frames, of which {overlap} are those that were there already",
                drawn.len() / width
            )));
        }
        let path = root_path(&drawn, self.skeleton);
        let metres = self.skeleton.metres_per_unit;
        let place = match overlap.checked_sub(1).and_then(|last| path.get(last)) {
            Some((heading, root)) if ask.waypoints.is_empty() => {
                self.place(self.tail.frames() - 1).with_frame(*heading, quat::scale(*root, metres))
            }
            _ => place,
        };
        let (joints, offset) = self.placed(&drawn, (overlap, frames), place);
        let missed = ask.waypoints.iter().filter(|waypoint| waypoint.frame < frames).map(|waypoint| {
            let at = 3 * (waypoint.frame * self.skeleton.joints + waypoint.joint);
            quat::norm(quat::sub([joints[at], joints[at + 1], joints[at + 2]], waypoint.position.map(f64::from)))
        });
        let segment = Segment { missed: missed.collect(), joints, frames, overlap, offset };
        let places = path[overlap..overlap + frames].iter();
        self.tail.places.extend(places.map(|(heading, root)| place.of_frame(*heading, quat::scale(*root, metres))));
        self.tail.features.extend(&drawn[overlap * width..(overlap + frames) * width]);
        self.tail.joints.extend(&segment.joints);
        let all = self.tail.frames();
        self.tail.keep(all.saturating_sub(self.longest.max(frames))..all, self.skeleton);
        self.last = frames;
        self.segments += 1;
        Ok(segment)
    }

    /// Takes back all but the first `frames` of the last segment: the next one goes on behind them.
    pub fn cut(&mut self, frames: usize) {
        let gone = self.last.saturating_sub(frames);
        let all = self.tail.frames();
        self.tail.keep(0..all.saturating_sub(gone), self.skeleton);
        self.last -= gone;
    }

    /// Frames of the stream's end, of which there are `have`, in a segment of `total`.
    fn overlap(&self, total: usize, have: usize) -> usize {
        let wanted = self.settings.overlap.unwrap_or_else(|| share(self.percent, total));
        match self.joining {
            Joining::Control => wanted.max(1).min(have),
            Joining::Infilling if have >= self.unit => (wanted.min(have) / self.unit).max(1) * self.unit,
            Joining::Infilling | Joining::Placement => have.min(1),
        }
    }

    /// Frames to draw for `frames` new ones, if the model draws so many.
    fn total(&self, frames: usize) -> usize {
        let have = self.tail.frames();
        let mut total = self.skeleton.min_frames.next_multiple_of(self.unit).min(self.longest);
        while total < self.longest && total - self.overlap(total, have).min(total) < frames {
            total += self.unit;
        }
        total
    }

    /// As many frames, in lengths that the model draws.
    fn total_for_all(&self, frames: usize) -> usize {
        frames.max(self.skeleton.min_frames).next_multiple_of(self.unit).min(self.longest)
    }

    /// Where a clip lies that begins at frame `start` of the tail. What faded in there did not turn the body, but moved its root.
    fn place(&self, start: usize) -> Placement {
        let place = self.tail.places.get(start).copied().unwrap_or_default();
        self.joint(start, 0).map_or(place, |root| place.below(root))
    }

    /// A joint of the tail.
    fn joint(&self, frame: usize, joint: usize) -> Option<Vec3> {
        let at = 3 * (frame * self.skeleton.joints + joint);
        self.tail.joints.get(at..at + 3).map(|p| [p[0], p[1], p[2]])
    }

    /// Feature rows of a segment whose first `overlap` frames are the tail's last ones.
    fn features(
        &self,
        generator: &Generator,
        ask: &Ask,
        seed: Seed,
        (total, overlap): (usize, usize),
        place: Placement,
    ) -> Result<Vec<f32>, StageError> {
        let sampler = self.settings.sampler.as_ref();
        let width = self.skeleton.features;
        let drawn = match self.joining {
            Joining::Control if overlap > 0 || !ask.waypoints.is_empty() => {
                let hint = self.hint(ask, total, overlap, place);
                generator.generate_controlled(&ask.caption, sampler, seed, (&hint, self.settings.heed))?
            }
            Joining::Infilling if overlap >= self.unit => {
                let mut rows = self.tail.features[(self.tail.frames() - overlap) * width..].to_vec();
                let last = rows[rows.len() - width..].to_vec();
                // What is drawn anew is not looked at, but must be motion.
                (overlap..total).for_each(|_| rows.extend(&last));
                let kept = std::iter::once(0..overlap).collect::<Vec<_>>();
                generator.edit(&ask.caption, &rows, &kept, sampler, seed)?.motion
            }
            _ => generator.generate(&ask.caption, Some(total), sampler, seed)?,
        };
        Ok(drawn.features)
    }

    /// What a segment is told: the tail's last frames and the waypoints, in its own frame.
    fn hint(&self, ask: &Ask, total: usize, overlap: usize, place: Placement) -> Hint {
        let mut hint = Hint::none(total, self.skeleton.joints);
        let start = self.tail.frames() - overlap;
        let clip = |world: Vec3| place.to_clip(world).map(|v| v as f32);
        for frame in 0..overlap {
            for joint in 0..self.skeleton.joints {
                match self.joint(start + frame, joint).map(clip) {
                    Some(position) if self.told.contains(&joint) => hint.tell(frame, joint, position),
                    Some(position) => hint.want(frame, joint, position),
                    None => {}
                }
            }
        }
        for waypoint in ask.waypoints.iter().filter(|waypoint| overlap + waypoint.frame < total) {
            hint.tell(overlap + waypoint.frame, waypoint.joint, clip(waypoint.position.map(f64::from)));
        }
        hint
    }

    /// `frames` new frames of drawn rows in the world, behind `overlap` that are there already, joined to those; and how far off they were.
    fn placed(&self, rows: &[f32], (overlap, frames): (usize, usize), place: Placement) -> (Vec<f64>, f64) {
        let (joints, metres) = (self.skeleton.joints, self.skeleton.metres_per_unit);
        let mut world: Vec<f64> = recover_joints_wide(rows, self.skeleton)
            .chunks_exact(3)
            .flat_map(|p| place.to_world([p[0] * metres, p[1] * metres, p[2] * metres]))
            .collect();
        let width = 3 * joints;
        let have = self.tail.frames();
        let mut off = 0.0;
        if overlap > 0 {
            let was = |k: usize, i: usize| self.tail.joints[have.saturating_sub(1 + k) * width + i];
            let is = |k: usize, i: usize| match (overlap - 1).checked_sub(k) {
                Some(frame) => world[frame * width + i],
                // Before the clip begins it moves on as it does then.
                None => {
                    let (first, behind) = ((k + 1 - overlap) as f64, usize::from(world.len() / width > 1));
                    world[i] - first * (world[behind * width + i] - world[i])
                }
            };
            let offsets: Vec<[f64; BEFORE]> =
                (0..width).map(|i| std::array::from_fn(|k| was(k, i) - is(k, i))).collect();
            off = offsets.chunks_exact(3).map(|o| quat::norm([o[0][0], o[1][0], o[2][0]])).fold(0.0, f64::max);
            let fade = Fade::over(self.settings.blend);
            for (k, frame) in world[overlap * width..].chunks_exact_mut(width).take(self.settings.blend).enumerate() {
                let weights = fade.weights(k + 1);
                for (value, offsets) in frame.iter_mut().zip(&offsets) {
                    *value += weights.iter().zip(offsets).map(|(weight, offset)| weight * offset).sum::<f64>();
                }
            }
        }
        world.truncate((overlap + frames) * width);
        world.drain(..overlap * width);
        (world, off)
    }
}

#[cfg(test)]
mod tests;
