//! A stream from standard input to standard output.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread;
use std::time::Instant;

use mocap::export::{Motion, Outs};
use motion::Skeleton;
use motion::waypoints::Waypoint;
use stages::generate::Generator;
use stages::generate::stream::{MotionStream, Segment};

use super::super::{model, out};
use super::course::{Course, Pace};
use super::line::{self, Form, Line, QUEUE};
use super::opening::Beginning;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result};

/// Limit of frames kept for files: an hour of HumanML3D, 19 MB.
const MOST_KEPT: usize = 72_000;

/// A sentence, or the reason of its refusal.
type Read = std::result::Result<Line, String>;

/// Reason for the end of a stream.
enum End {
    /// The input has ended, the stream has reached its limit of frames, or the output is closed.
    Quiet,
    /// A line is invalid.
    Line(String),
}

/// Reads lines on a separate thread. It ends with the process, because a blocked read cannot be interrupted.
fn lines(form: Form) -> Receiver<Read> {
    let (sender, lines) = sync_channel(QUEUE);
    thread::spawn(move || {
        let mut input = io::stdin().lock();
        let mut number = 0;
        while let Some(read) = line::next(&mut input) {
            number += 1;
            let read = match read {
                Ok(text) if text.trim().is_empty() => continue,
                Ok(text) => line::parse(number, &text, &form),
                Err(what) => Err(format!("line {number} {what}")),
            };
            let wrong = read.is_err();
            if sender.send(read).is_err() || wrong {
                break;
            }
        }
    });
    lines
}

/// Returns true if standard input is a file on disk, whose next line never has to be written first.
fn input_is_a_file() -> bool {
    let file = io::stdin().as_fd().try_clone_to_owned().map(File::from);
    file.and_then(|file| file.metadata()).is_ok_and(|metadata| metadata.is_file())
}

/// Frames kept for the output files.
#[derive(Default)]
struct Kept {
    joints: Vec<f32>,
    frames: usize,
    waypoints: Vec<Waypoint>,
    captions: Vec<String>,
}

impl Kept {
    fn sentence(&mut self, course: &Course, caption: &str) {
        let waypoints = course.waypoints().filter_map(|(frame, waypoint)| {
            let frame = usize::try_from(frame).ok().filter(|frame| *frame < MOST_KEPT)?;
            Some(Waypoint { frame, ..waypoint })
        });
        self.waypoints.extend(waypoints);
        if self.captions.len() < QUEUE {
            self.captions.push(caption.to_owned());
        }
    }

    fn frame(&mut self, joints: &[f64], skeleton: &Skeleton) {
        if self.frames < MOST_KEPT {
            self.joints.extend(joints.iter().map(|v| (v / skeleton.metres_per_unit) as f32));
            self.frames += 1;
        }
    }

    fn motion(self, label: &str, skeleton: &'static Skeleton) -> Motion {
        let frames = self.frames;
        Motion {
            caption: self.captions.join(", then "),
            note: label.to_owned(),
            skeleton,
            joints: self.joints,
            features: None,
            waypoints: self.waypoints.into_iter().filter(|waypoint| waypoint.frame < frames).collect(),
            kept: Vec::new(),
        }
    }
}

/// A stream with its input and output.
struct Pipe<'g> {
    generator: &'g Generator,
    stream: MotionStream,
    course: Course,
    lines: Receiver<Read>,
    /// Waits for the next line or the end of the input before each segment, so that the frames do not depend on the
    /// speed of the reading thread.
    waits: bool,
    /// A line that was read before its turn.
    next: Option<Read>,
    pace: Option<Pace>,
    kept: Option<Kept>,
    text: String,
}

impl Pipe<'_> {
    /// Starts the sentence of the next segment; returns `false` at the end of the input.
    fn turn(&mut self) -> std::result::Result<bool, End> {
        if self.course.is_pinned() {
            return Ok(true);
        }
        let read = match self.next.take() {
            Some(read) => read,
            None if self.waits || !self.course.has_begun() => match self.lines.recv() {
                Ok(read) => read,
                Err(_) => return Ok(false),
            },
            None => match self.lines.try_recv() {
                Ok(read) => read,
                Err(TryRecvError::Empty) => return Ok(true),
                Err(TryRecvError::Disconnected) => return Ok(false),
            },
        };
        let line = read.map_err(End::Line)?;
        let caption = line.caption.clone();
        self.course.take(line, self.stream.root()).map_err(End::Line)?;
        if let Some(kept) = &mut self.kept {
            kept.sentence(&self.course, &caption);
        }
        Ok(true)
    }

    /// Writes a segment up to the limit of frames; returns `false` if the stream has ended.
    fn give(&mut self, segment: &Segment, output: &mut impl Write) -> bool {
        for k in 0..segment.frames {
            if self.course.is_over() {
                return false;
            }
            if let Some(pace) = &mut self.pace {
                thread::sleep(pace.wait(Instant::now()));
            }
            self.text.clear();
            self.course.write(&mut self.text, segment, k);
            self.text.push('\n');
            let written = output.write_all(self.text.as_bytes());
            // With a pace, every frame is flushed. Otherwise the first frame of a segment and its end are.
            let flush = self.pace.is_some() || k == 0 || k + 1 == segment.frames;
            if written.and_then(|()| if flush { output.flush() } else { Ok(()) }).is_err() {
                return false;
            }
            self.course.given(segment, k);
            if let Some(kept) = &mut self.kept {
                kept.frame(self.course.joints(segment, k), self.stream.skeleton());
            }
            if self.pace.is_some() && !self.course.is_pinned() {
                self.next = self.next.take().or_else(|| self.lines.try_recv().ok());
                if self.next.is_some() {
                    self.stream.cut(k + 1);
                    break;
                }
            }
        }
        true
    }

    fn run(&mut self, output: &mut impl Write) -> Result<End> {
        loop {
            match self.turn() {
                Ok(true) => {}
                Ok(false) => return Ok(End::Quiet),
                Err(end) => return Ok(end),
            }
            let begun = Instant::now();
            let segment = self.stream.draw(self.generator, &self.course.ask()).map_err(model::refused)?;
            self.course.drawn(&segment, begun.elapsed());
            if !self.give(&segment, output) || self.course.is_over() {
                return Ok(End::Quiet);
            }
        }
    }
}

/// Streams until the input ends or the output is closed.
pub(super) fn run(
    generator: &Generator,
    beginning: Beginning,
    course: Course,
    pace: Option<f64>,
    (outs, report): (Outs, Output),
) -> Result<u8> {
    let skeleton = beginning.skeleton();
    let Beginning { label, stream, form } = beginning;
    let kept = (!outs.is_empty()).then(Kept::default);
    let lines = lines(form);
    let waits = pace.is_none() && input_is_a_file();
    let pace = pace.map(Pace::new);
    let mut pipe = Pipe { generator, stream, course, lines, waits, next: None, pace, kept, text: String::new() };
    let mut output = io::BufWriter::with_capacity(64 << 10, io::stdout().lock());
    let end = pipe.run(&mut output);
    // A closed output needs no more frames.
    let _ = output.flush();
    drop(output);
    let meter = &pipe.course.meter;
    if meter.frames() > 0 {
        print::note(&match report {
            Output::Json => meter.json().to_string(),
            Output::Table => format!("{label}: {}", meter.text()),
        });
    }
    if let Some(kept) = pipe.kept.take().filter(|kept| kept.frames > 0) {
        let motion = kept.motion(&label, skeleton);
        let mut written = outs.write(1, &motion).map_err(out::refused)?;
        written.extend(outs.finish(&label, &[(String::new(), vec![&motion])]).map_err(out::refused)?);
        let names: Vec<String> = out::names(&written).collect();
        if report == Output::Table {
            print::note(&format!("{} with {} frames", names.join(", "), motion.frames()));
        }
    }
    match end? {
        End::Quiet if !pipe.course.has_begun() => Err(Problem::usage("standard input: has no sentence")
            .hint("write one sentence per line, such as `a person walks`")),
        End::Quiet => Ok(0),
        End::Line(what) => Err(Problem::usage(format!("standard input: {what}"))),
    }
}
