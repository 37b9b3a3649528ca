//! Writes to a peer that never block forever.
//!
//! A socket's write times out after [`BLINK`], and between two tries the writer checks if the write is still wanted.
//! The link is given up after a long time without a byte in either direction, so a slow link survives.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::Generation;

use super::frame::{self, Head, Kind};
use super::handshake::Opening;
use super::seal::Seal;
use crate::event_count::lock;

/// The write timeout of a link's socket.
pub(super) const BLINK: Duration = Duration::from_millis(200);
/// Limit of the unsent bytes in the kernel of all links of a member together. TCP takes nothing back: what an exchange
/// that was broken off has left there passes the line before the first frame of the next generation.
const UNSENT: usize = 256 << 10;
/// Least limit of one link, so that a fast line never waits for the sender.
const LEAST_UNSENT: usize = 32 << 10;

/// The outgoing direction of a connection. Frames of the stage and keep-alives take turns.
#[derive(Debug)]
pub(super) struct Link {
    /// A clone of the socket, to end the connection during a write.
    pub(super) socket: TcpStream,
    pub(super) writer: Mutex<Writer>,
    /// True if the connection stays on this machine.
    pub(super) is_local: bool,
    pub(super) opening: Opening,
}

/// The socket with the seal of its outgoing frames.
#[derive(Debug)]
pub(super) struct Writer {
    pub(super) stream: TcpStream,
    pub(super) seal: Seal,
    /// Pulse of the incoming direction.
    pub(super) pulse: Pulse,
    /// Time of the last keep-alive.
    pub(super) signed: Instant,
}

impl Link {
    /// Writes a frame, preceded by a keep-alive if that is due. While the socket accepts nothing, calls `abort` between
    /// tries, for up to `patience` after the last byte in either direction.
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

impl Link {
    /// Limits the unsent bytes of the socket of one of `links` links.
    pub(super) fn limit_unsent(socket: &TcpStream, links: usize) -> io::Result<()> {
        #[cfg(target_os = "linux")]
        {
            let limit = (UNSENT / links.max(1)).max(LEAST_UNSENT);
            socket2::SockRef::from(socket).set_tcp_notsent_lowat(u32::try_from(limit).expect("below the limit"))
        }
        #[cfg(not(target_os = "linux"))]
        Ok(())
    }

    /// Says goodbye and closes the outgoing direction. The goodbye names the next generation, if there is one, and is
    /// optional: a peer that does not receive it sees the connection close.
    pub(super) fn part(&self, next: Option<Generation>) {
        if let Ok(mut writer) = self.writer.try_lock() {
            let _ = writer.say_goodbye(next);
            let _ = writer.stream.shutdown(Shutdown::Write);
        }
    }
}

/// A keep-alive frame and its interval.
#[derive(Debug)]
pub(super) struct Sign {
    pub(super) head: Head,
    pub(super) every: Duration,
}

/// Time of the last byte from a peer.
#[derive(Debug, Clone)]
pub(super) struct Pulse {
    begun: Instant,
    milliseconds: Arc<AtomicU64>,
}

impl Pulse {
    /// Starts now, before any byte of the peer.
    pub(super) fn new() -> Self {
        Self { begun: Instant::now(), milliseconds: Arc::default() }
    }

    /// Records a byte of the peer, or excuses its silence.
    pub(super) fn beat(&self) {
        let now = u64::try_from(self.begun.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.milliseconds.fetch_max(now, Ordering::SeqCst);
    }

    pub(super) fn last(&self) -> Instant {
        self.begun + Duration::from_millis(self.milliseconds.load(Ordering::SeqCst))
    }
}

/// The incoming direction of a connection. Each byte counts as a sign of life.
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
    /// Writes a goodbye, unless that would block.
    pub(super) fn say_goodbye(&mut self, next: Option<Generation>) -> io::Result<()> {
        let head = Head::new(Kind::Bye, next.map_or(0, |generation| generation.0), 0, 0);
        self.send(head, &[], Duration::ZERO, &|| true)
    }

    /// Writes a keep-alive if it is due.
    pub(super) fn sign(&mut self, sign: &Sign, patience: Duration, abort: &dyn Fn() -> bool) -> io::Result<()> {
        if self.signed.elapsed() < sign.every {
            return Ok(());
        }
        self.signed = Instant::now();
        self.send(sign.head, &[], patience, abort)
    }

    /// Writes a whole frame or returns an error. After an error the link is unusable, because part of the frame may
    /// have been sent.
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
