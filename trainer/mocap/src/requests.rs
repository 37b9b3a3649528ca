//! Sentences of a file, each with the length of its motion.
//!
//! There are two forms, one sentence per line; blank lines are ignored:
//!
//! - text: `a person walks`, or with a length after the last `#`, `a person walks#120` in frames, `a person walks#4.5s`
//!   in seconds (MoMask's files have frames too, and `#NA` for no length);
//! - JSON lines: `{"caption": "a person walks", "seconds": 4.5}` or with `frames`; or a sentence alone, `"a person
//!   walks"`.
//!
//! The extensions `.jsonl`, `.ndjson` and `.json` mean JSON lines, `.txt` means text. For any other file, and for
//! standard input, the first line decides: JSON starts with `{` or `"`.

use std::fmt;
use std::io::Read;
use std::path::Path;
use std::str::FromStr;

use motion::DataPath;
use serde::Deserialize;

/// Largest size of a file, in bytes.
const MOST_BYTES: u64 = 4 << 20;
/// Largest size of a sentence, in bytes.
const MOST_CAPTION: usize = 8 << 10;
/// Largest number of sentences in a file.
pub const MOST: usize = 1_000;
/// Largest number of mistakes shown for one file.
const MOST_MISTAKES: usize = 20;
/// Upper limit of a length, in seconds.
const LONGEST: f64 = 3600.0;

/// Length of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Length {
    /// Length in frames.
    Frames(usize),
    /// Length in seconds.
    Seconds(f64),
}

impl Length {
    /// Converts to frames at `fps`, at least one.
    pub fn frames(self, fps: f64) -> usize {
        match self {
            Self::Frames(frames) => frames,
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and an hour")]
            Self::Seconds(seconds) => ((seconds * fps).round() as usize).max(1),
        }
    }

    fn seconds(value: f64) -> Result<Self, String> {
        if value > 0.0 && value <= LONGEST {
            Ok(Self::Seconds(value))
        } else {
            Err(format!("the length is {value} s; expected more than 0 and at most {LONGEST}"))
        }
    }

    fn of_frames(value: usize) -> Result<Self, String> {
        // An hour at 1,000 frames a second; each model has its own lower limit.
        if (1..=3_600_000).contains(&value) {
            Ok(Self::Frames(value))
        } else {
            Err(format!("the length is {value} frames; expected 1 to 3600000"))
        }
    }
}

impl FromStr for Length {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let shown = protocol::excerpt(text);
        let expected =
            || format!("`{shown}` is not a length; expected frames such as `120`, or seconds such as `4.5s`");
        match text.strip_suffix('s') {
            Some(number) => Self::seconds(number.parse().map_err(|_| expected())?),
            None => Self::of_frames(text.parse().map_err(|_| expected())?),
        }
    }
}

/// A sentence and its length.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Description of the motion.
    pub caption: String,
    /// Length of the motion, if the file states it.
    pub length: Option<Length>,
}

/// All mistakes in a file of sentences.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct RequestError {
    /// Mistakes, each with its line.
    mistakes: Vec<String>,
}

impl fmt::Display for RequestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.mistakes.join("\n"))
    }
}

impl From<String> for RequestError {
    fn from(mistake: String) -> Self {
        Self { mistakes: vec![mistake] }
    }
}

/// Reads a file, or standard input for `-`.
///
/// # Errors
/// All invalid lines, or a file that is missing or too long.
pub fn read(file: &Path) -> Result<Vec<Request>, RequestError> {
    let stdin = file == Path::new("-");
    let name = if stdin { "standard input".to_owned() } else { file.display().to_string() };
    let failed = |error: std::io::Error| RequestError::from(format!("{name}: {error}"));
    let bytes = if stdin {
        let mut bytes = Vec::new();
        std::io::stdin().lock().take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(failed)?;
        if bytes.len() as u64 > MOST_BYTES {
            return Err(format!("{name}: has more than {MOST_BYTES} bytes, the largest supported size").into());
        }
        bytes
    } else {
        DataPath::local(file).read(MOST_BYTES).map_err(failed)?
    };
    let text = String::from_utf8(bytes).map_err(|_| format!("{name}: is not UTF-8 text"))?;
    let ending = file.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
    let json = match ending.as_str() {
        "jsonl" | "ndjson" | "json" => true,
        "txt" => false,
        _ => text.trim_start_matches('\u{feff}').trim_start().starts_with(['{', '"']),
    };
    parse(&name, &text, json)
}

/// Parses the lines of a text; `name` is only its name in errors.
///
/// # Errors
/// All invalid lines, or a text without lines.
pub fn parse(name: &str, text: &str, json: bool) -> Result<Vec<Request>, RequestError> {
    let lines = text.trim_start_matches('\u{feff}').lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let mut requests = Vec::new();
    let mut mistakes = Vec::new();
    for (i, line) in lines {
        let read = if json { of_json(line) } else { of_text(line.trim()) };
        let read = read.and_then(|request| match request.caption.len() {
            0..=MOST_CAPTION => Ok(request),
            bytes => Err(format!("the sentence has {bytes} bytes; expected at most {MOST_CAPTION}")),
        });
        match read {
            Ok(request) => requests.push(request),
            Err(what) => mistakes.push(format!("{name}:{}: {what}", i + 1)),
        }
        if requests.len() > MOST {
            mistakes.push(format!("{name}: has more than {MOST} sentences; split them into several files"));
        }
        if requests.len() > MOST || mistakes.len() >= MOST_MISTAKES {
            break;
        }
    }
    if requests.is_empty() && mistakes.is_empty() {
        mistakes.push(format!("{name}: has no sentence"));
    }
    if mistakes.is_empty() { Ok(requests) } else { Err(RequestError { mistakes }) }
}

fn of_text(line: &str) -> Result<Request, String> {
    let Some((caption, length)) = line.rsplit_once('#') else {
        return Ok(Request { caption: line.to_owned(), length: None });
    };
    let length = length.trim();
    let length = if length.eq_ignore_ascii_case("na") { None } else { Some(length.parse()?) };
    Ok(Request { caption: caption.trim().to_owned(), length })
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    caption: String,
    frames: Option<usize>,
    seconds: Option<f64>,
}

fn of_json(line: &str) -> Result<Request, String> {
    if let Ok(caption) = serde_json::from_str::<String>(line) {
        return Ok(Request { caption, length: None });
    }
    let fields: Fields = serde_json::from_str(line).map_err(|error| {
        let error = protocol::excerpt(&error.to_string());
        format!("{error}; expected a line such as {{\"caption\": \"a person walks\", \"seconds\": 4.5}}")
    })?;
    let length = match (fields.frames, fields.seconds) {
        (None, None) => None,
        (Some(frames), None) => Some(Length::of_frames(frames)?),
        (None, Some(seconds)) => Some(Length::seconds(seconds)?),
        (Some(_), Some(_)) => return Err("has both `frames` and `seconds`; expected one of them".into()),
    };
    Ok(Request { caption: fields.caption, length })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(caption: &str, length: Option<Length>) -> Request {
        Request { caption: caption.into(), length }
    }

    #[test]
    fn both_forms_say_the_same() {
        let expected = [
            request("a person walks", None),
            request("a man, \"waving\"", Some(Length::Frames(120))),
            request("走", Some(Length::Seconds(4.5))),
            request("jumps", None),
        ];
        let text = "\u{feff}a person walks\r\n\n  a man, \"waving\" # 120 \n走#4.5s\njumps#NA\n";
        assert_eq!(parse("x", text, false).unwrap(), expected);
        let json = "{\"caption\": \"a person walks\"}\n\n{\"caption\": \"a man, \\\"waving\\\"\", \"frames\": 120}\n\
                    {\"seconds\": 4.5, \"caption\": \"走\"}\n\"jumps\"\n";
        assert_eq!(parse("x", json, true).unwrap(), expected);
        assert_eq!(parse("x", "{\"caption\": \"\"}", true).unwrap(), [request("", None)], "the empty sentence is one");
        assert_eq!((Length::Seconds(4.5).frames(12.5), Length::Seconds(0.001).frames(20.0)), (56, 1));
    }

    #[test]
    fn the_ending_or_the_first_line_tells_the_form() {
        let folder = tempfile::tempdir().unwrap();
        for (name, text, caption) in [
            ("a.txt", "{walks}", "{walks}"),
            ("a.jsonl", "\"walks\"", "walks"),
            ("a", "{\"caption\": \"walks\"}", "walks"),
            ("b", "walks", "walks"),
        ] {
            let file = folder.path().join(name);
            std::fs::write(&file, text).unwrap();
            assert_eq!(read(&file).unwrap(), [request(caption, None)], "{name}");
        }
        let refused = read(&folder.path().join("none.txt")).unwrap_err().to_string();
        assert!(refused.contains("none.txt"), "{refused}");
        assert!(read(folder.path()).unwrap_err().to_string().contains("a folder"));
        std::fs::write(folder.path().join("c.txt"), [0xff, 0xfe]).unwrap();
        assert!(read(&folder.path().join("c.txt")).unwrap_err().to_string().contains("UTF-8"));
    }

    #[test]
    fn every_mistake_is_named_with_its_line() {
        for (text, json, words) in [
            ("", false, &["x: has no sentence"][..]),
            (
                "walks#soon\nruns\njumps#0",
                false,
                &[
                    "x:1: `soon` is not a length",
                    "4.5s",
                    "x:3: the length is 0 \
                                                                                           frames",
                ],
            ),
            ("walks#-1s", false, &["x:1: the length is -1 s"]),
            ("walks#infs", false, &["x:1: the length is inf s"]),
            ("{\"caption\": \"a\", \"frames\": 1, \"seconds\": 1}", true, &["x:1: has both"]),
            ("{\"text\": \"a\"}", true, &["x:1:", "`text`", "\"caption\""]),
            ("{\"caption\": \"a\", \"frames\": -3}", true, &["x:1:"]),
            ("\"a\"\n{", true, &["x:2:"]),
        ] {
            let refused = parse("x", text, json).unwrap_err().to_string();
            for word in words {
                assert!(refused.contains(word), "{text:?}: {refused}");
            }
        }
        let long = parse("x", &"a".repeat(9_000), false).unwrap_err().to_string();
        assert!(long.contains("9000 bytes"), "{long}");
        let many = parse("x", &"a\n".repeat(1_001), false).unwrap_err().to_string();
        assert!(many.contains("more than 1000"), "{many}");
        let wrong = parse("x", &"a#b\n".repeat(1_001), false).unwrap_err().to_string();
        assert_eq!(wrong.lines().count(), 20);
    }

    proptest::proptest! {
        /// A line is read or explained.
        #[test]
        fn no_text_breaks_the_reader(text in "(?s).{0,200}", json in proptest::prelude::any::<bool>()) {
            if let Ok(requests) = parse("x", &text, json) {
                proptest::prop_assert!(!requests.is_empty());
            }
        }
    }
}
