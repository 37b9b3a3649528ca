//! Where peers dial this process: one listener for all gangs that it was ever in.

use std::collections::HashMap;
use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::Duration;

use protocol::{Generation, TaskId};

use super::handshake::{self, HandshakeError};
use super::mesh::{Mesh, Timing, spawn};
use crate::event_count::lock;

/// Where this process is dialled, for all its gangs.
#[derive(Debug)]
pub(crate) struct Endpoint {
    address: SocketAddr,
    pub(super) timing: Timing,
    meshes: Mutex<HashMap<(TaskId, Generation), Weak<Mesh>>>,
    handshakes: AtomicUsize,
}

impl Endpoint {
    /// Handshakes under way at once; more are turned away and dial again.
    const MAX_HANDSHAKES: usize = 64;

    /// Listens and serves in the background, as long as the process lives.
    pub(crate) fn open(address: SocketAddr, timing: Timing) -> io::Result<Arc<Self>> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let endpoint = Arc::new(Self { address, timing, meshes: Mutex::default(), handshakes: AtomicUsize::new(0) });
        let weak = Arc::downgrade(&endpoint);
        spawn("gang-accept", move || accept(&weak, &listener));
        Ok(endpoint)
    }

    /// Where it listens.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    pub(super) fn announce(&self, mesh: &Arc<Mesh>) {
        let mut meshes = lock(&self.meshes);
        meshes.retain(|_, mesh| mesh.strong_count() > 0);
        meshes.insert((mesh.config.task.clone(), mesh.config.generation), Arc::downgrade(mesh));
    }

    fn welcome(&self, mut stream: TcpStream) -> Result<(), HandshakeError> {
        let dial = handshake::wanted(&mut stream)?;
        let unknown = || HandshakeError::Unknown { task: dial.task.clone(), generation: dial.generation };
        let key = (dial.task.clone(), dial.generation);
        let mesh =
            lock(&self.meshes).get(&key).and_then(Weak::upgrade).filter(|m| !m.is_closed()).ok_or_else(unknown)?;
        if dial.to != mesh.config.rank || dial.from <= dial.to || dial.from >= mesh.size() {
            return Err(HandshakeError::Ranks { from: dial.from, to: dial.to });
        }
        handshake::accept(&mut stream, &dial, &mesh.config.secret)?;
        mesh.attach(dial.from, stream);
        Ok(())
    }
}

fn accept(endpoint: &Weak<Endpoint>, listener: &TcpListener) {
    loop {
        let stream = listener.accept();
        let Some(endpoint) = endpoint.upgrade() else { return };
        let stream = match stream {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!("accepting a peer failed: {error}");
                thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        if endpoint.handshakes.fetch_add(1, Ordering::SeqCst) >= Endpoint::MAX_HANDSHAKES {
            endpoint.handshakes.fetch_sub(1, Ordering::SeqCst);
            continue;
        }
        spawn("gang-welcome", move || {
            match endpoint.welcome(stream) {
                Ok(()) => {}
                // The peer heard of the generation before we did, and will dial again.
                Err(error @ HandshakeError::Unknown { .. }) => tracing::debug!("{error}"),
                Err(error) => tracing::warn!("turned a peer away: {error}"),
            }
            endpoint.handshakes.fetch_sub(1, Ordering::SeqCst);
        });
    }
}
