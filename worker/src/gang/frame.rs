//! Frames on the wire between members of a gang.
//!
//! A header of 44 bytes, little-endian, and a payload:
//!
//! | at | bytes | content |
//! |---|---|---|
//! | 0 | 4 | magic `STR6`: its last byte is the version of these frames and of their contents |
//! | 4 | 1 | kind |
//! | 5 | 3 | zero |
//! | 8 | 8 | `step`: the training step, or another number by kind |
//! | 16 | 4 | `a`, by kind |
//! | 20 | 4 | `b`, by kind |
//! | 24 | 4 | payload length in bytes |
//! | 28 | 16 | tag: of the frame's number, bytes 0..28 and the payload ([`seal`](super::seal)) |
//!
//! A payload is at most [`MAX_PAYLOAD`] long, which is checked before allocation; longer data is sent in pieces. The
//! payload is encrypted if the connection leaves the machine. The tag covers the number of the frame. So a frame that
//! is changed, missing, repeated, reordered or recorded elsewhere ends the connection. Frames of the handshake come
//! before there is a key: their tag is a checksum, and the handshake proves the rest.

use std::io::{self, Read, Write};

use super::seal::{Seal, TAG};

const MAGIC: [u8; 4] = *b"STR6";
/// Bytes of the header that the tag covers.
const SIGNED: usize = 28;
const HEADER: usize = SIGNED + TAG;

/// Longest payload. At 30 KB/s it takes two seconds, so a sign of life does not wait for long behind it.
pub(crate) const MAX_PAYLOAD: usize = 64 << 10;

/// Longest payload before a peer has authenticated.
pub(crate) const MAX_HANDSHAKE: usize = 4096;

/// Floats in a full piece of a buffer.
pub(crate) const PIECE: usize = MAX_PAYLOAD / 4;

/// Kind of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Handshake: the dialer's identity and the member that it wants.
    Dial = 1,
    /// Handshake: the dialled member proves itself and asks for a proof.
    Challenge = 2,
    /// Handshake: the dialer's proof.
    Proof = 3,
    /// Handshake: the proof is accepted.
    Welcome = 4,
    /// Keep-alive without news; `a` is the sender's current activity ([`Phase`](super::member::Phase)).
    KeepAlive = 5,
    /// The sender has finished this generation; `step` is the generation it moves to, or 0 if it leaves the gang.
    Bye = 6,
    /// Rendezvous: if `a` is 1, `step` updates are applied; if `a` is 0, the state is only initialised.
    Applied = 7,
    /// Rendezvous: the length of a state in bytes, in `step`.
    StateLength = 8,
    /// Rendezvous: the next piece of a state.
    State = 9,
    /// Exchange: `a` slices, `b` flags; payload: floats in the buffer and the lead's last durable row, 8 bytes each, and
    /// the announcement of the sender's memory, if any.
    Begin = 10,
    /// Exchange: partial sum of node `a`, piece `b` of the receiver's chunk.
    Part = 11,
    /// Exchange: piece `b` of the sender's chunk of the sum.
    Sum = 12,
    /// A probe from a stranger, answered with the same frame.
    Probe = 13,
    /// Exchange: like `Part`, for the whole chunk, which is in the sender's memory.
    SharedPart = 14,
    /// Exchange: like `Sum`, for the whole chunk, which is in the sender's memory.
    SharedSum = 15,
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
            13 => Self::Probe,
            14 => Self::SharedPart,
            15 => Self::SharedSum,
            _ => return None,
        })
    }

    /// Returns true if the payload consists of f32 numbers.
    fn is_floats(self) -> bool {
        matches!(self, Self::Part | Self::Sum)
    }
}

/// Payload of a received frame.
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

/// A received frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Frame {
    pub(crate) kind: Kind,
    pub(crate) step: u64,
    pub(crate) a: u32,
    pub(crate) b: u32,
    pub(crate) payload: Payload,
}

impl Frame {
    /// The payload as bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        match &self.payload {
            Payload::Bytes(bytes) => bytes,
            Payload::Floats(floats) => bytemuck::cast_slice(floats),
        }
    }
}

/// The fields of a frame's header that the sender chooses.
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

/// Failure to read a frame.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameError {
    #[error("the connection was closed")]
    Closed,
    #[error("the connection failed: {0}")]
    Io(#[source] io::Error),
    #[error("not a frame of this build: it starts with `{}`; expected `STR6`; use the same build for all workers", .0.escape_ascii())]
    Magic([u8; 4]),
    #[error("a frame has the unknown kind {0}; use the same build for all workers")]
    Kind(u8),
    #[error("a frame has {found} bytes; expected at most {limit}")]
    TooLong { found: u32, limit: usize },
    #[error("a frame has {0} bytes, which is not a whole number of f32 values")]
    Misaligned(u32),
    #[error("frame {0} failed authentication: its tag does not match")]
    Forged(u64),
}

/// Encodes the next frame under `seal`: its header and the payload to send. An unencrypted payload is not copied.
pub(crate) fn sealed<'a>(head: Head, payload: &'a [u8], seal: &'a mut Seal) -> ([u8; HEADER], &'a [u8]) {
    let mut bytes = [0; HEADER];
    let length = u32::try_from(payload.len()).expect("a payload is cut into pieces before");
    bytes[0..4].copy_from_slice(&MAGIC);
    bytes[4] = head.kind as u8;
    bytes[8..16].copy_from_slice(&head.step.to_le_bytes());
    bytes[16..20].copy_from_slice(&head.a.to_le_bytes());
    bytes[20..24].copy_from_slice(&head.b.to_le_bytes());
    bytes[24..28].copy_from_slice(&length.to_le_bytes());
    let (tag, payload) = seal.seal(&bytes[..SIGNED], payload);
    bytes[SIGNED..].copy_from_slice(&tag);
    (bytes, payload)
}

/// Writes a frame of a handshake.
pub(crate) fn write(out: &mut impl Write, head: Head, payload: &[u8]) -> io::Result<()> {
    write_sealed(out, head, payload, &mut Seal::checksum())
}

/// Writes a whole frame without waiting. For handshakes and tests; a running link interleaves checks (`Link::send`).
pub(crate) fn write_sealed(out: &mut impl Write, head: Head, payload: &[u8], seal: &mut Seal) -> io::Result<()> {
    let (header, payload) = sealed(head, payload, seal);
    out.write_all(&header)?;
    out.write_all(payload)
}

/// Reads a frame of a handshake.
pub(crate) fn read(from: &mut impl Read) -> Result<Frame, FrameError> {
    read_sealed(from, MAX_HANDSHAKE, &mut Seal::checksum())
}

/// Reads the next frame under `seal`, with a payload of at most `limit` bytes.
pub(crate) fn read_sealed(from: &mut impl Read, limit: usize, seal: &mut Seal) -> Result<Frame, FrameError> {
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
    let (signed, tag) = bytes.split_at(SIGNED);
    let tag = tag.try_into().expect("a header ends with its tag");
    seal.open(signed, payload.bytes_mut(), tag).map_err(FrameError::Forged)?;
    let step = u64::from(word(8)) | u64::from(word(12)) << 32;
    Ok(Frame { kind, step, a: word(16), b: word(20), payload })
}

fn read_all(from: &mut impl Read, into: &mut [u8]) -> Result<(), FrameError> {
    from.read_exact(into).map_err(|error| match error.kind() {
        io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe => FrameError::Closed,
        _ => FrameError::Io(error),
    })
}

// Floats are sent in their memory layout.
#[cfg(target_endian = "big")]
compile_error!("the collective's wire format is little-endian and is not converted");

#[cfg(test)]
mod tests {
    use super::*;

    fn seal() -> Seal {
        Seal::tagged([7; 32])
    }

    fn sample() -> Vec<u8> {
        let floats = [1.0f32, -2.5, 3e-8];
        let mut bytes = Vec::new();
        let head = Head::new(Kind::Part, 1 << 40, 7, 9);
        write_sealed(&mut bytes, head, bytemuck::cast_slice(&floats), &mut seal()).expect("memory");
        bytes
    }

    fn read_one(mut bytes: &[u8]) -> Result<Frame, FrameError> {
        read_sealed(&mut bytes, MAX_PAYLOAD, &mut seal())
    }

    #[test]
    fn a_frame_survives_the_wire() {
        let frame = read_one(&sample()).expect("whole");
        assert_eq!((frame.kind, frame.step, frame.a, frame.b), (Kind::Part, 1 << 40, 7, 9));
        assert_eq!(frame.payload, Payload::Floats(vec![1.0, -2.5, 3e-8]));
    }

    #[test]
    fn any_flipped_bit_is_noticed() {
        for bit in 0..sample().len() * 8 {
            let mut bytes = sample();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(read_one(&bytes).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn a_frame_of_another_key_or_place_is_noticed() {
        let mut sender = seal();
        let frames: Vec<Vec<u8>> = (0..3u64)
            .map(|step| {
                let mut bytes = Vec::new();
                write_sealed(&mut bytes, Head::new(Kind::State, step, 0, 0), b"part", &mut sender).expect("memory");
                bytes
            })
            .collect();
        let steps = |order: &[usize]| -> Vec<Option<u64>> {
            let mut seal = seal();
            let read = |i: &usize| read_sealed(&mut frames[*i].as_slice(), MAX_PAYLOAD, &mut seal).ok();
            order.iter().map(read).map(|frame| frame.map(|frame| frame.step)).collect()
        };
        assert_eq!(steps(&[0, 1, 2]), [Some(0), Some(1), Some(2)]);
        assert_eq!(steps(&[0, 0]), [Some(0), None], "sent again");
        assert_eq!(steps(&[0, 2]), [Some(0), None], "one left out");
        assert_eq!(steps(&[1, 0]), [None, None], "in another order");
        let mut other = Seal::tagged([8; 32]);
        assert!(read_sealed(&mut frames[0].as_slice(), MAX_PAYLOAD, &mut other).is_err(), "under another key");
        assert!(read(&mut frames[0].as_slice()).is_err(), "as a checksum");
    }

    #[test]
    fn a_cut_frame_is_a_closed_connection() {
        let bytes = sample();
        for end in 0..bytes.len() {
            assert!(matches!(read_one(&bytes[..end]), Err(FrameError::Closed)), "{end}");
        }
    }

    #[test]
    fn an_oversized_frame_is_refused_by_its_header_alone() {
        let mut bytes = sealed(Head::new(Kind::State, 0, 0, 0), &[], &mut seal()).0.to_vec();
        bytes[24..28].copy_from_slice(&u32::MAX.to_le_bytes());
        // No payload follows. A reader that allocated or waited for it first would return `Closed`.
        let error = read_one(&bytes).expect_err("too long");
        assert!(matches!(error, FrameError::TooLong { found: u32::MAX, limit: MAX_PAYLOAD }), "{error}");
    }

    #[test]
    #[ignore = "a measurement: cargo test --release -p worker tags -- --ignored --nocapture"]
    fn tags() {
        use hmac::Mac as _;
        let payload = vec![3u8; MAX_PAYLOAD];
        let time = |what: &str, work: &mut dyn FnMut()| {
            let begun = std::time::Instant::now();
            (0..500).for_each(|_| work());
            let rate = 500.0 * MAX_PAYLOAD as f64 / begun.elapsed().as_secs_f64() / 1e9;
            eprintln!("{what}: {rate:.2} GB/s on frames of {MAX_PAYLOAD} bytes");
        };
        let mut tagged = seal();
        let mut encrypted = Seal::encrypted([7; 32]);
        time("keyed BLAKE3", &mut || {
            std::hint::black_box(tagged.seal(&[0; SIGNED], &payload));
        });
        time("AES-256-GCM", &mut || {
            std::hint::black_box(encrypted.seal(&[0; SIGNED], &payload));
        });
        time("HMAC-SHA256", &mut || {
            let mut mac = hmac::Hmac::<sha2::Sha256>::new_from_slice(&[7; 32]).expect("any length");
            mac.update(&payload);
            std::hint::black_box(mac.finalize());
        });
    }
}
