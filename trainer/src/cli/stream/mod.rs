//! `trainer generate --stream`: sentences in, motion out, without end. Decision 0012.

mod course;
mod engine;
mod line;
mod listen;
mod pipe;
mod real;
mod report;

use std::net::SocketAddr;
use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use motion::Skeleton;
use protocol::Seed;
use stages::generate::Generator;
use stages::stream::{BLEND, MotionStream, Settings};

use self::course::Course;
use self::line::Form;
use self::report::{Meter, Real};
use super::door::DoorArgs;
use super::model::{self, Found};
use super::sampler::SamplerArgs;
use crate::problem::{Problem, Result};

#[derive(Debug, Args)]
pub(super) struct StreamArgs {
    /// Reads sentences on stdin while it draws, and prints a line of JSON a frame on stdout: frame, time, segment, line, sentence, and joints in metres of one world. A line is
    /// text (`a person walks#4.5s`) or `{"caption": "a person walks", "seconds": 4.5, "waypoints": [[t, x, y, z]]}`, with times from its first frame and positions in the
    /// world, which the stream enters at x = z = 0 facing z. A sentence goes on until the next line; the stream ends after the segment at which stdin ends, or at --frames or --seconds.
    /// Segments go on where the last one stopped: a control part is told its last frames, a masked token model keeps their tokens, any other model's motion is laid on its
    /// last frame; what differs fades over --blend frames. -o keeps what was streamed, an hour at most
    #[arg(long, conflicts_with_all = ["prompt", "captions", "edit", "control", "seeds", "positions", "features", "plant_feet"])]
    stream: bool,
    /// Gives frames out no faster than this [default: the data's frame rate]; a new line then takes over at once, unless the sentence has a length
    #[arg(long, value_name = "FPS", requires = "stream", value_parser = rate)]
    pace: Option<Option<f64>>,
    /// Frames of the stream that the next segment is told or keeps [default: as trained, else a quarter of the segment]
    #[arg(long, value_name = "FRAMES", requires = "stream", value_parser = clap::value_parser!(u16).range(1..))]
    overlap: Option<u16>,
    /// Frames in which what differs at a junction fades
    #[arg(long, value_name = "FRAMES", default_value_t = BLEND as u16, requires = "stream")]
    blend: u16,
    /// Holds junctions against this motion, a .npy or the training clips of a dataset folder [default: against the stream's own frames]
    #[arg(long, value_name = "PATH", requires = "stream")]
    real: Option<PathBuf>,
    /// Answers WebSockets at /v1/stream instead of reading stdin, always paced: a message is a line, a frame is a message
    #[arg(long, value_name = "HOST:PORT", requires_all = ["stream", "listen_token_file"], conflicts_with = "out")]
    listen: Option<SocketAddr>,
    /// Who may listen: tokens with the scope `read`, as `trainer serve --token-file` has them
    #[arg(long, env = "STRIDE_LISTEN_TOKEN_FILE", value_name = "FILE")]
    listen_token_file: Option<PathBuf>,
    /// Streams at once
    #[arg(long, value_name = "N", default_value_t = 4, requires = "listen", value_parser = clap::value_parser!(u16).range(1..=256))]
    streams: u16,
    #[command(flatten)]
    door: DoorArgs,
}

fn rate(text: &str) -> std::result::Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|rate| (0.1..=1000.0).contains(rate));
    value.ok_or_else(|| format!("`{text}` is no rate; expected 0.1 to 1000 frames per second"))
}

impl StreamArgs {
    /// Whether a stream is wanted.
    pub(super) fn is_wanted(&self) -> bool {
        self.stream
    }
}

/// What a stream is opened with, besides its own options.
#[derive(Debug)]
pub(super) struct Opening {
    pub(super) found: Found,
    pub(super) device: Device,
    pub(super) steps: Option<usize>,
    pub(super) sampler: SamplerArgs,
    pub(super) seed: u64,
    /// How strongly positions are heeded.
    pub(super) scale: f64,
    pub(super) joints: Vec<String>,
}

/// What all streams of a process begin with. It has no tensors.
#[derive(Debug, Clone)]
struct Beginning {
    label: String,
    stream: MotionStream,
    form: Form,
}

impl Beginning {
    fn skeleton(&self) -> &'static Skeleton {
        self.form.skeleton
    }

    fn course(&self, bound: Option<u64>, real: Option<Real>) -> Course {
        let meter = Meter::new(self.skeleton().fps, self.stream.joining(), real);
        Course::new(self.skeleton(), bound, meter)
    }
}

impl Opening {
    /// Loads the model.
    fn open(self, overlap: Option<u16>, blend: u16) -> Result<(Generator, Beginning)> {
        let Found { manifest, blobs, label, measured } = self.found;
        let label = label.to_string();
        let generator = Generator::load(&manifest, &blobs, &self.device).map_err(Problem::failed)?;
        let sampler = self.sampler.sampler(self.steps, generator.sampler(), &measured);
        let sampler = sampler.map_err(|why| Problem::usage(format!("{label}: {why}")))?;
        let settings = Settings {
            sampler: Some(sampler),
            seed: Seed(self.seed),
            scale: self.scale,
            overlap: overlap.map(usize::from),
            blend: usize::from(blend),
        };
        let stream = MotionStream::new(&generator, settings).map_err(model::refused)?;
        let controlled = generator.control().is_some();
        let form = Form { skeleton: stream.skeleton(), joints: self.joints, controlled };
        Ok((generator, Beginning { label, stream, form }))
    }
}

/// Streams until its input or its output ends. `bound` gives the frames at a rate after which it does in any case.
pub(super) async fn stream(
    args: StreamArgs,
    opening: Opening,
    out: super::out::OutArgs,
    bound: impl Fn(f64) -> Result<Option<u64>>,
) -> Result<u8> {
    if args.listen.is_some() {
        return listen::listen(args, opening, bound).await;
    }
    let outs = out.files(1)?;
    let (generator, beginning) = opening.open(args.overlap, args.blend)?;
    let skeleton = beginning.skeleton();
    let real = args.real.as_deref().map(|path| real::read(path, skeleton)).transpose()?;
    let course = beginning.course(bound(skeleton.fps)?, real);
    let pace = args.pace.map(|rate| rate.unwrap_or(skeleton.fps));
    pipe::run(&generator, beginning, course, pace, (outs, out.report()))
}
