//! State of a stream: its current sentence, the numbering and encoding of its frames, and its measurements. Does no
//! input or output.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use motion::Skeleton;
use motion::waypoints::{self, Waypoint};
use stages::generate::stream::{Ask, Segment};

use super::line::Line;
use super::report::Meter;

/// State of one stream.
#[derive(Debug)]
pub(super) struct Course {
    skeleton: &'static Skeleton,
    /// Frames after which it ends.
    bound: Option<u64>,
    line: Option<Line>,
    /// The sentence as JSON.
    caption: String,
    /// Frames given out for the sentence.
    at: usize,
    /// Start of the wait for its first frame.
    asked: Option<Instant>,
    segment: u64,
    last: Option<Instant>,
    pub(super) meter: Meter,
}

impl Course {
    pub(super) fn new(skeleton: &'static Skeleton, bound: Option<u64>, meter: Meter) -> Self {
        Self { skeleton, bound, line: None, caption: String::new(), at: 0, asked: None, segment: 0, last: None, meter }
    }

    /// Starts the next sentence, for a stream whose root is at `root`.
    ///
    /// # Errors
    /// If the first waypoint is too far from there; the previous sentence then continues.
    pub(super) fn take(&mut self, line: Line, root: [f64; 3]) -> Result<(), String> {
        waypoints::check_start(&line.waypoints, self.skeleton, root)
            .map_err(|why| format!("line {}: {why}", line.number))?;
        self.caption = serde_json::Value::from(line.caption.as_str()).to_string();
        // The time in the queue does not count as delay.
        self.asked = Some(self.last.map_or(line.read, |last| last.max(line.read)));
        self.at = 0;
        self.line = Some(line);
        Ok(())
    }

    /// Returns true once there is a sentence.
    pub(super) fn has_begun(&self) -> bool {
        self.line.is_some()
    }

    /// Returns true if the sentence has a length and has not reached it.
    pub(super) fn is_pinned(&self) -> bool {
        self.line.as_ref().and_then(|line| line.frames).is_some_and(|frames| self.at < frames)
    }

    /// Returns true if the stream has reached its limit of frames.
    pub(super) fn is_over(&self) -> bool {
        self.bound.is_some_and(|bound| self.meter.frames() >= bound)
    }

    /// The request for the next segment.
    pub(super) fn ask(&self) -> Ask {
        let Some(line) = &self.line else { return Ask::default() };
        let frames = line.frames.and_then(|frames| frames.checked_sub(self.at)).filter(|frames| *frames > 0);
        let ahead = line.waypoints.iter().filter(|waypoint| waypoint.frame >= self.at);
        let waypoints = ahead.map(|waypoint| Waypoint { frame: waypoint.frame - self.at, ..*waypoint }).collect();
        Ask { caption: line.caption.clone(), frames, waypoints }
    }

    /// The waypoints of the sentence by frames of the stream.
    pub(super) fn waypoints(&self) -> impl Iterator<Item = (u64, Waypoint)> {
        let first = self.meter.frames() - self.at as u64;
        let waypoints = self.line.iter().flat_map(|line| &line.waypoints);
        waypoints.map(move |waypoint| (first + waypoint.frame as u64, *waypoint))
    }

    /// Records a segment that was generated within `took`.
    pub(super) fn drawn(&mut self, segment: &Segment, took: Duration) {
        self.segment += 1;
        self.meter.segment(segment, took);
    }

    /// Appends frame `k` of the last segment to `text` as a line of JSON.
    pub(super) fn write(&self, text: &mut String, segment: &Segment, k: usize) {
        let (frame, line) = (self.meter.frames(), self.line.as_ref().map_or(0, |line| line.number));
        // Writing to a string never fails.
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

    /// Records that frame `k` of the last segment was given out.
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

/// Schedule of the frames.
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

    /// Time to wait for the next frame. Later frames make up for a late one, so that the stream as a whole keeps its
    /// rate.
    pub(super) fn wait(&mut self, now: Instant) -> Duration {
        let due = *self.begun.get_or_insert(now) + Duration::from_secs_f64(self.frames as f64 / self.rate);
        self.frames += 1;
        due.saturating_duration_since(now)
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;
    use stages::generate::stream::Joining;

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
        // The rest of the sentence, with the remaining waypoints counted from its first frame.
        let ask = course.ask();
        assert!(course.is_pinned() && ask.frames == Some(2) && ask.waypoints.len() == 1 && ask.waypoints[0].frame == 1);
        assert_eq!(course.waypoints().map(|(frame, _)| frame).collect::<Vec<_>>(), [1, 4]);
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
