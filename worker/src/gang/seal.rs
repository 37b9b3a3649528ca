//! Protection of a connection's frames: a tag that only the peer can make, and encryption if the connection leaves this
//! machine.
//!
//! Each direction of each connection has its own key, which the handshake derives from the generation's secret and two
//! fresh nonces. Frames are numbered from 0; the number is not sent. The tag covers it, and it is the nonce of the
//! cipher, so a nonce never repeats under a key. A frame that is changed, missing, repeated or reordered has another
//! tag.
//!
//! The cipher is AES-256-GCM of `ring`, which TLS already depends on. The header of a frame is authenticated but
//! readable. An observer sees kinds, steps and lengths of frames, but no weights, gradients or values.

use std::net::TcpStream;

use ring::aead::{AES_256_GCM, Aad, LessSafeKey, Nonce, Tag, UnboundKey};

/// Bytes of a tag.
pub(super) const TAG: usize = 16;

/// The protection of one direction of a connection, with the number of the next frame.
#[derive(Clone)]
pub(crate) struct Seal {
    means: Means,
    next: u64,
    /// The encrypted payload of the frame being sent.
    encrypted: Vec<u8>,
}

#[derive(Clone)]
enum Means {
    /// Readable, with a tag of keyed BLAKE3.
    Tagged([u8; 32]),
    /// Encrypted, with a tag. Boxed, because an expanded key takes 544 bytes.
    Encrypted(Box<LessSafeKey>),
}

impl std::fmt::Debug for Seal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let encrypted = matches!(self.means, Means::Encrypted(_));
        f.debug_struct("Seal").field("encrypted", &encrypted).field("next", &self.next).finish_non_exhaustive()
    }
}

impl Seal {
    /// Seals readable frames under `key`, which must be unique to this direction of the connection.
    pub(crate) fn tagged(key: [u8; 32]) -> Self {
        Self { means: Means::Tagged(key), next: 0, encrypted: Vec::new() }
    }

    /// Seals encrypted frames under `key`, which must be unique to this direction of the connection.
    pub(crate) fn encrypted(key: [u8; 32]) -> Self {
        let key = UnboundKey::new(&AES_256_GCM, &key).expect("the cipher's keys have 32 bytes");
        Self { means: Means::Encrypted(Box::new(LessSafeKey::new(key))), next: 0, encrypted: Vec::new() }
    }

    /// Returns true if the connection leaves the machine.
    pub(super) fn is_encrypted(&self) -> bool {
        matches!(self.means, Means::Encrypted(_))
    }

    /// Seals a single frame of a handshake with a checksum.
    pub(super) fn checksum() -> Self {
        Self::tagged([0; 32])
    }

    /// Returns the tag of the next frame and the payload to send. Without encryption, the payload is not copied.
    pub(super) fn seal<'a>(&'a mut self, header: &[u8], payload: &'a [u8]) -> ([u8; TAG], &'a [u8]) {
        let number = self.advance();
        match &self.means {
            Means::Tagged(key) => (cut(tag(key, number, header, payload)), payload),
            Means::Encrypted(key) => {
                self.encrypted.clear();
                self.encrypted.extend_from_slice(payload);
                let tag = key.seal_in_place_separate_tag(nonce(number), Aad::from(header), &mut self.encrypted);
                let tag = tag.expect("a frame is far shorter than what the cipher takes");
                (tag.as_ref().try_into().expect("a tag has 16 bytes"), &self.encrypted)
            }
        }
    }

    /// Checks the next frame and decrypts its payload in place. The error is the frame's number.
    pub(super) fn open(&mut self, header: &[u8], payload: &mut [u8], found: [u8; TAG]) -> Result<(), u64> {
        let number = self.advance();
        match &self.means {
            Means::Tagged(key) => {
                let tag = tag(key, number, header, payload);
                let mut claimed = *tag.as_bytes();
                claimed[..TAG].copy_from_slice(&found);
                // In constant time, so that the time does not reveal a partly correct guess of a tag.
                if tag == blake3::Hash::from_bytes(claimed) { Ok(()) } else { Err(number) }
            }
            Means::Encrypted(key) => key
                .open_in_place_separate_tag(nonce(number), Aad::from(header), Tag::from(found), payload, 0..)
                .map(drop)
                .map_err(|_| number),
        }
    }

    fn advance(&mut self) -> u64 {
        let number = self.next;
        self.next = number.checked_add(1).expect("no connection has 2^64 frames");
        number
    }
}

fn nonce(number: u64) -> Nonce {
    let mut bytes = [0; 12];
    bytes[4..].copy_from_slice(&number.to_le_bytes());
    Nonce::assume_unique_for_key(bytes)
}

fn tag(key: &[u8; 32], number: u64, header: &[u8], payload: &[u8]) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new_keyed(key);
    hasher.update(&number.to_le_bytes()).update(header).update(payload);
    hasher.finalize()
}

fn cut(tag: blake3::Hash) -> [u8; TAG] {
    let mut bytes = [0; TAG];
    bytes.copy_from_slice(&tag.as_bytes()[..TAG]);
    bytes
}

/// Returns true if the ends of `stream` have different addresses, so that others may see the traffic. Traffic between
/// two processes of one machine stays in its kernel.
pub(super) fn leaves_the_machine(stream: &TcpStream) -> std::io::Result<bool> {
    Ok(stream.local_addr()?.ip().to_canonical() != stream.peer_addr()?.ip().to_canonical())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_frames_look_different_and_hide_what_they_carry() {
        let mut seal = Seal::encrypted([7; 32]);
        let payload = b"weights weights weights weights";
        let mut sent = Vec::new();
        for _ in 0..3 {
            let (tag, bytes) = seal.seal(b"header", payload);
            assert_eq!(bytes.len(), payload.len());
            assert_ne!(bytes, payload);
            sent.push((tag, bytes.to_vec()));
        }
        assert!(sent[0].1 != sent[1].1 && sent[1].1 != sent[2].1 && sent[0].1 != sent[2].1, "a nonce repeats");
        let mut other = Seal::encrypted([8; 32]);
        assert_ne!(other.seal(b"header", payload).1, sent[0].1);

        let mut opens = Seal::encrypted([7; 32]);
        for (tag, mut bytes) in sent.clone() {
            opens.open(b"header", &mut bytes, tag).expect("what was sent");
            assert_eq!(bytes, payload);
        }
        let (tag, mut bytes) = sent[0].clone();
        assert_eq!(Seal::encrypted([7; 32]).open(b"Header", &mut bytes, tag), Err(0), "another header");
        let (tag, mut bytes) = sent[1].clone();
        assert_eq!(Seal::encrypted([7; 32]).open(b"header", &mut bytes, tag), Err(0), "another place");
        let (tag, mut bytes) = sent[0].clone();
        assert_eq!(Seal::tagged([7; 32]).open(b"header", &mut bytes, tag), Err(0), "another means");
    }
}
