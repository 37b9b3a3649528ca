//! Connections: who may hold one, for how long, and over TLS or not.
//!
//! A connection is a stranger's until a call on it has shown a good token. Strangers share a small part of all connections,
//! and where it is full the oldest of them goes: a worker that connects needs milliseconds to show its token, while those
//! who only sit there are the oldest soon. So a crowd of strangers costs a worker nothing, and cannot use up descriptors.
//!
//! Callers that are no workers share a part of the connections too, and each token has a part of that: readers cannot keep workers out.

use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use access::{Caller, Scope};
use axum::body::Body;
use axum::extract::Request;
use axum::http::StatusCode;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use rustls::ServerConfig;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;
use tower::Service;

use super::failure::Failure;

/// So much of a request's head is held in memory.
const HEAD_BYTES: usize = 64 << 10;
/// How long a TLS handshake may take, and saying goodbye.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// How long to wait when there is no descriptor for another connection.
const PAUSE: Duration = Duration::from_millis(20);
/// So long a stranger may stay however many come: time to show a token. A flood of newcomers waits meanwhile.
const GRACE: Duration = Duration::from_millis(50);

/// How many connections there may be, and how long one may say nothing.
#[derive(Debug, Clone)]
pub struct Connections {
    /// All of them.
    pub most: usize,
    /// Those that have not shown a token yet.
    pub strangers: usize,
    /// Those of callers whose token is no worker's.
    pub clients: usize,
    /// Those of one such token.
    pub of_token: usize,
    /// How long the head of a request may take, and how long a connection may idle between two.
    pub idle: Duration,
}

impl Default for Connections {
    /// As many as half of the descriptors that this process may have; the store and its blobs need the others.
    fn default() -> Self {
        let (descriptors, _) = getrlimit(Resource::RLIMIT_NOFILE).unwrap_or((1024, 1024));
        let most = usize::try_from(descriptors / 2).unwrap_or(usize::MAX).clamp(16, 8192);
        let strangers = (most / 4).clamp(8, 512);
        Self { most, strangers, clients: most / 2, of_token: (most / 8).clamp(8, 256), idle: Duration::from_secs(20) }
    }
}

/// Lets this process have as many descriptors as the system allows it.
pub fn raise_descriptor_limit() {
    if let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE)
        && soft < hard
        && let Err(error) = setrlimit(Resource::RLIMIT_NOFILE, hard, hard)
    {
        tracing::debug!(%error, "the limit of descriptors stays at {soft}");
    }
}

/// All connections.
#[derive(Debug)]
struct Crowd {
    limits: Connections,
    open: AtomicUsize,
    next: AtomicU64,
    /// By arrival.
    strangers: Mutex<BTreeMap<u64, Stranger>>,
    clients: Mutex<Clients>,
}

/// Connections of callers that are no workers.
#[derive(Debug, Default)]
struct Clients {
    all: usize,
    of_token: HashMap<String, usize>,
}

#[derive(Debug)]
struct Stranger {
    since: Instant,
    leave: Arc<Notify>,
}

/// One connection, as its requests see it.
#[derive(Debug)]
pub(crate) struct Peer {
    id: u64,
    from: IpAddr,
    crowd: Arc<Crowd>,
    leave: Arc<Notify>,
    /// The caller whose connections it counts against. Workers have no such limit.
    client: OnceLock<String>,
}

impl Crowd {
    /// Takes a connection in, for which a stranger may have to go; `None` if everybody here is known.
    fn enter(self: &Arc<Self>, from: IpAddr) -> Option<Arc<Peer>> {
        let mut strangers = self.strangers.lock().unwrap_or_else(PoisonError::into_inner);
        let full = self.open.load(Ordering::Relaxed) >= self.limits.most;
        if full || strangers.len() >= self.limits.strangers {
            match strangers.pop_first() {
                Some((_, oldest)) => oldest.leave.notify_one(),
                None if full => return None,
                None => {}
            }
        }
        self.open.fetch_add(1, Ordering::Relaxed);
        let (id, leave) = (self.next.fetch_add(1, Ordering::Relaxed), Arc::new(Notify::new()));
        strangers.insert(id, Stranger { since: Instant::now(), leave: Arc::clone(&leave) });
        Some(Arc::new(Peer { id, from, crowd: Arc::clone(self), leave, client: OnceLock::new() }))
    }

    /// Sends the oldest stranger away.
    fn make_room(&self) {
        if let Some((_, oldest)) = self.strangers.lock().unwrap_or_else(PoisonError::into_inner).pop_first() {
            oldest.leave.notify_one();
        }
    }

    /// How long the next newcomer waits so that the stranger who goes for it has had its time.
    fn wait(&self) -> Option<Duration> {
        let strangers = self.strangers.lock().unwrap_or_else(PoisonError::into_inner);
        let full = strangers.len() >= self.limits.strangers || self.open.load(Ordering::Relaxed) >= self.limits.most;
        let oldest = strangers.first_key_value().filter(|_| full)?.1;
        GRACE.checked_sub(oldest.since.elapsed()).filter(|wait| !wait.is_zero())
    }
}

impl Peer {
    /// The address that it calls from.
    pub(crate) fn from(&self) -> IpAddr {
        self.from
    }

    /// A good token was shown: this is no stranger any more.
    ///
    /// # Errors
    /// If callers that are no workers, or those with this token, have as many connections as they may.
    pub(crate) fn is_known(&self, caller: &Caller) -> Result<(), Failure> {
        self.is_no_stranger();
        if caller.scopes.allow(Scope::Worker) || self.client.get().is_some() {
            return Ok(());
        }
        let limits = &self.crowd.limits;
        let mut clients = self.crowd.clients.lock().unwrap_or_else(PoisonError::into_inner);
        let own = clients.of_token.get(&caller.name).copied().unwrap_or_default();
        if own >= limits.of_token {
            let message = format!("the token of `{}` has {own} connections, which is all that it may", caller.name);
            return Err(Failure::busy(message)
                .hint("close some; a server takes more of one token with `--max-connections-per-token`"));
        }
        if clients.all >= limits.clients {
            let message =
                format!("callers that are no workers have {} connections, which is all there are", clients.all);
            return Err(Failure::busy(message).hint("try again; a server takes more with a higher limit of open files"));
        }
        if self.client.set(caller.name.clone()).is_ok() {
            clients.all += 1;
            clients.of_token.insert(caller.name.clone(), own + 1);
        }
        Ok(())
    }

    fn is_no_stranger(&self) {
        self.crowd.strangers.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.is_no_stranger();
        self.crowd.open.fetch_sub(1, Ordering::Relaxed);
        let Some(token) = self.client.take() else { return };
        let mut clients = self.crowd.clients.lock().unwrap_or_else(PoisonError::into_inner);
        clients.all -= 1;
        if let Some(own) = clients.of_token.get_mut(&token) {
            *own -= 1;
            if *own == 0 {
                clients.of_token.remove(&token);
            }
        }
    }
}

/// A bound address; with TLS if it has a configuration.
pub(crate) struct Listener {
    tcp: TcpListener,
    tls: Option<TlsAcceptor>,
}

impl Listener {
    pub(crate) async fn bind(address: SocketAddr, tls: Option<Arc<ServerConfig>>) -> std::io::Result<Self> {
        Ok(Self { tcp: TcpListener::bind(address).await?, tls: tls.map(TlsAcceptor::from) })
    }

    pub(crate) fn address(&self) -> std::io::Result<SocketAddr> {
        self.tcp.local_addr()
    }
}

/// Answers at all `listeners` until `stopped`, then drops every connection.
pub(crate) async fn serve(
    listeners: Vec<Listener>,
    router: axum::Router,
    limits: Connections,
    mut stopped: watch::Receiver<bool>,
) {
    let crowd = Arc::new(Crowd {
        limits,
        open: AtomicUsize::new(0),
        next: AtomicU64::new(0),
        strangers: Mutex::default(),
        clients: Mutex::default(),
    });
    let mut accepting = JoinSet::new();
    for listener in listeners {
        accepting.spawn(accept(listener, router.clone(), Arc::clone(&crowd)));
    }
    // An error means that the handle is gone, which is a stop too.
    let _ = stopped.wait_for(|stop| *stop).await;
}

async fn accept(listener: Listener, router: axum::Router, crowd: Arc<Crowd>) {
    let mut connections = JoinSet::new();
    loop {
        let (stream, from) = match listener.tcp.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                // Mostly that there is no descriptor left.
                tracing::warn!(%error, "cannot take a connection");
                crowd.make_room();
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        while connections.try_join_next().is_some() {}
        while let Some(wait) = crowd.wait() {
            tokio::time::sleep(wait).await;
        }
        let Some(peer) = crowd.enter(from.ip()) else {
            connections.spawn(async move {
                let _ = tokio::time::timeout(HANDSHAKE, turn_away(stream)).await;
            });
            continue;
        };
        let (router, tls, idle) = (router.clone(), listener.tls.clone(), crowd.limits.idle);
        connections.spawn(async move {
            let leave = Arc::clone(&peer.leave);
            tokio::select! {
                () = greet(stream, tls, router, peer, idle) => {}
                () = leave.notified() => tracing::debug!("a stranger's connection makes room"),
            }
        });
    }
}

async fn greet(stream: TcpStream, tls: Option<TlsAcceptor>, router: axum::Router, peer: Arc<Peer>, idle: Duration) {
    let _ = stream.set_nodelay(true);
    let Some(tls) = tls else { return converse(stream, router, peer, idle).await };
    let handshake = async {
        let mut first = [0];
        stream.peek(&mut first).await?;
        if first == [0x16] {
            return tls.accept(stream).await.map(Some);
        }
        let failure = Failure::new(StatusCode::BAD_REQUEST, "tls", "this server speaks TLS".to_owned());
        answer_plainly(
            stream,
            failure.hint("ask it with `https://`, and with --ca FILE if its certificate is your own"),
        )
        .await?;
        Ok(None)
    };
    match tokio::time::timeout(HANDSHAKE, handshake).await {
        Ok(Ok(Some(stream))) => converse(stream, router, peer, idle).await,
        Ok(Ok(None)) => {}
        Ok(Err(error)) => tracing::debug!(%error, "no TLS"),
        Err(_) => tracing::debug!("a TLS handshake took too long"),
    }
}

async fn converse<S>(stream: S, router: axum::Router, peer: Arc<Peer>, idle: Duration)
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(Arc::clone(&peer));
        let mut router = router.clone();
        async move { Ok::<_, Infallible>(router.call(request.map(Body::new)).await.unwrap_or_else(|never| match never {})) }
    });
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(idle).max_buf_size(HEAD_BYTES);
    if let Err(error) = http.serve_connection(TokioIo::new(stream), service).with_upgrades().await {
        tracing::debug!(%error, "a connection ended");
    }
}

async fn turn_away(stream: TcpStream) -> std::io::Result<()> {
    let message = "this server has as many connections as it takes".to_owned();
    let failure = Failure::new(StatusCode::SERVICE_UNAVAILABLE, "busy", message);
    answer_plainly(stream, failure.hint("try again; a server takes more with a higher limit of open files")).await
}

/// One answer to whatever is asked, and the end.
async fn answer_plainly(mut stream: TcpStream, failure: Failure) -> std::io::Result<()> {
    stream.write_all(&failure.to_http()).await?;
    stream.shutdown().await?;
    // Closing over unread bytes would take the answer back.
    let mut rest = [0; 4096];
    while stream.read(&mut rest).await? > 0 {}
    Ok(())
}
