//! A line of a stream's input: a sentence, optionally with a length and waypoints.

use std::io::{BufRead, Read as _};
use std::time::Instant;

use mocap::requests::{self, Length};
use motion::Skeleton;
use motion::waypoints::{self, Waypoint};
use serde_json::{Map, Value};

/// Limit of a line in bytes.
pub(super) const MOST_BYTES: usize = 64 << 10;
/// Limit of queued sentences; more are not read.
pub(super) const QUEUE: usize = 64;

/// A sentence of a stream.
#[derive(Debug, Clone)]
pub(super) struct Line {
    /// Line number in the input or message number on a connection, from 1.
    pub(super) number: u64,
    pub(super) caption: String,
    /// Minimum length.
    pub(super) frames: Option<usize>,
    /// In metres of the stream's world; the sentence's first frame is frame 0.
    pub(super) waypoints: Vec<Waypoint>,
    /// Time at which the line was read.
    pub(super) read: Instant,
}

/// Context of parsing a line.
#[derive(Debug, Clone)]
pub(super) struct Form {
    pub(super) skeleton: &'static Skeleton,
    /// Default joints of waypoints, and the joints used of other motions. If empty, the root and all joints.
    pub(super) joints: Vec<String>,
    /// True if the model has a control part.
    pub(super) controlled: bool,
}

/// Parses a line. It is text as in a file of sentences (`a person walks#4.5s`), or an object with `caption`, `frames`
/// or `seconds`, and `waypoints` as in a `.json` of waypoints.
///
/// # Errors
/// The mistake, with the line's number.
pub(super) fn parse(number: u64, text: &str, form: &Form) -> Result<Line, String> {
    let name = format!("line {number}");
    let refuse = |what: String| format!("{name}: {what}");
    let text = text.trim().trim_start_matches('\u{feff}');
    let mut waypoints_value = None;
    let request = if text.starts_with('{') {
        let mut fields: Map<String, Value> =
            serde_json::from_str(text).map_err(|error| refuse(format!("is not a JSON object: {error}")))?;
        waypoints_value = fields.remove("waypoints");
        requests::parse("line", &Value::Object(fields).to_string(), true)
    } else {
        requests::parse("line", text, text.starts_with('"'))
    };
    // The parsed text has only this line.
    let mut requests = request.map_err(|error| refuse(error.to_string().replacen("line:1: ", "", 1)))?;
    let request = requests.pop().ok_or_else(|| refuse("has no sentence".into()))?;
    let skeleton = form.skeleton;
    let mut frames = request.length.map(|length: Length| length.frames(skeleton.fps));
    let mut waypoints = Vec::new();
    if let Some(value) = waypoints_value {
        if !form.controlled {
            return Err(refuse("has waypoints, but the model has no control part, so it cannot follow a path".into()));
        }
        waypoints =
            waypoints::of_json(&value, skeleton, &form.joints).map_err(|why| refuse(format!("waypoints: {why}")))?;
        let end = waypoints.iter().map(|waypoint| waypoint.frame + 1).max().unwrap_or_default();
        let frames = *frames.get_or_insert(end);
        if let Some(outside) = waypoints.iter().find(|waypoint| waypoint.frame >= frames) {
            return Err(refuse(format!(
                "the waypoint of `{}` at {:.2} s is outside the sentence, whose {frames} frames end at {:.2} s; \
                 expected a length of at least {end} frames",
                skeleton.names[outside.joint],
                outside.frame as f64 / skeleton.fps,
                frames.saturating_sub(1) as f64 / skeleton.fps
            )));
        }
    }
    Ok(Line { number, caption: request.caption, frames, waypoints, read: Instant::now() })
}

/// Reads the next line, with or without a line ending; `None` at the end of the input.
///
/// # Errors
/// If the line is too long or no text, or if reading fails.
pub(super) fn next(input: &mut impl BufRead) -> Option<Result<String, String>> {
    let mut bytes = Vec::new();
    match input.by_ref().take(MOST_BYTES as u64 + 1).read_until(b'\n', &mut bytes) {
        Ok(0) => None,
        Ok(_) if bytes.len() > MOST_BYTES => Some(Err(format!("is longer than {MOST_BYTES} bytes"))),
        Ok(_) => Some(String::from_utf8(bytes).map_err(|_| "is not UTF-8 text".to_owned())),
        Err(error) => Some(Err(format!("cannot be read: {error}"))),
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;

    use super::*;

    fn form(controlled: bool) -> Form {
        Form { skeleton: Skeleton::of(DataFormat::Humanml3d), joints: vec![], controlled }
    }

    #[test]
    fn a_line_is_text_or_an_object() {
        let read = |text: &str| {
            let line = parse(3, text, &form(true)).unwrap();
            (line.caption, line.frames, line.waypoints.len())
        };
        assert_eq!(read("a person walks\r\n"), ("a person walks".into(), None, 0));
        assert_eq!(read("walks#4.5s"), ("walks".into(), Some(90), 0));
        assert_eq!(read("\"walks\""), ("walks".into(), None, 0));
        assert_eq!(read(r#"{"caption": "walks", "seconds": 2}"#), ("walks".into(), Some(40), 0));
        let controlled = r#"{"caption": "walks", "waypoints": [[0, 0, 0.9, 0], [1.5, 0, 0.9, 1]]}"#;
        assert_eq!(read(controlled), ("walks".into(), Some(31), 2), "as long as its path");
        let longer = r#"{"caption": "w", "seconds": 4, "waypoints": {"left_wrist": [[1, 0, 1, 1]]}}"#;
        assert_eq!(read(longer), ("w".into(), Some(80), 1));
    }

    #[test]
    fn mistakes_are_named_with_the_line() {
        protocol::show_excerpts();
        for (text, controlled, words) in [
            ("walks#soon", true, &["line 3: `soon` is not a length"][..]),
            ("{\"caption\": \"a\"", true, &["line 3: is not a JSON object"]),
            (r#"{"text": "a"}"#, true, &["line 3:", "`text`"]),
            (r#"{"caption": "a", "waypoints": [[0, 0, 1]]}"#, true, &["line 3: waypoints: path[0]", "[t, x, y, z]"]),
            (r#"{"caption": "a", "waypoints": {"tail": [[0, 0, 1, 0]]}}"#, true, &["`tail` is not a joint"]),
            (r#"{"caption": "a", "waypoints": [[0, 0, 1, 0], [0.1, 9, 1, 0]]}"#, true, &["m/s"]),
            (
                r#"{"caption": "a", "seconds": 1, "waypoints": [[3, 0, 1, 0]]}"#,
                true,
                &["`pelvis` at 3.00 s is outside", "20 frames end at 0.95 s", "61 frames"],
            ),
            (r#"{"caption": "a", "waypoints": [[0, 0, 1, 0]]}"#, false, &["no control part"]),
        ] {
            let refused = parse(3, text, &form(controlled)).unwrap_err();
            for word in words {
                assert!(refused.contains(word), "{text}: {refused}");
            }
        }
    }

    #[test]
    fn lines_are_bounded() {
        let mut input = std::io::Cursor::new("a\n\nb".as_bytes().to_vec());
        let mut read = || next(&mut input).map(|line| line.unwrap());
        assert_eq!((read(), read(), read(), read()), (Some("a\n".into()), Some("\n".into()), Some("b".into()), None));
        let mut long = std::io::Cursor::new(vec![b'a'; MOST_BYTES + 1]);
        assert!(next(&mut long).unwrap().unwrap_err().contains("65536 bytes"));
        let mut binary = std::io::Cursor::new(vec![0xff, b'\n']);
        assert!(next(&mut binary).unwrap().unwrap_err().contains("UTF-8"));
    }

    proptest::proptest! {
        /// Every line is parsed or refused with a reason.
        #[test]
        fn no_text_breaks_the_reader(text in "(\\{\"caption\":\"a\",\"waypoints\":)?(?s).{0,120}") {
            let _ = parse(1, &text, &form(true)).map_err(|why| assert!(why.starts_with("line 1: "), "{why}"));
        }
    }
}
