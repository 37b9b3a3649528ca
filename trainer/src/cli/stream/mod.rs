//! `trainer generate --stream`: an endless motion from sentences that arrive over time. Decision 0012.

mod course;
mod engine;
mod line;
mod listen;
mod opening;
mod pipe;
mod real;
mod report;

use super::out::OutArgs;
use crate::report::problem::Result;

pub(super) use self::opening::{Opening, StreamArgs};

/// Streams until its input or its output ends. `bound` returns the frames, at a frame rate, after which the stream ends
/// in any case. `insecure` allows listening beyond this machine without TLS.
pub(super) async fn stream(
    args: StreamArgs,
    opening: Opening,
    out: OutArgs,
    insecure: bool,
    bound: impl Fn(f64) -> Result<Option<u64>>,
) -> Result<u8> {
    if args.listen.is_some() {
        return listen::listen(args, opening, insecure, bound).await;
    }
    let outs = out.files(1)?;
    let (generator, beginning) = opening.open(args.overlap, args.blend)?;
    let skeleton = beginning.skeleton();
    let real = args.real.as_deref().map(|path| real::read(path, skeleton)).transpose()?;
    let course = beginning.course(bound(skeleton.fps)?, real);
    let pace = args.pace.map(|rate| rate.unwrap_or(skeleton.fps));
    pipe::run(&generator, beginning, course, pace, (outs, out.report()))
}
