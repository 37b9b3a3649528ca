//! The report at the end of a stream.

use std::time::{Duration, Instant};

use protocol::units::counted;
use serde_json::{Value, json};
use stages::generate::stream::{Joining, Segment};
use stages::metrics::junction::{Jump, JunctionMeter, usual};

/// Running mean and maximum of many values.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Many {
    count: u64,
    sum: f64,
    largest: f64,
}

impl Many {
    pub(super) fn add(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        self.largest = self.largest.max(value);
    }

    fn mean(&self) -> f64 {
        self.sum / self.count.max(1) as f64
    }

    fn json(&self) -> Value {
        json!({"count": self.count, "mean": self.mean(), "worst": self.largest})
    }
}

/// Reference for junctions.
#[derive(Debug, Clone)]
pub(super) struct Real {
    /// Source of the reference, for display.
    pub(super) name: String,
    /// The 99th percentile.
    pub(super) usual: Jump,
}

/// Measurements of a stream.
#[derive(Debug, Clone)]
pub(super) struct Meter {
    fps: f64,
    joining: Joining,
    real: Option<Real>,
    junctions: JunctionMeter,
    begun: Option<Instant>,
    ended: Option<Instant>,
    frames: u64,
    segments: u64,
    /// Time spent on generating segments.
    drawing: Duration,
    /// Frames generated, including those not given out.
    drawn: u64,
    /// Seconds from a sentence to its first frame.
    latency: Many,
    /// Frames of earlier segments that conditioned a segment.
    overlap: Many,
    /// Offsets of joints at junctions in metres, before they were faded.
    offset: Many,
    /// Distances from waypoints in metres.
    missed: Many,
}

impl Meter {
    pub(super) fn new(fps: f64, joining: Joining, real: Option<Real>) -> Self {
        Self {
            fps,
            joining,
            real,
            junctions: JunctionMeter::new(fps),
            begun: None,
            ended: None,
            frames: 0,
            segments: 0,
            drawing: Duration::ZERO,
            drawn: 0,
            latency: Many::default(),
            overlap: Many::default(),
            offset: Many::default(),
            missed: Many::default(),
        }
    }

    /// Records a segment that was generated within `took`.
    pub(super) fn segment(&mut self, segment: &Segment, took: Duration) {
        self.segments += 1;
        self.drawing += took;
        self.drawn += segment.frames as u64;
        if segment.overlap > 0 {
            self.overlap.add(segment.overlap as f64);
            self.offset.add(segment.offset);
        }
        segment.missed.iter().for_each(|metres| self.missed.add(*metres));
    }

    /// Records a frame `[joints, 3]`. `first` marks the first of a segment; `asked` is the time of the sentence that
    /// the frame starts.
    pub(super) fn frame(&mut self, frame: &[f64], first: bool, asked: Option<Instant>) {
        self.junctions.push(frame, first && self.frames > 0);
        self.frames += 1;
        let now = Instant::now();
        self.ended = Some(now);
        if let Some(asked) = asked {
            self.begun.get_or_insert(asked);
            self.latency.add((now - asked).as_secs_f64());
        }
    }

    /// Frames given out.
    pub(super) fn frames(&self) -> u64 {
        self.frames
    }

    /// Frames generated per second of generation.
    fn rate(&self) -> f64 {
        self.drawn as f64 / self.drawing.as_secs_f64().max(1e-9)
    }

    /// Frames given out per second, from the first sentence to the last frame.
    fn sustained(&self) -> f64 {
        let time = self.begun.zip(self.ended).map_or(0.0, |(begun, ended)| (ended - begun).as_secs_f64());
        self.frames as f64 / time.max(1e-9)
    }

    /// Reference for junctions with its source.
    fn against(&self) -> Option<Real> {
        let own = || {
            let usual = usual(self.junctions.interior())?;
            Some(Real { name: "the stream's own frames between junctions".into(), usual })
        };
        self.real.clone().or_else(own)
    }

    fn worst(&self) -> Option<Jump> {
        self.junctions.junctions().iter().copied().reduce(|a, b| Jump {
            velocity: a.velocity.max(b.velocity),
            acceleration: a.acceleration.max(b.acceleration),
        })
    }

    /// Number of junctions that stay below the reference in velocity and acceleration.
    fn smooth(&self, against: &Real) -> usize {
        let below =
            |jump: &&Jump| jump.velocity <= against.usual.velocity && jump.acceleration <= against.usual.acceleration;
        self.junctions.junctions().iter().filter(below).count()
    }

    pub(super) fn json(&self) -> Value {
        let jump = |jump: Jump| json!({"velocity_m_s": jump.velocity, "acceleration_m_s2": jump.acceleration});
        let against = self.against();
        json!({
            "schema_version": 1,
            "frames": self.frames,
            "segments": self.segments,
            "joining": self.joining.name(),
            "overlap_frames": self.overlap.json(),
            "latency_s": self.latency.json(),
            "frames_per_second": self.sustained(),
            "times_real_time": self.sustained() / self.fps,
            "drawn_per_second": self.rate(),
            "offset_m": self.offset.json(),
            "waypoints_m": self.missed.json(),
            "junctions": {
                "measured": self.junctions.junctions().len(),
                "worst": self.worst().map(jump),
                "percentile_99": against.as_ref().map(|real| jump(real.usual)),
                "percentile_of": against.as_ref().map(|real| real.name.clone()),
                "below_both": against.as_ref().map(|real| self.smooth(real)),
            },
        })
    }

    /// The report as text.
    pub(super) fn text(&self) -> String {
        let Self { frames, segments, latency, .. } = self;
        let (sustained, rate) = (self.sustained(), self.rate());
        let mut text = format!(
            "{frames} frames in {}; {sustained:.0} frames per second, {:.1} times real time \
             (generation alone {rate:.0}, {:.1} times)\n{:.0} ms from a sentence to its first frame on average over \
             {}, {:.0} ms at most",
            counted(*segments, "segment"),
            sustained / self.fps,
            rate / self.fps,
            1e3 * latency.mean(),
            latency.count,
            1e3 * latency.largest,
        );
        if self.overlap.count > 0 {
            text += &format!(
                "\njoined by {} over {:.0} frames; joints differed by up to {:.1} cm at the junctions before \
                 blending, {:.1} cm on average",
                self.joining.name(),
                self.overlap.mean(),
                100.0 * self.offset.largest,
                100.0 * self.offset.mean(),
            );
        }
        if let (Some(worst), Some(real)) = (self.worst(), self.against()) {
            text += &format!(
                "\n{} of {} junctions are below the 99th percentile of {} ({:.2} m/s and {:.1} m/s2 per frame); the \
                 largest jump is {:.2} m/s and {:.1} m/s2",
                self.smooth(&real),
                self.junctions.junctions().len(),
                real.name,
                real.usual.velocity,
                real.usual.acceleration,
                worst.velocity,
                worst.acceleration,
            );
        }
        if self.missed.count > 0 {
            let (mean, worst) = (100.0 * self.missed.mean(), 100.0 * self.missed.largest);
            text += &format!(
                "\n{} target positions: {mean:.1} cm off on average, {worst:.1} cm at most",
                self.missed.count
            );
        }
        text
    }
}
