//! Limits of connections, by number and idle time, with or without TLS.
//!
//! A connection is anonymous until one of its calls has shown a valid token. Anonymous connections share a small part
//! of the total. If that part is full, the oldest anonymous connection is closed. A new worker shows its token within
//! milliseconds, whereas idle connections soon become the oldest. A flood of anonymous connections therefore neither
//! delays workers nor exhausts file descriptors.
//!
//! Callers other than workers also share a limited part, with a further limit per token, so that readers cannot block
//! workers.
//!
//! With TLS, a client may choose HTTP/2. One connection then carries several calls. Each call counts like a
//! connection of its token.

use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use access::{Caller, Scope};
use axum::body::{Body, Bytes, HttpBody};
use axum::extract::Request;
use axum::http::uri::{PathAndQuery, Uri};
use axum::http::{HeaderValue, StatusCode, header};
use http_body::{Frame, SizeHint};
use hyper::body::Incoming;
use hyper::rt::Executor;
use hyper::server::conn::{http1, http2};
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

/// Largest buffered head of a request.
const HEAD_BYTES: usize = 64 << 10;
/// Time limit of a TLS handshake and of the final exchange.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Delay after a failed `accept`, usually for lack of file descriptors.
const PAUSE: Duration = Duration::from_millis(20);
/// Minimum time for an anonymous connection to show a token, however many others arrive. New connections wait
/// meanwhile.
const GRACE: Duration = Duration::from_millis(50);

/// Number of calls that one connection of HTTP/2 carries at a time; further ones wait for their turn.
const STREAMS: u32 = 64;
/// Number of bytes of an answer that wait for a slow reader of HTTP/2.
const UNSENT: usize = 256 << 10;

/// Limits of connections.
#[derive(Debug, Clone)]
pub struct Connections {
    /// Largest number of connections.
    pub most: usize,
    /// Connections without a valid token so far.
    pub anonymous: usize,
    /// Connections of callers other than workers.
    pub clients: usize,
    /// Connections of one such token.
    pub of_token: usize,
    /// Time limit for the head of a request, and for idling between two requests.
    pub idle: Duration,
}

impl Default for Connections {
    /// Half of the process's file descriptors; the store and its blobs need the others.
    fn default() -> Self {
        let (descriptors, _) = getrlimit(Resource::RLIMIT_NOFILE).unwrap_or((1024, 1024));
        let most = usize::try_from(descriptors / 2).unwrap_or(usize::MAX).clamp(16, 8192);
        let anonymous = (most / 4).clamp(8, 512);
        Self { most, anonymous, clients: most / 2, of_token: (most / 8).clamp(8, 256), idle: Duration::from_secs(20) }
    }
}

/// Raises the limit of open files to the maximum that the system allows.
pub fn raise_descriptor_limit() {
    if let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE)
        && soft < hard
        && let Err(error) = setrlimit(Resource::RLIMIT_NOFILE, hard, hard)
    {
        tracing::debug!(%error, "cannot raise the limit of open files above {soft}");
    }
}

/// The set of open connections.
#[derive(Debug)]
struct OpenConnections {
    limits: Connections,
    open: AtomicUsize,
    next: AtomicU64,
    /// Anonymous connections in order of arrival.
    anonymous: Mutex<BTreeMap<u64, Anonymous>>,
    clients: Mutex<Clients>,
}

/// Connections of callers other than workers.
#[derive(Debug, Default)]
struct Clients {
    all: usize,
    of_token: HashMap<String, usize>,
}

#[derive(Debug)]
struct Anonymous {
    since: Instant,
    leave: Arc<Notify>,
}

/// A connection as its requests see it, or a call of a connection of HTTP/2.
#[derive(Debug)]
pub(crate) struct Peer {
    id: u64,
    from: IpAddr,
    encrypted: bool,
    open_connections: Arc<OpenConnections>,
    leave: Arc<Notify>,
    /// The token name whose limit it counts against. Workers have no such limit.
    client: OnceLock<String>,
    /// The connection that carries this call, if it carries several.
    connection: Option<Arc<Self>>,
}

impl OpenConnections {
    /// Admits a connection, closing an anonymous one if necessary; `None` if all connections are authenticated.
    fn admit(self: &Arc<Self>, from: IpAddr, encrypted: bool) -> Option<Arc<Peer>> {
        let mut anonymous = self.anonymous.lock().unwrap_or_else(PoisonError::into_inner);
        let full = self.open.load(Ordering::Relaxed) >= self.limits.most;
        if full || anonymous.len() >= self.limits.anonymous {
            match anonymous.pop_first() {
                Some((_, oldest)) => oldest.leave.notify_one(),
                None if full => return None,
                None => {}
            }
        }
        self.open.fetch_add(1, Ordering::Relaxed);
        let id = self.next.fetch_add(1, Ordering::Relaxed);
        let leave = Arc::new(Notify::new());
        anonymous.insert(id, Anonymous { since: Instant::now(), leave: Arc::clone(&leave) });
        let open_connections = Arc::clone(self);
        let client = OnceLock::new();
        Some(Arc::new(Peer { id, from, encrypted, open_connections, leave, client, connection: None }))
    }

    /// Closes the oldest anonymous connection.
    fn make_room(&self) {
        if let Some((_, oldest)) = self.anonymous.lock().unwrap_or_else(PoisonError::into_inner).pop_first() {
            oldest.leave.notify_one();
        }
    }

    /// Time until the oldest anonymous connection may be closed for a new one.
    fn wait(&self) -> Option<Duration> {
        let anonymous = self.anonymous.lock().unwrap_or_else(PoisonError::into_inner);
        let full = anonymous.len() >= self.limits.anonymous || self.open.load(Ordering::Relaxed) >= self.limits.most;
        let oldest = anonymous.first_key_value().filter(|_| full)?.1;
        GRACE.checked_sub(oldest.since.elapsed()).filter(|wait| !wait.is_zero())
    }
}

impl Peer {
    /// The address of the remote end.
    pub(crate) fn from(&self) -> IpAddr {
        self.from
    }

    /// Returns true if the connection is encrypted.
    pub(crate) fn is_encrypted(&self) -> bool {
        self.encrypted
    }

    /// A call of this connection.
    fn call(self: &Arc<Self>) -> Arc<Self> {
        let open_connections = Arc::clone(&self.open_connections);
        let leave = Arc::clone(&self.leave);
        let connection = Some(Arc::clone(self));
        let Self { id, from, encrypted, .. } = **self;
        Arc::new(Self { id, from, encrypted, open_connections, leave, client: OnceLock::new(), connection })
    }

    /// Marks the connection as authenticated.
    ///
    /// # Errors
    /// The limit of connections for callers other than workers, or for this token, is reached.
    pub(crate) fn authenticate(&self, caller: &Caller) -> Result<(), Failure> {
        match &self.connection {
            Some(connection) => connection.authenticate(caller)?,
            None => self.mark_authenticated(),
        }
        if caller.scopes.allow(Scope::Worker) || self.client.get().is_some() {
            return Ok(());
        }
        let limits = &self.open_connections.limits;
        let mut clients = self.open_connections.clients.lock().unwrap_or_else(PoisonError::into_inner);
        let own = clients.of_token.get(&caller.name).copied().unwrap_or_default();
        if own >= limits.of_token {
            let message = format!("the token of `{}` has {own} connections, which is its limit", caller.name);
            return Err(Failure::busy(message)
                .hint("close some, or start the server with a larger `--max-connections-per-token`"));
        }
        if clients.all >= limits.clients {
            let message = format!("callers other than workers have {} connections, which is their limit", clients.all);
            return Err(Failure::busy(message).hint("try again, or start the server with a higher limit of open files"));
        }
        if self.client.set(caller.name.clone()).is_ok() {
            clients.all += 1;
            clients.of_token.insert(caller.name.clone(), own + 1);
        }
        Ok(())
    }

    fn mark_authenticated(&self) {
        self.open_connections.anonymous.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        if self.connection.is_none() {
            self.mark_authenticated();
            self.open_connections.open.fetch_sub(1, Ordering::Relaxed);
        }
        let Some(token) = self.client.take() else { return };
        let mut clients = self.open_connections.clients.lock().unwrap_or_else(PoisonError::into_inner);
        clients.all -= 1;
        if let Some(own) = clients.of_token.get_mut(&token) {
            *own -= 1;
            if *own == 0 {
                clients.of_token.remove(&token);
            }
        }
    }
}

/// A bound address, with an optional TLS configuration.
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

/// Serves all `listeners` until `stopped`, then drops every connection.
pub(crate) async fn serve(
    listeners: Vec<Listener>,
    router: axum::Router,
    limits: Connections,
    mut stopped: watch::Receiver<bool>,
) {
    let open_connections = Arc::new(OpenConnections {
        limits,
        open: AtomicUsize::new(0),
        next: AtomicU64::new(0),
        anonymous: Mutex::default(),
        clients: Mutex::default(),
    });
    let mut accepting = JoinSet::new();
    for listener in listeners {
        accepting.spawn(accept(listener, router.clone(), Arc::clone(&open_connections)));
    }
    // An error means that the handle was dropped, which counts as a stop.
    let _ = stopped.wait_for(|stop| *stop).await;
}

async fn accept(listener: Listener, router: axum::Router, open_connections: Arc<OpenConnections>) {
    let mut connections = JoinSet::new();
    loop {
        let (stream, from) = match listener.tcp.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                // The usual cause is a lack of file descriptors.
                tracing::warn!(%error, "cannot accept a connection");
                open_connections.make_room();
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        while connections.try_join_next().is_some() {}
        while let Some(wait) = open_connections.wait() {
            tokio::time::sleep(wait).await;
        }
        let Some(peer) = open_connections.admit(from.ip(), listener.tls.is_some()) else {
            connections.spawn(async move {
                let _ = tokio::time::timeout(HANDSHAKE, refuse(stream)).await;
            });
            continue;
        };
        let router = router.clone();
        let tls = listener.tls.clone();
        let idle = open_connections.limits.idle;
        connections.spawn(async move {
            let leave = Arc::clone(&peer.leave);
            tokio::select! {
                () = handshake_and_serve(stream, tls, router, peer, idle) => {}
                () = leave.notified() => tracing::debug!("closed an anonymous connection to make room"),
            }
        });
    }
}

async fn handshake_and_serve(
    stream: TcpStream,
    tls: Option<TlsAcceptor>,
    router: axum::Router,
    peer: Arc<Peer>,
    idle: Duration,
) {
    let _ = stream.set_nodelay(true);
    let Some(tls) = tls else { return serve_connection(stream, router, peer, idle).await };
    let handshake = async {
        let mut first = [0];
        stream.peek(&mut first).await?;
        if first == [0x16] {
            return tls.accept(stream).await.map(Some);
        }
        let failure = Failure::new(StatusCode::BAD_REQUEST, "tls", "this server speaks TLS".to_owned());
        answer_plainly(stream, failure.hint("use `https://`, with --ca FILE if its certificate is your own")).await?;
        Ok(None)
    };
    match tokio::time::timeout(HANDSHAKE, handshake).await {
        Ok(Ok(Some(stream))) if stream.get_ref().1.alpn_protocol() == Some(b"h2") => {
            serve_streams(stream, router, peer, idle).await;
        }
        Ok(Ok(Some(stream))) => serve_connection(stream, router, peer, idle).await,
        Ok(Ok(None)) => {}
        Ok(Err(error)) => tracing::debug!(%error, "no TLS"),
        Err(_) => tracing::debug!("a TLS handshake took too long"),
    }
}

async fn serve_connection<S>(stream: S, router: axum::Router, peer: Arc<Peer>, idle: Duration)
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

/// Serves HTTP/2. A connection without a call for `idle` is closed.
async fn serve_streams<S>(stream: S, router: axum::Router, peer: Arc<Peer>, idle: Duration)
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let calls = Arc::new(AtomicU64::new(0));
    let connection = Arc::clone(&peer);
    let begun = Arc::clone(&calls);
    let service = service_fn(move |mut request: Request<Incoming>| {
        begun.fetch_add(1, Ordering::Relaxed);
        let call = connection.call();
        as_http1(&mut request);
        request.extensions_mut().insert(Arc::clone(&call));
        let mut router = router.clone();
        async move {
            let answer = router.call(request.map(Body::new)).await.unwrap_or_else(|never| match never {});
            Ok::<_, Infallible>(answer.map(|body| Body::new(Counted { body, _call: call })))
        }
    });
    let mut http = http2::Builder::new(Calls::default());
    http.timer(TokioTimer::new()).keep_alive_interval(idle).keep_alive_timeout(HANDSHAKE);
    http.max_concurrent_streams(STREAMS).max_send_buf_size(UNSENT);
    http.max_header_list_size(u32::try_from(HEAD_BYTES).unwrap_or(u32::MAX));
    let mut serving = pin!(http.serve_connection(TokioIo::new(stream), service));
    // This function and the service hold the connection when no call does.
    let at_rest = Arc::strong_count(&peer);
    let mut seen = 0;
    let mut leaving = false;
    loop {
        tokio::select! {
            ended = serving.as_mut() => {
                if let Err(error) = ended {
                    tracing::debug!(%error, "a connection ended");
                }
                return;
            }
            () = tokio::time::sleep(idle) => {
                let begun = calls.load(Ordering::Relaxed);
                let is_idle = begun == seen && Arc::strong_count(&peer) == at_rest;
                seen = begun;
                if is_idle && leaving {
                    // The client was asked to close the connection, and keeps it open.
                    return;
                }
                if is_idle {
                    serving.as_mut().graceful_shutdown();
                    leaving = true;
                }
            }
        }
    }
}

/// The tasks of a connection's calls, which end with it.
#[derive(Debug, Clone, Default)]
struct Calls(Arc<Mutex<JoinSet<()>>>);

impl<F: Future<Output = ()> + Send + 'static> Executor<F> for Calls {
    fn execute(&self, call: F) {
        let mut calls = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        while calls.try_join_next().is_some() {}
        calls.spawn(call);
    }
}

/// Gives a request of HTTP/2 the form of HTTP/1.1: the host in a header, and a target without it.
fn as_http1(request: &mut Request<Incoming>) {
    let uri = request.uri().clone();
    if let Some(host) = uri.authority().and_then(|host| HeaderValue::from_str(host.as_str()).ok()) {
        request.headers_mut().insert(header::HOST, host);
    }
    let target = uri.path_and_query().cloned().unwrap_or_else(|| PathAndQuery::from_static("/"));
    *request.uri_mut() = Uri::from(target);
}

/// The body of an answer over HTTP/2. Its call counts until the body is sent.
struct Counted {
    body: Body,
    _call: Arc<Peer>,
}

impl HttpBody for Counted {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

async fn refuse(stream: TcpStream) -> std::io::Result<()> {
    let message = "this server has reached its limit of connections".to_owned();
    let failure = Failure::new(StatusCode::SERVICE_UNAVAILABLE, "busy", message);
    answer_plainly(stream, failure.hint("try again, or start the server with a higher limit of open files")).await
}

/// Sends one answer to any request and closes the connection.
async fn answer_plainly(mut stream: TcpStream, failure: Failure) -> std::io::Result<()> {
    stream.write_all(&failure.to_http()).await?;
    stream.shutdown().await?;
    // Closing a connection with unread bytes would reset it and discard the answer.
    let mut rest = [0; 4096];
    while stream.read(&mut rest).await? > 0 {}
    Ok(())
}
