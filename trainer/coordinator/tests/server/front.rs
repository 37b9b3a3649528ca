//! An address of HTTP/1.1 in front of a server with TLS, which passes each call on over HTTP/2. Tests of calls run over
//! both protocols by it.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::http::{Request, Response, StatusCode, Version, header};
use axum::serve::ListenerExt as _;
use hyper::client::conn::http2::{SendRequest, handshake};
use hyper_util::rt::{TokioExecutor, TokioIo};
use rustls::RootCertStore;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Mutex;
use tokio::task::JoinHandle;
use tokio_rustls::TlsConnector;

/// A protocol of calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Protocol {
    Http1,
    Http2,
}

/// A connection of HTTP/2, and the task that ends with it.
pub(crate) struct Connection {
    pub(crate) send: SendRequest<Body>,
    pub(crate) alive: JoinHandle<()>,
}

/// Connects to a server whose certificate is of the authority `ca`.
pub(crate) async fn connect(address: SocketAddr, ca: &Path) -> Connection {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(ca).unwrap()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions();
    let mut config = config.unwrap().with_root_certificates(roots).with_no_client_auth();
    config.alpn_protocols = vec![b"h2".to_vec()];
    let stream = TcpStream::connect(address).await.unwrap();
    stream.set_nodelay(true).unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    let stream = TlsConnector::from(Arc::new(config)).connect(name, stream).await.unwrap();
    let (send, connection) = handshake(TokioExecutor::new(), TokioIo::new(stream)).await.unwrap();
    Connection { send, alive: tokio::spawn(async move { drop(connection.await) }) }
}

/// The connection behind a front; a closed one is replaced.
struct Behind {
    address: SocketAddr,
    ca: std::path::PathBuf,
    open: Mutex<Option<SendRequest<Body>>>,
}

/// Opens a front of the server at `address`, and returns its URL.
pub(crate) async fn open(address: SocketAddr, ca: &Path) -> String {
    let behind = Behind { address, ca: ca.to_owned(), open: Mutex::default() };
    let calls = Router::new().fallback(pass).with_state(Arc::new(behind));
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let listener = listener.tap_io(|stream| stream.set_nodelay(true).unwrap());
    tokio::spawn(async move { axum::serve(listener, calls).await });
    url
}

async fn pass(State(behind): State<Arc<Behind>>, request: Request<Body>) -> Response<Body> {
    let mut request = request;
    let path = request.uri().path_and_query().map_or("/", |path| path.as_str());
    *request.uri_mut() = format!("https://localhost:{}{path}", behind.address.port()).parse().unwrap();
    *request.version_mut() = Version::HTTP_2;
    // These are of the connection to the front alone.
    for name in [header::HOST, header::CONNECTION, header::TRANSFER_ENCODING] {
        request.headers_mut().remove(name);
    }
    let mut send = {
        let mut open = behind.open.lock().await;
        match open.as_ref().filter(|send| !send.is_closed()) {
            Some(send) => send.clone(),
            None => open.insert(connect(behind.address, &behind.ca).await.send).clone(),
        }
    };
    let answer = match send.ready().await {
        Ok(()) => send.send_request(request).await,
        Err(error) => Err(error),
    };
    match answer {
        Ok(answer) => {
            assert_eq!(answer.version(), Version::HTTP_2);
            answer.map(Body::new)
        }
        Err(error) => {
            let answer = Response::builder().status(StatusCode::BAD_GATEWAY);
            answer.body(Body::from(format!("no answer over HTTP/2: {error:?}"))).unwrap()
        }
    }
}
