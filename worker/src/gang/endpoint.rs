//! The address at which peers dial this process: one listener for all of its gangs, past and present.
//!
//! Anyone may connect; until its handshake is over, a connection counts as a stranger. There is room for
//! [`Endpoint::STRANGERS`] of them. A newcomer replaces the oldest, and none stays longer than the time limit of a
//! handshake. So strangers, however many and slow, delay a peer only until it dials again.

use std::collections::{HashMap, VecDeque};
use std::io;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::{Duration, Instant};

use protocol::{Generation, TaskId};

use super::handshake::{self, HandshakeError, Hurried, Session};
use super::member::{MeshConfig, Timing, spawn};
use crate::event_count::lock;

/// Longest use of a connection after its probe. The other side ends it after [`PATIENCE`](handshake::PATIENCE), which
/// includes the handshake.
const KEPT: Duration = Duration::from_secs(3);

/// A gang of this process, from the view of an incoming connection.
pub(super) trait Gang: std::fmt::Debug + Send + Sync {
    /// Identity and members of the gang.
    fn config(&self) -> &MeshConfig;
    /// Returns true if the gang accepts no more connections.
    fn is_closed(&self) -> bool;
    /// Accepts a peer that has authenticated.
    fn attach(self: Arc<Self>, rank: usize, stream: TcpStream, session: Session);
}

/// The listener of this process, for all its gangs.
#[derive(Debug)]
pub(crate) struct Endpoint {
    address: SocketAddr,
    pub(super) timing: Timing,
    gangs: Mutex<HashMap<(TaskId, Generation), Weak<dyn Gang>>>,
    strangers: Mutex<Strangers>,
    /// Connections of [`probe`](Self::probe) by address, with the time of each.
    probed: Mutex<HashMap<String, (Instant, TcpStream)>>,
}

/// Connections before the end of their handshake, oldest first.
#[derive(Debug, Default)]
struct Strangers {
    next: u64,
    connections: VecDeque<(u64, TcpStream)>,
}

impl Strangers {
    /// Adds a connection and returns its number. Ends the oldest one if there is no room.
    fn admit(&mut self, stream: &TcpStream) -> io::Result<u64> {
        if self.connections.len() >= Endpoint::STRANGERS
            && let Some((_, oldest)) = self.connections.pop_front()
        {
            // Its thread sees that the connection has ended.
            let _ = oldest.shutdown(Shutdown::Both);
        }
        let number = self.next;
        self.next += 1;
        self.connections.push_back((number, stream.try_clone()?));
        Ok(number)
    }

    /// Forgets a connection. Returns false if it was ended to make room.
    fn dismiss(&mut self, number: u64) -> bool {
        let before = self.connections.len();
        self.connections.retain(|(other, _)| *other != number);
        self.connections.len() < before
    }
}

impl Endpoint {
    /// Limit of concurrent handshakes.
    pub(super) const STRANGERS: usize = 64;

    /// Listens and serves in the background, as long as the process lives.
    pub(crate) fn open(address: SocketAddr, timing: Timing) -> io::Result<Arc<Self>> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (gangs, strangers, probed) = Default::default();
        let endpoint = Arc::new(Self { address, timing, gangs, strangers, probed });
        let weak = Arc::downgrade(&endpoint);
        spawn("gang-accept", move || accept(&weak, &listener));
        Ok(endpoint)
    }

    /// Address of the listener.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Checks that a worker listens at `address` and its answers arrive. Does not authenticate it.
    ///
    /// The handshake may follow over the same connection. So a joiner does not need to connect while its gang waits.
    pub(crate) fn probe(&self, address: &str) -> Result<(), HandshakeError> {
        let stream = handshake::probe(address)?;
        let mut probed = lock(&self.probed);
        probed.retain(|_, (since, _)| since.elapsed() < KEPT);
        probed.insert(address.to_owned(), (Instant::now(), stream));
        Ok(())
    }

    /// Returns the connection of the last probe of `address`, or a new one.
    pub(super) fn connect(&self, address: &str) -> Result<TcpStream, HandshakeError> {
        match lock(&self.probed).remove(address) {
            Some((since, stream)) if since.elapsed() < KEPT => Ok(stream),
            _ => handshake::connect(address),
        }
    }

    pub(super) fn announce(&self, config: &MeshConfig, gang: Weak<dyn Gang>) {
        let mut gangs = lock(&self.gangs);
        gangs.retain(|_, gang| gang.strong_count() > 0);
        gangs.insert((config.task.clone(), config.generation), gang);
    }

    fn welcome(&self, number: u64, stream: TcpStream, since: Instant) -> Result<(), HandshakeError> {
        let hurried = &mut Hurried::new(&stream, since)?;
        let dial = handshake::wanted(hurried)?;
        let unknown = || HandshakeError::Unknown { task: dial.task.clone(), generation: dial.generation };
        let key = (dial.task.clone(), dial.generation);
        let gang = lock(&self.gangs).get(&key).and_then(Weak::upgrade);
        let gang = gang.filter(|gang| !gang.is_closed()).ok_or_else(unknown)?;
        let config = gang.config();
        if dial.to != config.rank || dial.from <= dial.to || dial.from >= config.members.len() {
            return Err(HandshakeError::Ranks { from: dial.from, to: dial.to });
        }
        let session = handshake::accept(hurried, &dial, &config.secret)?;
        // From here on the connection belongs to a peer and no longer makes room for strangers.
        if !lock(&self.strangers).dismiss(number) {
            return Err(HandshakeError::Crowded);
        }
        handshake::welcome(hurried)?;
        gang.attach(dial.from, stream, session);
        Ok(())
    }
}

fn accept(endpoint: &Weak<Endpoint>, listener: &TcpListener) {
    loop {
        let stream = listener.accept();
        let Some(endpoint) = endpoint.upgrade() else { return };
        let admitted = stream.and_then(|(stream, _)| Ok((lock(&endpoint.strangers).admit(&stream)?, stream)));
        let (number, stream) = match admitted {
            Ok(admitted) => admitted,
            Err(error) => {
                tracing::warn!("cannot accept a peer's connection: {error}");
                thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        let since = Instant::now();
        spawn("gang-welcome", move || {
            let welcomed = endpoint.welcome(number, stream, since);
            lock(&endpoint.strangers).dismiss(number);
            match welcomed {
                Ok(()) => {}
                Err(error @ (HandshakeError::Secret(_) | HandshakeError::Ranks { .. })) => {
                    tracing::warn!("refused a peer: {error}");
                }
                // A peer that learned of the generation before this member will dial again; failed strangers are not
                // worth a warning.
                Err(error) => tracing::debug!("refused a connection: {error}"),
            }
        });
    }
}
