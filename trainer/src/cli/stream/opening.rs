//! The options of a stream, and its initial state: a loaded model and its settings.

use std::net::SocketAddr;
use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use motion::Skeleton;
use protocol::Seed;
use stages::generate::Generator;
use stages::generate::stream::{BLEND, MotionStream, Settings};
use stages::parts::control::ControlOptions;

use super::super::endpoint_args::EndpointArgs;
use super::super::model::{self, Found};
use super::super::sampler::SamplerArgs;
use super::course::Course;
use super::line::Form;
use super::report::{Meter, Real};
use crate::report::problem::{Problem, Result};

#[derive(Debug, Args)]
pub(in crate::cli) struct StreamArgs {
    /// Reads sentences on stdin during generation, and prints one line of JSON per frame on stdout: frame, time,
    /// segment, line, sentence, and joints in metres of one world. A line is text (`a person walks#4.5s`) or
    /// `{"caption": "a person walks", "seconds": 4.5, "waypoints": [[t, x, y, z]]}`, with times from its first frame
    /// and positions in the world, which the stream enters at x = z = 0 facing z. A sentence lasts until the next line;
    /// the stream ends after the segment at which stdin ends, or at --frames or --seconds. Segments continue where the
    /// last one stopped: a control part gets its last frames, a masked token model keeps their tokens, and the motion
    /// of any other model is aligned with its last frame; differences fade over --blend frames. -o keeps the stream, an
    /// hour at most
    #[arg(long, conflicts_with_all = ["prompt", "captions", "edit", "control", "seeds", "positions", "features", "plant_feet"])]
    stream: bool,
    /// Emits frames no faster than this [default: the data's frame rate]; a new line then takes over at once, unless
    /// the sentence has a length
    #[arg(long, value_name = "FPS", requires = "stream", value_parser = rate)]
    pub(super) pace: Option<Option<f64>>,
    /// Frames of the stream that condition the next segment [default: as trained, else a quarter of the segment]
    #[arg(long, value_name = "FRAMES", requires = "stream", value_parser = clap::value_parser!(u16).range(1..))]
    pub(super) overlap: Option<u16>,
    /// Frames over which a difference at a junction fades
    #[arg(long, value_name = "FRAMES", default_value_t = BLEND as u16, requires = "stream")]
    pub(super) blend: u16,
    /// Compares junctions with this motion, a .npy or the training clips of a dataset folder [default: the stream's own
    /// frames]
    #[arg(long, value_name = "PATH", requires = "stream")]
    pub(super) real: Option<PathBuf>,
    /// Serves WebSockets at /v1/stream instead of reading stdin, always paced: one message per line, one message per
    /// frame
    #[arg(long, value_name = "HOST:PORT", requires_all = ["stream", "listen_token_file"], conflicts_with = "out")]
    pub(super) listen: Option<SocketAddr>,
    /// Tokens of the allowed clients, with the scope `read`, in a file as for `trainer serve --token-file`
    #[arg(long, env = "STRIDE_LISTEN_TOKEN_FILE", value_name = "FILE")]
    pub(super) listen_token_file: Option<PathBuf>,
    /// Limit of concurrent streams
    #[arg(long, value_name = "N", default_value_t = 4, requires = "listen", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub(super) streams: u16,
    #[command(flatten)]
    pub(super) endpoint: EndpointArgs,
}

fn rate(text: &str) -> std::result::Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|rate| (0.1..=1000.0).contains(rate));
    value.ok_or_else(|| format!("`{text}` is not a frame rate; expected 0.1 to 1000 frames per second"))
}

impl StreamArgs {
    /// Returns true if `--stream` is given.
    pub(in crate::cli) fn is_wanted(&self) -> bool {
        self.stream
    }
}

/// Settings of a stream, besides its own options.
#[derive(Debug)]
pub(in crate::cli) struct Opening {
    pub(in crate::cli) found: Found,
    pub(in crate::cli) device: Device,
    pub(in crate::cli) steps: Option<usize>,
    pub(in crate::cli) sampler: SamplerArgs,
    pub(in crate::cli) seed: u64,
    /// Strength of the control.
    pub(in crate::cli) control: ControlOptions,
    pub(in crate::cli) joints: Vec<String>,
}

/// Initial state of all streams of a process. It has no tensors.
#[derive(Debug, Clone)]
pub(super) struct Beginning {
    pub(super) label: String,
    pub(super) stream: MotionStream,
    pub(super) form: Form,
}

impl Beginning {
    pub(super) fn skeleton(&self) -> &'static Skeleton {
        self.form.skeleton
    }

    pub(super) fn course(&self, bound: Option<u64>, real: Option<Real>) -> Course {
        let meter = Meter::new(self.skeleton().fps, self.stream.joining(), real);
        Course::new(self.skeleton(), bound, meter)
    }
}

impl Opening {
    /// Loads the model.
    pub(super) fn open(self, overlap: Option<u16>, blend: u16) -> Result<(Generator, Beginning)> {
        let Found { manifest, blobs, label, measured, .. } = self.found;
        let label = label.to_string();
        let generator = Generator::load(&manifest, &blobs, &self.device).map_err(Problem::failed)?;
        let sampler = self.sampler.sampler(self.steps, generator.sampler(), &measured);
        let sampler = sampler.map_err(|why| Problem::usage(format!("{label}: {why}")))?;
        let settings = Settings {
            sampler: Some(sampler),
            seed: Seed(self.seed),
            control: self.control,
            overlap: overlap.map(usize::from),
            blend: usize::from(blend),
        };
        let stream = MotionStream::new(&generator, settings).map_err(model::refused)?;
        let controlled = generator.control().is_some();
        let form = Form { skeleton: stream.skeleton(), joints: self.joints, controlled };
        Ok((generator, Beginning { label, stream, form }))
    }
}
