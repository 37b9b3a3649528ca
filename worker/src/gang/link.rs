//! Writing to a peer without waiting for it forever.
//!
//! A socket's write times out after [`BLINK`]; between two tries the writer asks whether the write is still wanted. The link is given up
//! once no byte has moved for long in either direction: a slow link is not a dead one.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::frame::{self, Head};
use super::seal::Seal;
use crate::event_count::lock;

/// The write timeout of a link's socket.
pub(super) const BLINK: Duration = Duration::from_millis(200);

/// Our direction of a connection. Frames of the stage and signs of life take turns.
#[derive(Debug)]
pub(super) struct Link {
    /// To end the connection while somebody writes.
    pub(super) socket: TcpStream,
    pub(super) writer: Mutex<Writer>,
}

/// The socket, and what vouches for the frames that go into it.
#[derive(Debug)]
pub(super) struct Writer {
    pub(super) stream: TcpStream,
    pub(super) seal: Seal,
    /// The other direction's.
    pub(super) pulse: Pulse,
    /// When the last sign of life went out.
    pub(super) signed: Instant,
}

impl Link {
    /// Writes a frame, and before it a sign of life if that is due. `abort` is asked while the socket takes nothing, for up to `patience`
    /// after the peer's last byte or ours.
    pub(super) fn send(
        &self,
        head: Head,
        payload: &[u8],
        sign: &Sign,
        patience: Duration,
        abort: &dyn Fn() -> bool,
    ) -> io::Result<()> {
        let mut writer = lock(&self.writer);
        writer.sign(sign, patience, abort)?;
        writer.send(head, payload, patience, abort)
    }
}

/// A sign of life and how often it goes out.
#[derive(Debug)]
pub(super) struct Sign {
    pub(super) head: Head,
    pub(super) every: Duration,
}

/// When a peer's bytes last came.
#[derive(Debug, Clone)]
pub(super) struct Pulse {
    begun: Instant,
    milliseconds: Arc<AtomicU64>,
}

impl Pulse {
    /// That of a peer of which nothing has come yet.
    pub(super) fn new() -> Self {
        Self { begun: Instant::now(), milliseconds: Arc::default() }
    }

    /// A byte came, or the peer is excused.
    pub(super) fn beat(&self) {
        let now = u64::try_from(self.begun.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.milliseconds.fetch_max(now, Ordering::SeqCst);
    }

    pub(super) fn last(&self) -> Instant {
        self.begun + Duration::from_millis(self.milliseconds.load(Ordering::SeqCst))
    }
}

/// A peer's direction of a connection, each byte of which is a sign of life.
#[derive(Debug)]
pub(super) struct Heard<'a> {
    pub(super) stream: &'a TcpStream,
    pub(super) pulse: Pulse,
}

impl Read for Heard<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let count = self.stream.read(into)?;
        if count > 0 {
            self.pulse.beat();
        }
        Ok(count)
    }
}

impl Writer {
    /// Writes a sign of life if it is due.
    pub(super) fn sign(&mut self, sign: &Sign, patience: Duration, abort: &dyn Fn() -> bool) -> io::Result<()> {
        if self.signed.elapsed() < sign.every {
            return Ok(());
        }
        self.signed = Instant::now();
        self.send(sign.head, &[], patience, abort)
    }

    /// Writes a whole frame, or an error. After an error the peer takes no more frames: part of one may be on its way.
    pub(super) fn send(
        &mut self,
        head: Head,
        payload: &[u8],
        patience: Duration,
        abort: &dyn Fn() -> bool,
    ) -> io::Result<()> {
        let (header, payload) = frame::sealed(head, payload, &mut self.seal);
        for mut rest in [header.as_slice(), payload] {
            let mut moved = Instant::now();
            while !rest.is_empty() {
                match self.stream.write(rest) {
                    Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                    Ok(n) => {
                        rest = &rest[n..];
                        moved = Instant::now();
                    }
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {
                        if abort() {
                            return Err(io::ErrorKind::Interrupted.into());
                        }
                        if moved.max(self.pulse.last()).elapsed() > patience {
                            return Err(io::ErrorKind::TimedOut.into());
                        }
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(())
    }
}
