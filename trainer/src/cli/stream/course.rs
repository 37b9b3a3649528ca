//! Which sentence a stream is at, how its frames are numbered and written, and what is measured of it. Does no input or output.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use motion::Skeleton;
use motion::waypoints::{self, Waypoint};
use stages::stream::{Ask, Segment};

use super::line::Line;
use super::report::Meter;

/// The course of one stream.
#[derive(Debug)]
pub(super) struct Course {
    skeleton: &'static Skeleton,
    /// Frames after which it ends.
    bound: Option<u64>,
    line: Option<Line>,
    /// The sentence as JSON.
    caption: String,
    /// Frames that the sentence has had.
    at: usize,
    /// Since when its first frame is waited for.
    asked: Option<Instant>,
    segment: u64,
    last: Option<Instant>,
    pub(super) meter: Meter,
}

impl Course {
    pub(super) fn new(skeleton: &'static Skeleton, bound: Option<u64>, meter: Meter) -> Self {
        Self { skeleton, bound, line: None, caption: String::new(), at: 0, asked: None, segment: 0, last: None, meter }
    }

    /// The next sentence, for a stream whose root stands at `root`.
    ///
    /// # Errors
    /// A first waypoint too far from there; the sentence before goes on.
    pub(super) fn take(&mut self, line: Line, root: [f64; 3]) -> Result<(), String> {
        waypoints::check_start(&line.waypoints, self.skeleton, root)
            .map_err(|why| format!("line {}: {why}", line.number))?;
        self.caption = serde_json::Value::from(line.caption.as_str()).to_string();
        // A sentence that waited for its turn is not late before that.
        self.asked = Some(self.last.map_or(line.read, |last| last.max(line.read)));
        self.at = 0;
        self.line = Some(line);
        Ok(())
    }

    /// Whether there is a sentence yet.
    pub(super) fn has_begun(&self) -> bool {
        self.line.is_some()
    }

    /// Whether the sentence said how long it goes on, and has not yet.
    pub(super) fn is_pinned(&self) -> bool {
        self.line.as_ref().and_then(|line| line.frames).is_some_and(|frames| self.at < frames)
    }

    /// Whether there are as many frames as there may be.
    pub(super) fn is_over(&self) -> bool {
        self.bound.is_some_and(|bound| self.meter.frames() >= bound)
    }

    /// What comes next.
    pub(super) fn ask(&self) -> Ask {
        let Some(line) = &self.line else { return Ask::default() };
        let frames = line.frames.and_then(|frames| frames.checked_sub(self.at)).filter(|frames| *frames > 0);
        let ahead = line.waypoints.iter().filter(|waypoint| waypoint.frame >= self.at);
        let waypoints = ahead.map(|waypoint| Waypoint { frame: waypoint.frame - self.at, ..*waypoint }).collect();
        Ask { caption: line.caption.clone(), frames, waypoints }
    }

    /// The sentence, and its waypoints by the stream's frames.
    pub(super) fn told(&self) -> impl Iterator<Item = (u64, Waypoint)> {
        let first = self.meter.frames() - self.at as u64;
        let waypoints = self.line.iter().flat_map(|line| &line.waypoints);
        waypoints.map(move |waypoint| (first + waypoint.frame as u64, *waypoint))
    }

    /// What was asked for was drawn within `took`.
    pub(super) fn drawn(&mut self, segment: &Segment, took: Duration) {
        self.segment += 1;
        self.meter.segment(segment, took);
    }

    /// Frame `k` of the last segment, as a line of JSON behind what `text` holds.
    pub(super) fn write(&self, text: &mut String, segment: &Segment, k: usize) {
        let (frame, line) = (self.meter.frames(), self.line.as_ref().map_or(0, |line| line.number));
        // Writing to a string does not fail.
        let _ = write!(
            text,
            "{{\"frame\":{frame},\"time\":{:.3},\"segment\":{},\"line\":{line},\"sentence\":{},\"joints\":[",
            frame as f64 / self.skeleton.fps,
            self.segment.saturating_sub(1),
            self.caption,
        );
        for (j, p) in self.joints(segment, k).chunks_exact(3).enumerate() {
            let comma = if j > 0 { "," } else { "" };
            let _ = write!(text, "{comma}[{:.4},{:.4},{:.4}]", p[0], p[1], p[2]);
        }
        text.push_str("]}");
    }

    /// Frame `k` of the last segment has been given out.
    pub(super) fn given(&mut self, segment: &Segment, k: usize) {
        let asked = self.asked.take();
        self.meter.frame(self.joints(segment, k), k == 0, asked);
        self.at += 1;
        self.last = Some(Instant::now());
    }

    /// Joints `[joints, 3]` of frame `k`.
    pub(super) fn joints<'s>(&self, segment: &'s Segment, k: usize) -> &'s [f64] {
        let width = 3 * self.skeleton.joints;
        &segment.joints[k * width..(k + 1) * width]
    }
}

/// When frames are due.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    /// Frames per second.
    rate: f64,
    begun: Option<Instant>,
    frames: u64,
}

impl Pace {
    pub(super) fn new(rate: f64) -> Self {
        Self { rate, begun: None, frames: 0 }
    }

    /// How long to wait for the next frame. What was late is made up for, so that the stream as a whole keeps its rate.
    pub(super) fn wait(&mut self, now: Instant) -> Duration {
        let due = *self.begun.get_or_insert(now) + Duration::from_secs_f64(self.frames as f64 / self.rate);
        self.frames += 1;
        due.saturating_duration_since(now)
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;
    use stages::stream::Joining;

    use super::*;

    fn course(bound: Option<u64>) -> Course {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        Course::new(skeleton, bound, Meter::new(20.0, Joining::Control, None))
    }

    fn line(frames: Option<usize>, waypoints: &[(usize, [f32; 3])]) -> Line {
        let waypoints =
            waypoints.iter().map(|(frame, position)| Waypoint { frame: *frame, joint: 0, position: *position });
        let caption = "say \"hi\"".to_owned();
        Line { number: 7, caption, frames, waypoints: waypoints.collect(), read: Instant::now() }
    }

    fn segment(frames: usize) -> Segment {
        let joints = (0..frames * 66).map(|n| n as f64 / 8.0).collect();
        Segment { joints, frames, overlap: 0, offset: 0.0, missed: vec![] }
    }

    #[test]
    fn a_sentence_goes_on_as_long_as_it_says() {
        let mut course = course(Some(6));
        assert!(!course.has_begun() && !course.is_pinned());
        course.take(line(Some(5), &[(1, [0.0, 1.0, 0.0]), (4, [0.0, 1.0, 1.0])]), [0.0; 3]).unwrap();
        assert_eq!((course.ask().frames, course.ask().waypoints.len()), (Some(5), 2));
        let drawn = segment(3);
        course.drawn(&drawn, Duration::from_millis(1));
        let mut text = String::new();
        course.write(&mut text, &drawn, 1);
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&value["line"], &value["sentence"]), (&7.into(), &"say \"hi\"".into()));
        assert_eq!((value["joints"].as_array().unwrap().len(), &value["joints"][0][2]), (22, &8.5.into()));
        (0..3).for_each(|k| course.given(&drawn, k));
        // The rest of it, with what lies ahead by its own frames.
        let ask = course.ask();
        assert!(course.is_pinned() && ask.frames == Some(2) && ask.waypoints.len() == 1 && ask.waypoints[0].frame == 1);
        assert_eq!(course.told().map(|(frame, _)| frame).collect::<Vec<_>>(), [1, 4]);
        course.drawn(&drawn, Duration::from_millis(1));
        (0..2).for_each(|k| course.given(&drawn, k));
        assert!(!course.is_pinned() && course.ask().frames.is_none() && !course.is_over());
        let far = course.take(line(None, &[(0, [9.0, 1.0, 0.0])]), [0.0; 3]).unwrap_err();
        assert!(far.contains("line 7") && far.contains("m/s"), "{far}");
        course.take(line(None, &[(0, [9.0, 1.0, 0.0])]), [9.0, 0.9, 0.1]).unwrap();
        course.given(&drawn, 2);
        assert!(course.is_over());
    }

    #[test]
    fn a_late_frame_is_made_up_for() {
        let mut pace = Pace::new(20.0);
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        assert_eq!(pace.wait(after(0)), Duration::ZERO);
        assert_eq!(pace.wait(after(10)), Duration::from_millis(40));
        assert_eq!(pace.wait(after(130)), Duration::ZERO);
        assert_eq!(pace.wait(after(130)), Duration::from_millis(20));
    }
}
