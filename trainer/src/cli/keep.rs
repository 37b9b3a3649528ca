//! Spans of time on a command line, such as `0:1s` and `-1s:`: the parts of an edited motion to keep.

use std::ops::Range;
use std::str::FromStr;

/// A point in time of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    value: f64,
    /// True for seconds, false for frames.
    seconds: bool,
    /// True if counted from the end.
    from_end: bool,
}

impl Place {
    fn frame(self, frames: usize, fps: f64) -> Option<usize> {
        let distance = (self.value * if self.seconds { fps } else { 1.0 }).round();
        if distance > frames as f64 {
            return None;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and the frames")]
        let distance = distance as usize;
        Some(if self.from_end { frames - distance } else { distance })
    }
}

impl FromStr for Place {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (from_end, number) = text.strip_prefix('-').map_or((false, text), |rest| (true, rest));
        let (seconds, number) = number.strip_suffix('s').map_or((false, number), |rest| (true, rest));
        let digits = number.chars().all(|c| c.is_ascii_digit() || (seconds && c == '.'));
        match number.parse::<f64>() {
            Ok(value) if digits && value.is_finite() => Ok(Self { value, seconds, from_end }),
            _ => Err(format!(
                "`{text}` is not a point in time; expected frames such as `20`, seconds such as `1.5s`, or either \
                 counted from the end, such as `-1s`"
            )),
        }
    }
}

/// A span of a motion; a missing end means the motion's end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Span {
    from: Option<Place>,
    to: Option<Place>,
}

impl FromStr for Span {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let place = |text: &str| if text.is_empty() { Ok(None) } else { text.parse().map(Some) };
        let (from, to) = text
            .split_once(':')
            .ok_or_else(|| format!("`{text}` is not a span; expected FROM:TO, such as `0:1s` or `-1s:`"))?;
        Ok(Self { from: place(from)?, to: place(to)? })
    }
}

impl Span {
    /// Returns the frames of the span in a motion of `frames`.
    ///
    /// # Errors
    /// If the span is outside the motion, or ends before it begins.
    pub(super) fn of(self, frames: usize, fps: f64) -> Result<Range<usize>, String> {
        let outside =
            || format!("a span to keep is outside the motion, which has {frames} frames, {:.2} s", frames as f64 / fps);
        let place = |place: Option<Place>, open: usize| match place {
            None => Ok(open),
            Some(place) => place.frame(frames, fps).ok_or_else(outside),
        };
        let (from, to) = (place(self.from, 0)?, place(self.to, frames)?);
        if from >= to {
            return Err(format!(
                "a span to keep goes from frame {from} to frame {to}; expected the earlier frame first"
            ));
        }
        Ok(from..to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_are_frames_or_seconds_from_either_end() {
        let of = |text: &str| text.parse::<Span>().and_then(|span| span.of(60, 20.0));
        for (text, frames) in [
            ("0:1s", 0..20),
            ("-1s:", 40..60),
            (":", 0..60),
            (":8", 0..8),
            ("1.5s:2s", 30..40),
            ("-30:-0.5s", 30..50),
            ("0:3s", 0..60),
        ] {
            assert_eq!(of(text), Ok(frames), "{text}");
        }
        for (text, words) in [
            ("1s", "expected FROM:TO"),
            ("a:b", "`a` is not a point in time"),
            ("0:1.5", "`1.5` is not a point"),
            ("0:infs", "not a point"),
            ("0:4s", "60 frames, 3.00 s"),
            ("-61:", "is outside"),
            ("2s:1s", "from frame 40 to frame 20"),
            ("20:20", "the earlier frame first"),
        ] {
            let refused = of(text).unwrap_err();
            assert!(refused.contains(words), "{text}: {refused}");
        }
    }
}
