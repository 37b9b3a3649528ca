//! One model on one thread, which generates segments for all streams of a process in turn. A stream waits for its
//! segment before it requests another one. So there are never more jobs than streams, and they take turns.

use std::thread;
use std::time::{Duration, Instant};

use stages::generate::stream::{Ask, MotionStream, Segment};
use tokio::sync::{mpsc, oneshot};

use super::opening::{Beginning, Opening};
use crate::report::problem::{Problem, Result};

/// A segment with the time that it took, or the reason of the failure.
type Drawn = std::result::Result<(Segment, Duration), String>;

/// A request for a segment.
struct Job {
    stream: MotionStream,
    ask: Ask,
    reply: oneshot::Sender<(MotionStream, Drawn)>,
}

/// Handle of the thread that generates segments.
#[derive(Debug, Clone)]
pub(super) struct Engine {
    jobs: mpsc::Sender<Job>,
}

impl Engine {
    /// Loads the model on its own thread, for at most `streams` streams.
    pub(super) async fn start(
        opening: Opening,
        (overlap, blend): (Option<u16>, u16),
        streams: usize,
    ) -> Result<(Self, Beginning)> {
        let (jobs, mut asked) = mpsc::channel::<Job>(streams);
        let (ready, opened) = oneshot::channel();
        let work = move || {
            let generator = match opening.open(overlap, blend) {
                Ok((generator, beginning)) => {
                    // The receiver is gone only if the process ends.
                    let _ = ready.send(Ok(beginning));
                    generator
                }
                Err(problem) => {
                    let _ = ready.send(Err(problem));
                    return;
                }
            };
            while let Some(Job { mut stream, ask, reply }) = asked.blocking_recv() {
                // Skip clients that have left.
                if reply.is_closed() {
                    continue;
                }
                let begun = Instant::now();
                let drawn = stream.draw(&generator, &ask).map_err(|error| error.to_string());
                let drawn = drawn.map(|segment| (segment, begun.elapsed()));
                let _ = reply.send((stream, drawn));
            }
        };
        let spawned = thread::Builder::new().name("engine".into()).spawn(work);
        spawned.map_err(|error| Problem::failed(format!("cannot start a thread: {error}")))?;
        let beginning = opened.await.map_err(|_| Problem::failed("the model's thread ended while it loaded"))??;
        Ok((Self { jobs }, beginning))
    }

    /// Generates the next segment of `stream` and returns both; `None` if the thread is gone.
    pub(super) async fn draw(&self, stream: MotionStream, ask: Ask) -> Option<(MotionStream, Drawn)> {
        let (reply, drawn) = oneshot::channel();
        self.jobs.send(Job { stream, ask, reply }).await.ok()?;
        drawn.await.ok()
    }

    /// Returns when the thread is gone.
    pub(super) async fn gone(&self) {
        self.jobs.closed().await;
    }
}
