//! Who may connect: a peer proves that it knows the generation's secret before it can send anything else.
//!
//! Four frames: the dialer names task, generation, ranks and a nonce; the one dialled answers with its own nonce and
//! `HMAC-SHA256(secret, "accept" .. names .. nonces)`; the dialer checks it and answers with the same under `"dial"`; the
//! one dialled checks that and welcomes it. Both nonces are fresh, so no recorded proof is of use; the two words differ,
//! so that a proof cannot be sent back to who made it. The secret itself never travels.

use std::net::TcpStream;
use std::time::Duration;

use hmac::{Hmac, Mac};
use protocol::{Generation, TaskId};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::Sha256;

use super::frame::{self, FrameError, Head, Kind, MAX_HANDSHAKE};

/// How long a side may take over one frame of the handshake.
const PATIENCE: Duration = Duration::from_secs(5);

/// Why a connection did not come about.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HandshakeError {
    #[error(transparent)]
    Frame(#[from] FrameError),
    #[error(transparent)]
    Io(#[from] std::io::Error),
    #[error("expected a frame of kind {expected:?}, found {found:?}")]
    Unexpected { expected: Kind, found: Kind },
    #[error("a handshake frame does not parse: {0}")]
    Parse(#[from] serde_json::Error),
    #[error("the peer does not know the secret of generation {0}")]
    Secret(Generation),
    #[error("no gang of task `{task}` at generation {generation} here")]
    Unknown { task: TaskId, generation: Generation },
    #[error("rank {from} may not dial rank {to} of this gang")]
    Ranks { from: usize, to: usize },
    #[error("no randomness: {0}")]
    Random(getrandom::Error),
}

impl HandshakeError {
    /// Whether nothing listens at the address: a process that is gone, not a slow one.
    pub(crate) fn is_refused(&self) -> bool {
        matches!(self, Self::Io(error) if error.kind() == std::io::ErrorKind::ConnectionRefused)
    }
}

/// What a dialer says first.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Dial {
    pub(crate) task: TaskId,
    pub(crate) generation: Generation,
    pub(crate) from: usize,
    pub(crate) to: usize,
    nonce: [u8; 16],
}

#[derive(Serialize, Deserialize)]
struct Challenge {
    nonce: [u8; 16],
    proof: [u8; 32],
}

#[derive(Serialize, Deserialize)]
struct Proof {
    proof: [u8; 32],
}

fn nonce() -> Result<[u8; 16], HandshakeError> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(HandshakeError::Random)?;
    Ok(bytes)
}

fn mac(secret: &str, word: &str, dial: &Dial, nonce: &[u8; 16]) -> Hmac<Sha256> {
    let mut mac = Hmac::<Sha256>::new_from_slice(secret.as_bytes()).expect("HMAC takes a key of any length");
    // Lengths in front, so that no two different lists of fields are the same bytes.
    for field in [word.as_bytes(), dial.task.as_str().as_bytes(), &dial.nonce, nonce] {
        mac.update(&(field.len() as u64).to_le_bytes());
        mac.update(field);
    }
    for number in [dial.generation.0, dial.from as u64, dial.to as u64] {
        mac.update(&number.to_le_bytes());
    }
    mac
}

fn proof(secret: &str, word: &str, dial: &Dial, nonce: &[u8; 16]) -> [u8; 32] {
    mac(secret, word, dial, nonce).finalize().into_bytes().into()
}

fn check(secret: &str, word: &str, dial: &Dial, nonce: &[u8; 16], proof: &[u8; 32]) -> Result<(), HandshakeError> {
    mac(secret, word, dial, nonce).verify_slice(proof).map_err(|_| HandshakeError::Secret(dial.generation))
}

fn send<T: Serialize>(stream: &mut TcpStream, kind: Kind, value: &T) -> Result<(), HandshakeError> {
    Ok(frame::write(stream, Head::new(kind, 0, 0, 0), &serde_json::to_vec(value)?)?)
}

fn receive<T: DeserializeOwned>(stream: &mut TcpStream, expected: Kind) -> Result<T, HandshakeError> {
    let frame = frame::read(stream, MAX_HANDSHAKE)?;
    if frame.kind != expected {
        return Err(HandshakeError::Unexpected { expected, found: frame.kind });
    }
    Ok(serde_json::from_slice(frame.bytes())?)
}

fn prepare(stream: &TcpStream) -> Result<(), HandshakeError> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    Ok(())
}

/// The dialer's side.
pub(crate) fn dial(
    stream: &mut TcpStream,
    task: &TaskId,
    generation: Generation,
    from: usize,
    to: usize,
    secret: &str,
) -> Result<(), HandshakeError> {
    prepare(stream)?;
    let dial = Dial { task: task.clone(), generation, from, to, nonce: nonce()? };
    send(stream, Kind::Dial, &dial)?;
    let challenge: Challenge = receive(stream, Kind::Challenge)?;
    check(secret, "accept", &dial, &challenge.nonce, &challenge.proof)?;
    send(stream, Kind::Proof, &Proof { proof: proof(secret, "dial", &dial, &challenge.nonce) })?;
    receive::<()>(stream, Kind::Welcome)
}

/// The first frame of the side that was dialled: what the dialer wants.
pub(crate) fn wanted(stream: &mut TcpStream) -> Result<Dial, HandshakeError> {
    prepare(stream)?;
    receive(stream, Kind::Dial)
}

/// The rest of that side. After it the dialer is known to be of the generation.
pub(crate) fn accept(stream: &mut TcpStream, dial: &Dial, secret: &str) -> Result<(), HandshakeError> {
    let nonce = nonce()?;
    send(stream, Kind::Challenge, &Challenge { nonce, proof: proof(secret, "accept", dial, &nonce) })?;
    let answer: Proof = receive(stream, Kind::Proof)?;
    check(secret, "dial", dial, &nonce, &answer.proof)?;
    send(stream, Kind::Welcome, &())
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::thread;

    use super::*;

    fn meet(dialer: &str, dialled: &str) -> (Result<(), HandshakeError>, Result<(), HandshakeError>) {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let address = listener.local_addr().expect("bound");
        let secret = dialled.to_owned();
        let server = thread::spawn(move || {
            let (mut stream, _) = listener.accept()?;
            let dial = wanted(&mut stream)?;
            accept(&mut stream, &dial, &secret)
        });
        let mut stream = TcpStream::connect(address).expect("listening");
        let here = dial(&mut stream, &TaskId::from("run/stage"), Generation(3), 1, 0, dialer);
        drop(stream);
        (here, server.join().expect("no panic"))
    }

    #[test]
    fn one_secret_meets() {
        let (dialer, dialled) = meet("same", "same");
        dialer.expect("welcome");
        dialled.expect("proved");
    }

    #[test]
    fn another_secret_is_refused_by_both() {
        let (dialer, dialled) = meet("mine", "yours");
        assert!(matches!(dialer, Err(HandshakeError::Secret(Generation(3)))), "{dialer:?}");
        assert!(dialled.is_err());
    }

    #[test]
    fn a_dialer_that_does_not_check_is_refused_too() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let mut stream = TcpStream::connect(listener.local_addr().expect("bound")).expect("listening");
        let server = thread::spawn(move || {
            let (mut stream, _) = listener.accept()?;
            let dial = wanted(&mut stream)?;
            accept(&mut stream, &dial, "yours")
        });
        let dial = Dial { task: TaskId::from("t"), generation: Generation(1), from: 1, to: 0, nonce: [0; 16] };
        send(&mut stream, Kind::Dial, &dial).expect("sent");
        let challenge: Challenge = receive(&mut stream, Kind::Challenge).expect("challenged");
        // The best a stranger can do: send the other's proof back.
        send(&mut stream, Kind::Proof, &Proof { proof: challenge.proof }).expect("sent");
        let refused = server.join().expect("no panic");
        assert!(matches!(refused, Err(HandshakeError::Secret(_))), "{refused:?}");
    }
}
