//! Writing to a peer without waiting for it forever.
//!
//! A socket's write times out after [`BLINK`]; between two tries the writer asks whether the write is still wanted.

use std::io::{self, Write};
use std::net::TcpStream;
use std::sync::Mutex;
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
}

impl Link {
    /// Writes a frame. `abort` is asked while the socket takes nothing, for up to `patience`.
    pub(super) fn send(
        &self,
        head: Head,
        payload: &[u8],
        patience: Duration,
        abort: &dyn Fn() -> bool,
    ) -> io::Result<()> {
        lock(&self.writer).send(head, payload, patience, abort)
    }
}

impl Writer {
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
                        if moved.elapsed() > patience {
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
