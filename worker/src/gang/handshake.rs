//! Authentication of connections: a peer proves that it has the generation's secret before it can send anything else.
//!
//! The handshake has four frames:
//!
//! 1. The dialer sends task, generation, ranks and a nonce.
//! 2. The dialled side answers with its own nonce and `HMAC-SHA256(secret, "accept" .. names .. nonces)`.
//! 3. The dialer checks it and answers with the same under `"dial"`.
//! 4. The dialled side checks that and welcomes the dialer.
//!
//! The dialer knows the other side after the second frame, so its first frame as a member follows the third one at once.
//!
//! Both nonces are fresh, so a recorded proof is useless. The two words differ, so a proof cannot be reflected to its
//! author. The secret itself is never sent. The frames that follow are encrypted if one of the two sees the connection
//! leave its machine. The HMAC covers the dialer's view of this, so an attacker on the path cannot change it.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use hmac::{Hmac, Mac};
use protocol::{Generation, TaskId};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::Sha256;

use super::frame::{self, FrameError, Head, Kind};
use super::seal::{Seal, leaves_the_machine};

/// Time limit of a handshake, all frames together.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// Failure to establish a connection.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HandshakeError {
    #[error(transparent)]
    Frame(#[from] FrameError),
    #[error(transparent)]
    Io(#[from] std::io::Error),
    #[error("received a frame of kind {found:?}; expected {expected:?}")]
    Unexpected { expected: Kind, found: Kind },
    #[error("cannot parse a handshake frame: {0}")]
    Parse(#[from] serde_json::Error),
    #[error("the peer does not know the secret of generation {0}")]
    Secret(Generation),
    #[error("this worker is not in the gang of task `{task}` at generation {generation}")]
    Unknown { task: TaskId, generation: Generation },
    #[error("rank {from} may not dial rank {to} of this gang")]
    Ranks { from: usize, to: usize },
    #[error("the connection was closed to make room for others")]
    Crowded,
    #[error("no randomness: {0}")]
    Random(getrandom::Error),
}

impl HandshakeError {
    /// Returns true if no process listens at the address, so that the peer is gone and not merely slow.
    pub(crate) fn is_refused(&self) -> bool {
        matches!(self, Self::Io(error) if error.kind() == std::io::ErrorKind::ConnectionRefused)
    }
}

/// The dialer's first message.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Dial {
    pub(crate) task: TaskId,
    pub(crate) generation: Generation,
    pub(crate) from: usize,
    pub(crate) to: usize,
    /// True if the dialer sees the connection leave its machine.
    leaves: bool,
    nonce: [u8; 16],
}

#[derive(Serialize, Deserialize)]
struct Challenge {
    /// True if the frames that follow are encrypted.
    encrypts: bool,
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

/// Fields of the dialled side's answer, beside the dialer's.
#[derive(Debug, Clone, Copy)]
struct Answer {
    encrypts: bool,
    nonce: [u8; 16],
}

fn mac(secret: &str, word: &str, dial: &Dial, answer: &Answer) -> Hmac<Sha256> {
    let mut mac = Hmac::<Sha256>::new_from_slice(secret.as_bytes()).expect("HMAC takes a key of any length");
    // Length prefixes, so that two different lists of fields never encode to the same bytes.
    for field in [word.as_bytes(), dial.task.as_str().as_bytes(), &dial.nonce, &answer.nonce] {
        mac.update(&(field.len() as u64).to_le_bytes());
        mac.update(field);
    }
    let flags = u64::from(dial.leaves) | u64::from(answer.encrypts) << 1;
    for number in [dial.generation.0, dial.from as u64, dial.to as u64, flags] {
        mac.update(&number.to_le_bytes());
    }
    mac
}

fn proof(secret: &str, word: &str, dial: &Dial, answer: &Answer) -> [u8; 32] {
    mac(secret, word, dial, answer).finalize().into_bytes().into()
}

fn check(secret: &str, word: &str, dial: &Dial, answer: &Answer, proof: &[u8; 32]) -> Result<(), HandshakeError> {
    mac(secret, word, dial, answer).verify_slice(proof).map_err(|_| HandshakeError::Secret(dial.generation))
}

/// Seals of the frames after a handshake.
#[derive(Debug)]
pub(crate) struct Session {
    pub(super) opening: Opening,
    /// Seal of the frames that this side sends.
    pub(crate) sends: Seal,
    /// Seal of the frames that this side receives.
    pub(crate) receives: Seal,
}

fn session(secret: &str, dial: &Dial, answer: &Answer, dialed: bool) -> Session {
    let seal = if answer.encrypts { Seal::encrypted } else { Seal::tagged };
    let dialer = seal(proof(secret, "frames of the dialer", dial, answer));
    let dialled = seal(proof(secret, "frames of the one dialled", dial, answer));
    let (sends, receives) = if dialed { (dialer, dialled) } else { (dialled, dialer) };
    Session { opening: Opening { dial: dial.clone(), answer: *answer, dialed }, sends, receives }
}

/// What both sides of a connection said at its beginning.
#[derive(Debug, Clone)]
pub(super) struct Opening {
    dial: Dial,
    answer: Answer,
    /// True on the side that dialled.
    dialed: bool,
}

impl Opening {
    /// The session of a later generation over the same connection. Its keys come from that generation's secret and the
    /// nonces of this connection, so only a member of that generation has them.
    pub(super) fn renewed(&self, secret: &str, generation: Generation, own: usize, peer: usize) -> Session {
        let (from, to) = if self.dialed { (own, peer) } else { (peer, own) };
        let dial = Dial { generation, from, to, ..self.dial.clone() };
        session(secret, &dial, &self.answer, self.dialed)
    }
}

/// A connection with one deadline for all reads and writes.
#[derive(Debug)]
pub(super) struct Hurried<'a> {
    stream: &'a TcpStream,
    until: Instant,
}

impl<'a> Hurried<'a> {
    /// Sets the deadline to [`PATIENCE`] after `since`.
    pub(super) fn new(stream: &'a TcpStream, since: Instant) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        Ok(Self { stream, until: since + PATIENCE })
    }

    fn left(&self) -> io::Result<Duration> {
        let left = self.until.saturating_duration_since(Instant::now());
        if left.is_zero() { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
    }
}

impl Read for Hurried<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(Some(self.left()?))?;
        self.stream.read(into)
    }
}

impl Write for Hurried<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(Some(self.left()?))?;
        self.stream.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

fn send<T: Serialize>(stream: &mut Hurried<'_>, kind: Kind, value: &T) -> Result<(), HandshakeError> {
    Ok(frame::write(stream, Head::new(kind, 0, 0, 0), &serde_json::to_vec(value)?)?)
}

fn receive<T: DeserializeOwned>(stream: &mut Hurried<'_>, expected: Kind) -> Result<T, HandshakeError> {
    let frame = frame::read(stream)?;
    if frame.kind != expected {
        return Err(HandshakeError::Unexpected { expected, found: frame.kind });
    }
    Ok(serde_json::from_slice(frame.bytes())?)
}

/// Performs the dialer's side of a handshake up to its proof. The dialled side is authenticated then; its welcome is
/// still on its way ([`welcomed`]).
pub(super) fn dial(
    stream: &mut Hurried<'_>,
    task: &TaskId,
    generation: Generation,
    from: usize,
    to: usize,
    secret: &str,
) -> Result<Session, HandshakeError> {
    let leaves = leaves_the_machine(stream.stream)?;
    let dial = Dial { task: task.clone(), generation, from, to, leaves, nonce: nonce()? };
    send(stream, Kind::Dial, &dial)?;
    let Challenge { encrypts, nonce, proof: theirs } = receive(stream, Kind::Challenge)?;
    let answer = Answer { encrypts, nonce };
    check(secret, "accept", &dial, &answer, &theirs)?;
    send(stream, Kind::Proof, &Proof { proof: proof(secret, "dial", &dial, &answer) })?;
    Ok(session(secret, &dial, &answer, true))
}

/// Waits for the welcome after [`dial`].
pub(super) fn welcomed(stream: &mut Hurried<'_>) -> Result<(), HandshakeError> {
    receive(stream, Kind::Welcome)
}

/// Reads the dialer's request on the dialled side. Answers each [`probe`] before it.
pub(super) fn wanted(stream: &mut Hurried<'_>) -> Result<Dial, HandshakeError> {
    loop {
        let frame = frame::read(stream)?;
        match frame.kind {
            Kind::Dial => return Ok(serde_json::from_slice(frame.bytes())?),
            Kind::Probe => send(stream, Kind::Probe, &())?,
            found => return Err(HandshakeError::Unexpected { expected: Kind::Dial, found }),
        }
    }
}

/// Connects to a worker that listens at `address` and answers. Does not authenticate it.
pub(super) fn probe(address: &str) -> Result<TcpStream, HandshakeError> {
    let stream = connect(address)?;
    let hurried = &mut Hurried::new(&stream, Instant::now())?;
    send(hurried, Kind::Probe, &())?;
    receive::<()>(hurried, Kind::Probe)?;
    Ok(stream)
}

/// Connects to the first IP address of `address` that accepts.
pub(super) fn connect(address: &str) -> Result<TcpStream, HandshakeError> {
    let mut last = io::Error::new(io::ErrorKind::AddrNotAvailable, format!("cannot resolve `{address}` to an address"));
    for socket in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&socket, PATIENCE) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last.into())
}

/// Performs the dialled side up to the dialer's proof, which authenticates the dialer as a member of the generation. The
/// rest is [`welcome`].
pub(super) fn accept(stream: &mut Hurried<'_>, dial: &Dial, secret: &str) -> Result<Session, HandshakeError> {
    let answer = Answer { encrypts: dial.leaves || leaves_the_machine(stream.stream)?, nonce: nonce()? };
    let Answer { encrypts, nonce } = answer;
    send(stream, Kind::Challenge, &Challenge { encrypts, nonce, proof: proof(secret, "accept", dial, &answer) })?;
    let theirs: Proof = receive(stream, Kind::Proof)?;
    check(secret, "dial", dial, &answer, &theirs.proof)?;
    Ok(session(secret, dial, &answer, false))
}

/// Welcomes the dialer.
pub(super) fn welcome(stream: &mut Hurried<'_>) -> Result<(), HandshakeError> {
    send(stream, Kind::Welcome, &())
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::thread;

    use super::*;

    type Met = Result<Session, HandshakeError>;

    fn meet(dialer: &str, dialled: &str) -> (Met, Met) {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let address = listener.local_addr().expect("bound");
        let secret = dialled.to_owned();
        let server = thread::spawn(move || answer(&listener, &secret));
        let stream = TcpStream::connect(address).expect("listening");
        let here = join(&stream, dialer);
        drop(stream);
        (here, server.join().expect("no panic"))
    }

    fn join(stream: &TcpStream, secret: &str) -> Met {
        let stream = &mut Hurried::new(stream, Instant::now())?;
        let session = dial(stream, &TaskId::from("run/stage"), Generation(3), 1, 0, secret)?;
        welcomed(stream).map(|()| session)
    }

    fn answer(listener: &TcpListener, secret: &str) -> Met {
        let (stream, _) = listener.accept()?;
        let stream = &mut Hurried::new(&stream, Instant::now())?;
        let dial = wanted(stream)?;
        let session = accept(stream, &dial, secret)?;
        welcome(stream).map(|()| session)
    }

    /// Returns true if the receiver accepts the sender's frames.
    fn agree(sends: &mut Seal, receives: &mut Seal) -> bool {
        let mut bytes = Vec::new();
        frame::write_sealed(&mut bytes, Head::new(Kind::State, 1, 2, 3), b"payload", sends).expect("memory");
        frame::read_sealed(&mut bytes.as_slice(), frame::MAX_PAYLOAD, receives).is_ok()
    }

    #[test]
    fn one_secret_meets_and_each_direction_of_each_connection_has_a_key_of_its_own() {
        let (dialer, dialled) = meet("same", "same");
        let mut dialer = dialer.expect("welcome");
        let mut dialled = dialled.expect("proved");
        assert!(agree(&mut dialer.sends.clone(), &mut dialled.receives));
        assert!(agree(&mut dialled.sends.clone(), &mut dialer.receives.clone()));
        assert!(!agree(&mut dialer.sends.clone(), &mut dialer.receives), "a frame is not sent back to who made it");
        let (_, again) = meet("same", "same");
        assert!(!agree(&mut dialer.sends, &mut again.expect("proved").receives), "nor over another connection");
    }

    /// A member that was removed has heard the nonces of a connection between two others.
    #[test]
    fn the_keys_of_a_later_generation_need_its_secret() {
        let (dialer, dialled) = meet("old", "old");
        let (dialer, dialled) = (dialer.expect("welcome").opening, dialled.expect("proved").opening);
        // Ranks may have changed sides.
        let mut sends = dialer.renewed("new", Generation(4), 0, 1).sends;
        let mut receives = dialled.renewed("new", Generation(4), 1, 0).receives;
        assert!(agree(&mut sends.clone(), &mut receives.clone()));
        let removed = |secret: &str, generation, own, peer| {
            let mut forged = dialer.renewed(secret, Generation(generation), own, peer).sends;
            agree(&mut forged, &mut receives.clone())
        };
        assert!(!removed("old", 4, 0, 1) && !removed("new", 3, 0, 1) && !removed("new", 4, 1, 0));
        assert!(!agree(&mut sends, &mut dialer.renewed("new", Generation(4), 0, 1).receives), "not sent back");
        assert!(!agree(&mut dialled.renewed("new", Generation(4), 1, 0).sends, &mut receives));
    }

    #[test]
    fn a_recorded_proof_is_of_no_use() {
        let dial =
            Dial { task: TaskId::from("t"), generation: Generation(1), from: 1, to: 0, leaves: false, nonce: [7; 16] };
        let mut recorded = None;
        let mut play = || {
            let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
            let stream = TcpStream::connect(listener.local_addr().expect("bound")).expect("listening");
            let server = thread::spawn(move || answer(&listener, "s"));
            let stream = &mut Hurried::new(&stream, Instant::now()).expect("connected");
            send(stream, Kind::Dial, &dial).expect("sent");
            let challenge: Challenge = receive(stream, Kind::Challenge).expect("challenged");
            let Challenge { encrypts, nonce, .. } = challenge;
            let proof = *recorded.get_or_insert_with(|| proof("s", "dial", &dial, &Answer { encrypts, nonce }));
            send(stream, Kind::Proof, &Proof { proof }).expect("sent");
            server.join().expect("no panic")
        };
        assert!(play().is_ok(), "who knows the secret is let in");
        let again = play();
        assert!(matches!(again, Err(HandshakeError::Secret(_))), "who has only heard it is not: {again:?}");
    }

    /// An attacker who claims in the dialer's place that the connection stays on its machine.
    #[test]
    fn encryption_cannot_be_talked_away() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let stream = TcpStream::connect(listener.local_addr().expect("bound")).expect("listening");
        let server = thread::spawn(move || answer(&listener, "s"));
        let stream = &mut Hurried::new(&stream, Instant::now()).expect("connected");
        let said =
            Dial { task: TaskId::from("t"), generation: Generation(1), from: 1, to: 0, leaves: true, nonce: [1; 16] };
        send(stream, Kind::Dial, &Dial { leaves: false, ..said.clone() }).expect("sent");
        let challenge: Challenge = receive(stream, Kind::Challenge).expect("challenged");
        assert!(!challenge.encrypts, "it was told that nobody sees the connection");
        let heard = Answer { encrypts: challenge.encrypts, nonce: challenge.nonce };
        let refused = check("s", "accept", &said, &heard, &challenge.proof);
        assert!(matches!(refused, Err(HandshakeError::Secret(_))), "the dialer takes an answer to what it did not say");
        let changed = Answer { encrypts: true, ..heard };
        assert!(check("s", "accept", &Dial { leaves: false, ..said }, &changed, &challenge.proof).is_err());
        drop(server);
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
        let stream = TcpStream::connect(listener.local_addr().expect("bound")).expect("listening");
        let server = thread::spawn(move || answer(&listener, "yours"));
        let stream = &mut Hurried::new(&stream, Instant::now()).expect("connected");
        let dial =
            Dial { task: TaskId::from("t"), generation: Generation(1), from: 1, to: 0, leaves: false, nonce: [0; 16] };
        send(stream, Kind::Dial, &dial).expect("sent");
        let challenge: Challenge = receive(stream, Kind::Challenge).expect("challenged");
        // The best option of a stranger: send the other side's proof back.
        send(stream, Kind::Proof, &Proof { proof: challenge.proof }).expect("sent");
        let refused = server.join().expect("no panic");
        assert!(matches!(refused, Err(HandshakeError::Secret(_))), "{refused:?}");
    }

    #[test]
    fn a_handshake_is_over_in_time_however_its_bytes_come() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let mut stream = TcpStream::connect(listener.local_addr().expect("bound")).expect("listening");
        let begun = Instant::now();
        let server = thread::spawn(move || answer(&listener, "s"));
        while !server.is_finished() {
            // One byte at a time; each read alone is in time.
            let _ = stream.write_all(b"S");
            thread::sleep(PATIENCE / 20);
            assert!(begun.elapsed() < PATIENCE * 2, "it goes on for as long as bytes come");
        }
        assert!(server.join().expect("no panic").is_err());
    }
}
