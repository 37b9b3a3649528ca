//! Sentences on a command line and in files, with lengths and seeds.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::Args;
use clap::error::ErrorKind;
use mocap::requests::{self, Length, Request};
use protocol::units::counted;

use super::args::whole;
use crate::report::problem::{Problem, Result};

/// Limit of the motions of one command.
const MOST: usize = 1_000;

/// Lengths, seeds and further sentences.
#[derive(Debug, Args)]
pub(super) struct SentenceArgs {
    /// More sentences, from a file with one per line: text, optionally followed by `#` and a length
    /// (`a person walks#120` frames, `a person walks#4.5s`), or JSON lines, {"caption": "a person walks", "seconds":
    /// 4.5}; `-` is standard input
    #[arg(long, value_name = "FILE")]
    captions: Option<PathBuf>,
    /// Length in frames: one for all sentences, or one for each [default: the model's length estimate, 120 without an
    /// estimator]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = frames, allow_negative_numbers = true)]
    frames: Vec<u32>,
    /// Length in seconds, likewise
    #[arg(long, value_name = "S", value_delimiter = ',', conflicts_with = "frames", value_parser = seconds, allow_negative_numbers = true)]
    seconds: Vec<Length>,
    /// Motions per sentence, with consecutive seeds
    #[arg(short = 'n', long = "seeds", value_name = "N", default_value_t = 1, value_parser = seeds, allow_negative_numbers = true)]
    seeds: u16,
    /// First seed; other seeds give other motions
    #[arg(long, default_value_t = 0, value_parser = whole::<0>, allow_negative_numbers = true)]
    seed: u64,
}

/// Parses a length in frames: at most 50 hours.
fn frames(text: &str) -> std::result::Result<u32, String> {
    let number = text.parse().ok().filter(|number| (1..=3_600_000).contains(number));
    number.ok_or_else(|| "expected a whole number of frames, 1 to 3,600,000; --seconds takes seconds".to_owned())
}

/// Parses a number of motions.
fn seeds(text: &str) -> std::result::Result<u16, String> {
    let number = text.parse().ok().filter(|number| (1..=1_000).contains(number));
    number.ok_or_else(|| "expected a whole number of motions, 1 to 1,000".to_owned())
}

/// Parses seconds with or without their unit: `4` and `4s`.
fn seconds(text: &str) -> std::result::Result<Length, String> {
    let number = text.strip_suffix('s').unwrap_or(text).trim_end();
    if number.parse::<f64>().is_err() {
        return Err("expected seconds, such as 4.5 or 4.5s; --frames takes frames".to_owned());
    }
    format!("{number}s").parse()
}

/// Refuses several prompts of one word each. They are usually a sentence without quotes, which would give one motion
/// per word.
fn check_quotes(prompts: &[String]) -> Result<()> {
    if prompts.len() < 2 || prompts.iter().any(|prompt| prompt.contains(char::is_whitespace)) {
        return Ok(());
    }
    let sentence = prompts.join(" ");
    let (count, lines) = (prompts.len(), prompts.join("\\n"));
    Err(Problem::usage(format!("`{sentence}` without quotes is {count} sentences of one word each")).hint(format!(
        "for one motion, write \"{sentence}\"; for {count} motions, pass the words as lines: printf '{lines}\\n' | \
         trainer generate --captions - ..."
    )))
}

/// Explains a refused `trainer generate a person walks`: its missing quotes matter more than its missing options.
/// `words` are the arguments of the process.
pub(super) fn without_quotes(error: &clap::Error, words: impl Iterator<Item = OsString>) -> Option<Problem> {
    let mut words = words.map(|word| word.to_string_lossy().into_owned());
    if error.kind() != ErrorKind::MissingRequiredArgument || words.next()? != "generate" {
        return None;
    }
    check_quotes(&words.take_while(|word| !word.starts_with('-')).collect::<Vec<_>>()).err()
}

impl SentenceArgs {
    /// Returns the sentences of the command line, then those of the file, each with its length. Without any, returns
    /// `others`.
    ///
    /// # Errors
    /// If the file cannot be read, the lengths do not match the sentences, or there are too many motions.
    pub(super) fn requests(&self, prompts: &[String], others: &[&str]) -> Result<Vec<Request>> {
        let plain = |caption: String| Request { caption, length: None };
        check_quotes(prompts)?;
        let mut requests: Vec<Request> = prompts.iter().cloned().map(plain).collect();
        if let Some(file) = &self.captions {
            requests.extend(requests::read(file).map_err(Problem::usage)?);
        }
        if requests.is_empty() {
            requests.extend(others.iter().map(|caption| plain((*caption).to_owned())));
        }
        let frames = self.frames.iter().map(|frames| Length::Frames(*frames as usize));
        let lengths: Vec<Length> = frames.chain(self.seconds.iter().copied()).collect();
        match lengths.as_slice() {
            [] => {}
            [one] => requests.iter_mut().for_each(|request| request.length = request.length.or(Some(*one))),
            each if each.len() == requests.len() => {
                requests.iter_mut().zip(each).for_each(|(request, length)| request.length = Some(*length));
            }
            each => {
                let (lengths, sentences) = (each.len(), requests.len());
                return Err(Problem::usage(format!(
                    "there are {lengths} lengths for {}; give one length for all sentences, or one for each",
                    counted(sentences, "sentence")
                )));
            }
        }
        let motions = requests.len() * self.seeds().len();
        if motions > MOST {
            return Err(Problem::usage(format!(
                "{motions} motions were requested; one command generates at most {MOST}"
            )));
        }
        Ok(requests)
    }

    /// The seeds for each sentence.
    pub(super) fn seeds(&self) -> Vec<u64> {
        (0..u64::from(self.seeds)).map(|k| self.seed.wrapping_add(k)).collect()
    }

    /// The first seed.
    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    /// Frames after which a stream ends; `None` if it is endless.
    ///
    /// # Errors
    /// If there are several lengths.
    pub(super) fn bound(&self, fps: f64) -> Result<Option<u64>> {
        let frames = self.frames.iter().map(|frames| Length::Frames(*frames as usize));
        let lengths: Vec<Length> = frames.chain(self.seconds.iter().copied()).collect();
        match lengths.as_slice() {
            [] => Ok(None),
            [one] => Ok(Some(one.frames(fps) as u64)),
            each => {
                let why = format!(
                    "there are {} lengths for one stream; give the length of a sentence in its line",
                    each.len()
                );
                Err(Problem::usage(why))
            }
        }
    }

    /// Returns true if a sentence has its own length.
    pub(super) fn have_length(requests: &[Request]) -> bool {
        requests.iter().any(|request| request.length.is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args() -> SentenceArgs {
        SentenceArgs { captions: None, frames: vec![], seconds: vec![], seeds: 1, seed: 7 }
    }

    #[test]
    fn lengths_are_for_all_or_for_each_and_a_files_own_come_first() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.txt");
        std::fs::write(&file, "runs\njumps#2s\n").unwrap();
        let lengths = |args: SentenceArgs| {
            let requests = args.requests(&["walks".to_owned()], &["x"]).map_err(|problem| problem.error.to_string());
            requests.map(|all| all.into_iter().map(|request| request.length).collect::<Vec<_>>())
        };
        let frames = |n| Some(Length::Frames(n));
        let captions = Some(file);
        assert_eq!(lengths(args()), Ok(vec![None]));
        assert_eq!(lengths(SentenceArgs { frames: vec![80], ..args() }), Ok(vec![frames(80)]));
        let all = SentenceArgs { captions: captions.clone(), frames: vec![80], ..args() };
        assert_eq!(lengths(all), Ok(vec![frames(80), frames(80), Some(Length::Seconds(2.0))]));
        let seconds = ["4", "1.5", "3"].map(|text| seconds(text).unwrap()).to_vec();
        let each = SentenceArgs { captions: captions.clone(), seconds: seconds.clone(), ..args() };
        assert_eq!(lengths(each), Ok(seconds.into_iter().map(Some).collect()));
        let two = lengths(SentenceArgs { captions, frames: vec![1, 2], ..args() }).unwrap_err();
        assert!(two.contains("2 lengths for 3 sentences"), "{two}");
        let missing = lengths(SentenceArgs { captions: Some("none.txt".into()), ..args() }).unwrap_err();
        assert!(missing.contains("none.txt"), "{missing}");
    }

    #[test]
    fn a_sentence_without_quotes_is_refused_with_both_readings() {
        let requests = |prompts: &[&str]| {
            let prompts: Vec<String> = prompts.iter().map(|prompt| (*prompt).to_owned()).collect();
            args().requests(&prompts, &[])
        };
        let refused = requests(&["a", "person", "walks"]).unwrap_err();
        assert_eq!(refused.error.to_string(), "`a person walks` without quotes is 3 sentences of one word each");
        let hint = refused.hint.unwrap();
        assert!(hint.contains("\"a person walks\"") && hint.contains("--captions -"), "{hint}");
        for (prompts, motions) in [(&["jumps"][..], 1), (&["a person walks", "jumps"], 2), (&["a person walks"], 1)] {
            assert_eq!(requests(prompts).unwrap().len(), motions, "{prompts:?}");
        }
    }

    #[test]
    fn seconds_may_have_their_unit() {
        for text in ["4", "4s", "4 s"] {
            assert_eq!(seconds(text), Ok(Length::Seconds(4.0)), "{text}");
        }
        assert!(seconds("-4").unwrap_err().contains("expected more than 0"));
        assert!(seconds("4ss").unwrap_err().contains("expected seconds, such as 4.5"));
    }

    #[test]
    fn seeds_follow_one_another_and_motions_are_bounded() {
        assert_eq!(SentenceArgs { seeds: 3, seed: u64::MAX, ..args() }.seeds(), [u64::MAX, 0, 1]);
        let others = args().requests(&[], &["walks", "runs"]).unwrap();
        assert_eq!(others.len(), 2);
        let many = SentenceArgs { seeds: 501, ..args() }.requests(&[], &["walks", "runs"]).unwrap_err();
        assert!(many.error.to_string().contains("1002 motions"));
        assert!(seconds("0").is_err() && seconds("soon").is_err() && seconds("nan").is_err());
    }
}
