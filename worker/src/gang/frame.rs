//! Frames on the wire between members of a gang.
//!
//! A header of 32 bytes, little-endian, and a payload:
//!
//! | at | bytes | what |
//! |---|---|---|
//! | 0 | 4 | magic `STR2`: its last byte is the version of these frames and of what travels in them |
//! | 4 | 1 | kind |
//! | 5 | 3 | zero |
//! | 8 | 8 | `step`: the training step, or what the kind says |
//! | 16 | 4 | `a`, by kind |
//! | 20 | 4 | `b`, by kind |
//! | 24 | 4 | payload length in bytes |
//! | 28 | 4 | CRC-32 of bytes 0..28 and the payload |
//!
//! A payload is at most [`MAX_PAYLOAD`] long, which is checked before anything is allocated; what is longer travels in
//! pieces. The checksum catches what TCP's 16 bits let through, it does not authenticate: the handshake does that.

use std::io::{self, Read, Write};

const MAGIC: [u8; 4] = *b"STR2";
const HEADER: usize = 32;

/// Longest payload. Small enough that on a slow network too every frame is a timely sign of life.
pub(crate) const MAX_PAYLOAD: usize = 1 << 20;

/// Longest payload before a peer has proved who it is.
pub(crate) const MAX_HANDSHAKE: usize = 4096;

/// Floats in a full piece of a buffer.
pub(crate) const PIECE: usize = MAX_PAYLOAD / 4;

/// What a frame is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Handshake: a dialer says who it is and whom it wants.
    Dial = 1,
    /// Handshake: the one dialled proves itself and asks for a proof.
    Challenge = 2,
    /// Handshake: the dialer's proof.
    Proof = 3,
    /// Handshake: the proof is accepted.
    Welcome = 4,
    /// Nothing new, but alive.
    KeepAlive = 5,
    /// The sender is done with this generation; `step` is the generation it moves on to, 0 if it leaves the gang.
    Bye = 6,
    /// Rendezvous: `step` updates applied, if `a` is 1; nothing but an initialised state if it is 0.
    Applied = 7,
    /// Rendezvous: the length of a state in bytes, in `step`.
    StateLength = 8,
    /// Rendezvous: the next piece of a state.
    State = 9,
    /// Exchange: `a` slices, `b` flags; payload: floats in the buffer and the lead's last durable row, 8 bytes each.
    Begin = 10,
    /// Exchange: partial sum of node `a`, piece `b` of the receiver's chunk.
    Part = 11,
    /// Exchange: piece `b` of the sender's chunk of the sum.
    Sum = 12,
}

impl Kind {
    fn read(byte: u8) -> Option<Self> {
        Some(match byte {
            1 => Self::Dial,
            2 => Self::Challenge,
            3 => Self::Proof,
            4 => Self::Welcome,
            5 => Self::KeepAlive,
            6 => Self::Bye,
            7 => Self::Applied,
            8 => Self::StateLength,
            9 => Self::State,
            10 => Self::Begin,
            11 => Self::Part,
            12 => Self::Sum,
            _ => return None,
        })
    }

    /// Whether the payload is f32 numbers.
    fn is_floats(self) -> bool {
        matches!(self, Self::Part | Self::Sum)
    }
}

/// What a frame carries.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Payload {
    Bytes(Vec<u8>),
    Floats(Vec<f32>),
}

impl Payload {
    fn bytes_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Bytes(bytes) => bytes,
            Self::Floats(floats) => bytemuck::cast_slice_mut(floats),
        }
    }
}

/// A frame as it was received.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Frame {
    pub(crate) kind: Kind,
    pub(crate) step: u64,
    pub(crate) a: u32,
    pub(crate) b: u32,
    pub(crate) payload: Payload,
}

impl Frame {
    /// The payload of a kind that carries bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        match &self.payload {
            Payload::Bytes(bytes) => bytes,
            Payload::Floats(floats) => bytemuck::cast_slice(floats),
        }
    }
}

/// The part of a frame that is not payload.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Head {
    pub(crate) kind: Kind,
    pub(crate) step: u64,
    pub(crate) a: u32,
    pub(crate) b: u32,
}

impl Head {
    pub(crate) fn new(kind: Kind, step: u64, a: u32, b: u32) -> Self {
        Self { kind, step, a, b }
    }
}

/// Why no frame could be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameError {
    #[error("the connection was closed")]
    Closed,
    #[error("the connection failed: {0}")]
    Io(#[source] io::Error),
    #[error("not a frame of this build: it begins with `{}`, expected `STR2`; do both sides run the same build?", .0.escape_ascii())]
    Magic([u8; 4]),
    #[error("a frame of unknown kind {0}; do both sides run the same build?")]
    Kind(u8),
    #[error("a frame of {found} bytes, at most {limit} are allowed here")]
    TooLong { found: u32, limit: usize },
    #[error("a frame of {0} bytes cannot hold f32 numbers")]
    Misaligned(u32),
    #[error("a corrupt frame: checksum {found:08x}, expected {expected:08x}")]
    Corrupt { expected: u32, found: u32 },
}

/// The bytes of a frame's header. The payload is not copied.
pub(crate) fn header(head: Head, payload: &[u8]) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    let length = u32::try_from(payload.len()).expect("a payload is cut into pieces before");
    bytes[0..4].copy_from_slice(&MAGIC);
    bytes[4] = head.kind as u8;
    bytes[8..16].copy_from_slice(&head.step.to_le_bytes());
    bytes[16..20].copy_from_slice(&head.a.to_le_bytes());
    bytes[20..24].copy_from_slice(&head.b.to_le_bytes());
    bytes[24..28].copy_from_slice(&length.to_le_bytes());
    let mut crc = crc32fast::Hasher::new();
    crc.update(&bytes[..28]);
    crc.update(payload);
    bytes[28..32].copy_from_slice(&crc.finalize().to_le_bytes());
    bytes
}

/// Writes a frame. For handshakes and tests; a running link interleaves checks (`Link::send`).
pub(crate) fn write(out: &mut impl Write, head: Head, payload: &[u8]) -> io::Result<()> {
    out.write_all(&header(head, payload))?;
    out.write_all(payload)
}

/// Reads a frame whose payload has at most `limit` bytes.
pub(crate) fn read(from: &mut impl Read, limit: usize) -> Result<Frame, FrameError> {
    let mut bytes = [0; HEADER];
    read_all(from, &mut bytes)?;
    let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let magic = [bytes[0], bytes[1], bytes[2], bytes[3]];
    if magic != MAGIC {
        return Err(FrameError::Magic(magic));
    }
    let length = word(24);
    if length as usize > limit {
        return Err(FrameError::TooLong { found: length, limit });
    }
    let kind = Kind::read(bytes[4]).ok_or(FrameError::Kind(bytes[4]))?;
    let mut payload = if kind.is_floats() {
        if !length.is_multiple_of(4) {
            return Err(FrameError::Misaligned(length));
        }
        Payload::Floats(vec![0.0; length as usize / 4])
    } else {
        Payload::Bytes(vec![0; length as usize])
    };
    read_all(from, payload.bytes_mut())?;
    let mut crc = crc32fast::Hasher::new();
    crc.update(&bytes[..28]);
    crc.update(payload.bytes_mut());
    let (expected, found) = (word(28), crc.finalize());
    if expected != found {
        return Err(FrameError::Corrupt { expected, found });
    }
    let step = u64::from(word(8)) | u64::from(word(12)) << 32;
    Ok(Frame { kind, step, a: word(16), b: word(20), payload })
}

fn read_all(from: &mut impl Read, into: &mut [u8]) -> Result<(), FrameError> {
    from.read_exact(into).map_err(|error| match error.kind() {
        io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe => FrameError::Closed,
        _ => FrameError::Io(error),
    })
}

// Floats travel as they lie in memory.
#[cfg(target_endian = "big")]
compile_error!("the collective's wire format is little-endian and is not converted");

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<u8> {
        let floats = [1.0f32, -2.5, 3e-8];
        let mut bytes = Vec::new();
        write(&mut bytes, Head::new(Kind::Part, 1 << 40, 7, 9), bytemuck::cast_slice(&floats)).expect("memory");
        bytes
    }

    #[test]
    fn a_frame_survives_the_wire() {
        let frame = read(&mut sample().as_slice(), MAX_PAYLOAD).expect("whole");
        assert_eq!((frame.kind, frame.step, frame.a, frame.b), (Kind::Part, 1 << 40, 7, 9));
        assert_eq!(frame.payload, Payload::Floats(vec![1.0, -2.5, 3e-8]));
    }

    #[test]
    fn any_flipped_bit_is_noticed() {
        for bit in 0..sample().len() * 8 {
            let mut bytes = sample();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(read(&mut bytes.as_slice(), MAX_PAYLOAD).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn a_cut_frame_is_a_closed_connection() {
        let bytes = sample();
        for end in 0..bytes.len() {
            assert!(matches!(read(&mut &bytes[..end], MAX_PAYLOAD), Err(FrameError::Closed)), "{end}");
        }
    }

    #[test]
    fn an_oversized_frame_is_refused_by_its_header_alone() {
        let mut bytes = header(Head::new(Kind::State, 0, 0, 0), &[]).to_vec();
        bytes[24..28].copy_from_slice(&u32::MAX.to_le_bytes());
        // No payload follows: a reader that allocated or waited for it first would answer `Closed`.
        let error = read(&mut bytes.as_slice(), MAX_PAYLOAD).expect_err("too long");
        assert!(matches!(error, FrameError::TooLong { found: u32::MAX, limit: MAX_PAYLOAD }), "{error}");
    }
}
