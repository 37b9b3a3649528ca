//! Connections of a mesh: rank i dials every rank below it, and each connection gets a thread that reads its frames.

use std::io;
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::{Duration, Instant};

use protocol::Generation;
use protocol::message::LossCause;
use tokio::sync::Notify;

use super::endpoint::{Endpoint, Gang};
use super::frame::{self, FrameError, Kind, MAX_PAYLOAD};
use super::handover::{Follow, Reading};
use super::handshake::{self, HandshakeError, Hurried, Session};
use super::link::{BLINK, Heard, Link, Pulse, Writer};
use super::member::{MeshConfig, Timing, spawn};
use super::mesh::Mesh;
use super::pace::Pace;
use super::peer::{Peer, Standing};
use super::seal::Seal;
use crate::event_count::{EventCount, lock};

impl Mesh {
    /// Creates the mesh and connects in the background. The connections of the generation `before` to members of both
    /// continue.
    pub(crate) fn open(
        config: MeshConfig,
        endpoint: &Arc<Endpoint>,
        event_count: Arc<EventCount>,
        wake: Arc<Notify>,
        before: Option<&Arc<Self>>,
    ) -> Arc<Self> {
        let peers = Mutex::new(config.members.iter().map(|_| Peer::new()).collect());
        let waits_for = AtomicUsize::new(0);
        let closed = AtomicBool::new(false);
        let timing = endpoint.timing;
        let pace = Pace::new(config.members.len(), timing.slow);
        let memory = config.members.iter().map(|_| Mutex::default()).collect();
        let uses_no_memory = AtomicBool::new(false);
        let successor = Arc::default();
        let mesh = Self {
            config,
            endpoint: endpoint.clone(),
            timing,
            peers,
            event_count,
            wake,
            waits_for,
            pace,
            memory,
            uses_no_memory,
            closed,
            successor,
        };
        let mesh = Arc::new(mesh);
        if mesh.size() > 1 {
            let gang: Arc<dyn Gang> = mesh.clone();
            endpoint.announce(&mesh.config, Arc::downgrade(&gang));
            if let Some(before) = before {
                mesh.follow(before);
            }
            let inherits: Vec<bool> = lock(&mesh.peers).iter().map(|peer| peer.inherits).collect();
            (0..mesh.config.rank).filter(|rank| !inherits[*rank]).for_each(|rank| mesh.start_dial(rank));
            let weak = Arc::downgrade(&mesh);
            spawn("gang-alive", move || keep_alive(&weak, timing));
        }
        mesh
    }

    /// Dials a rank in the background.
    pub(super) fn start_dial(self: &Arc<Self>, rank: usize) {
        let mesh = self.clone();
        spawn("gang-dial", move || mesh.dial(rank));
    }

    fn dial(self: Arc<Self>, rank: usize) {
        let mut refused: Option<Instant> = None;
        let mut pause = Duration::from_millis(10);
        while !self.is_closed() {
            let Err(error) = self.connect(rank) else { return };
            let since = if error.is_refused() { *refused.get_or_insert_with(Instant::now) } else { Instant::now() };
            if since.elapsed() > self.timing.refused {
                let reason = format!("nothing listens at {}", self.config.members[rank].peer_address);
                self.lose(rank, LossCause::Unreachable, reason);
                return;
            }
            if !error.is_refused() {
                refused = None;
            }
            if let Standing::Unmet(last) = &mut lock(&self.peers)[rank].standing {
                *last = Some(error.to_string());
            }
            thread::sleep(pause);
            pause = (pause * 2).min(Duration::from_millis(200));
        }
    }

    /// Dials a rank once. The stage sends to it before its welcome is here, which saves a crossing of the line in both
    /// directions.
    fn connect(self: &Arc<Self>, rank: usize) -> Result<(), HandshakeError> {
        let stream = self.endpoint.connect(&self.config.members[rank].peer_address)?;
        let hurried = &mut Hurried::new(&stream, Instant::now())?;
        let MeshConfig { task, generation, rank: from, secret, .. } = &self.config;
        let session = handshake::dial(hurried, task, *generation, *from, rank, secret)?;
        let Some(incoming) = self.add(rank, &stream, session, true) else { return Ok(()) };
        match handshake::welcomed(hurried) {
            Ok(()) => {
                self.confirm(rank, &incoming.link);
                incoming.read(self, rank);
                Ok(())
            }
            Err(error) => {
                self.withdraw(rank, &incoming.link, &error.to_string());
                Err(error)
            }
        }
    }

    /// Adds a connection whose other side has authenticated as `rank`.
    fn attach(self: &Arc<Self>, rank: usize, stream: &TcpStream, session: Session) {
        if let Some(incoming) = self.add(rank, stream, session, false) {
            incoming.read(self, rank);
        }
    }

    /// Lets the stage send over a connection. Returns its other direction, or `None` if the connection is not wanted.
    fn add(self: &Arc<Self>, rank: usize, stream: &TcpStream, session: Session, is_unproven: bool) -> Option<Incoming> {
        let Session { opening, sends, receives } = session;
        let is_local = !sends.is_encrypted();
        let pulse = lock(&self.peers)[rank].pulse.clone();
        let both = stream.try_clone().and_then(|reader| {
            let writer = stream.try_clone()?;
            writer.set_write_timeout(Some(BLINK))?;
            Link::limit_unsent(&writer, self.size() - 1)?;
            let socket = stream.try_clone()?;
            let writer = Writer { stream: writer, seal: sends, pulse: pulse.clone(), signed: Instant::now() };
            Ok((reader, Link { socket, writer: Mutex::new(writer), is_local, opening }))
        });
        let (reader, link) = match both {
            Ok((reader, link)) => (reader, Arc::new(link)),
            Err(error) => {
                self.lose(rank, LossCause::Unreachable, error.to_string());
                return None;
            }
        };
        let first;
        {
            let mut peers = lock(&self.peers);
            let peer = &mut peers[rank];
            // A peer that dials does not continue its connection of the generation before.
            let may_attach = matches!(peer.standing, Standing::Unmet(_)) || peer.is_unproven;
            if self.is_closed() || !may_attach {
                return None;
            }
            if let Some(old) = peer.link.replace(link.clone()) {
                let _ = old.socket.shutdown(Shutdown::Both);
            }
            peer.is_unproven = is_unproven;
            // The peer repeats its first frame too.
            peer.inbox.clear();
            first = peer.first;
            peer.pulse.beat();
            peer.standing = Standing::Up;
            peer.inherits = false;
        }
        if let Some(first) = first {
            // An error becomes visible to the reader.
            let _ = link.send(first, &[], &self.sign(), self.timing.patience, &|| self.is_closed());
        }
        self.event_count.notify();
        Some(Incoming { stream: reader, link, seal: receives, pulse })
    }

    /// The peer has welcomed this member: from now on the end of the connection is the loss of the peer.
    fn confirm(&self, rank: usize, link: &Arc<Link>) {
        let peer = &mut lock(&self.peers)[rank];
        if peer.link.as_ref().is_some_and(|own| Arc::ptr_eq(own, link)) {
            peer.is_unproven = false;
        }
    }

    /// Takes back a connection that was added and never welcomed.
    fn withdraw(&self, rank: usize, link: &Arc<Link>, reason: &str) {
        let _ = link.socket.shutdown(Shutdown::Both);
        {
            let peer = &mut lock(&self.peers)[rank];
            if peer.link.as_ref().is_some_and(|own| Arc::ptr_eq(own, link)) && peer.standing == Standing::Up {
                peer.link = None;
                peer.standing = Standing::Unmet(Some(reason.to_owned()));
                peer.is_unproven = false;
            }
            // The thread that dials tries again itself.
            peer.inherits = false;
        }
        self.disinherit_successors(rank, link, reason);
    }
}

/// The incoming direction of a connection before it has a thread that reads it.
struct Incoming {
    stream: TcpStream,
    link: Arc<Link>,
    seal: Seal,
    pulse: Pulse,
}

impl Incoming {
    /// Starts the thread that reads it.
    fn read(self, mesh: &Arc<Mesh>, rank: usize) {
        let Self { stream, link, seal, pulse } = self;
        // Keep-alives arrive far more often than this; the timeout only bounds the life of a reader.
        if let Err(error) = stream.set_read_timeout(Some(mesh.timing.patience * 3)) {
            return mesh.lose(rank, LossCause::Unreachable, error.to_string());
        }
        let reading = Reading::new(mesh, rank, &link);
        spawn("gang-read", move || read(reading, &stream, seal, pulse));
    }
}

/// Reads frames from a link, of one generation after the other.
fn read(mut reading: Reading, stream: &TcpStream, mut seal: Seal, pulse: Pulse) {
    let mut buffered = io::BufReader::with_capacity(64 << 10, Heard { stream, pulse });
    loop {
        match frame::read_sealed(&mut buffered, MAX_PAYLOAD, &mut seal) {
            Ok(frame) => {
                let next = (frame.kind == Kind::Bye && frame.step > 0).then_some(Generation(frame.step));
                reading.receive(frame);
                match next.map(|next| reading.follow(next)) {
                    None => {}
                    Some(Follow::Here(renewed)) => seal = renewed,
                    Some(Follow::Nowhere) => {
                        // The peer has parted. Keep reading until it closes. Otherwise the kernel resets the connection
                        // and the peer may lose our last frames.
                        let _ = io::copy(&mut buffered, &mut io::sink());
                        return reading.end("the connection was closed");
                    }
                    Some(Follow::Skipped) => {
                        let _ = stream.shutdown(Shutdown::Both);
                        return reading.end("this member was not in the generation of the peer");
                    }
                }
            }
            Err(error) => {
                let is_closed = matches!(error, FrameError::Closed);
                reading.end(&error.to_string());
                if !is_closed {
                    // The other side must not continue to send.
                    let _ = stream.shutdown(Shutdown::Both);
                }
                return;
            }
        }
    }
}

fn keep_alive(mesh: &Weak<Mesh>, timing: Timing) {
    loop {
        thread::sleep(timing.keep_alive);
        let Some(mesh) = mesh.upgrade() else { return };
        if mesh.is_closed() {
            return;
        }
        let links: Vec<_> = lock(&mesh.peers).iter().map(|peer| peer.link.clone()).collect();
        for link in links.into_iter().flatten() {
            // A thread that is writing to a link sends the keep-alive itself.
            if let Ok(mut writer) = link.writer.try_lock() {
                // An error becomes visible to a thread that waits for the peer.
                let _ = writer.sign(&mesh.sign(), timing.patience, &|| mesh.is_closed());
            }
        }
    }
}

impl Gang for Mesh {
    fn config(&self) -> &MeshConfig {
        &self.config
    }

    fn is_closed(&self) -> bool {
        self.is_closed()
    }

    fn attach(self: Arc<Self>, rank: usize, stream: TcpStream, session: Session) {
        Self::attach(&self, rank, &stream, session);
    }
}
