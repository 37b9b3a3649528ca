//! A bucket on this machine: `s3s-fs`, which serves the S3 protocol over a folder on a loopback port. Tests can cut the
//! connections to it.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::task::{Context, Poll, ready};

use hyper::server::conn::http1;
use hyper_util::rt::TokioIo;
use s3s::auth::SimpleAuth;
use s3s::service::{S3Service, S3ServiceBuilder};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;

/// Name of the bucket.
pub const NAME: &str = "stride-tests";
/// Access key of the bucket.
pub const KEY: &str = "tests";
/// Secret key of the bucket.
pub const SECRET: &str = "a-secret-of-tests-only";

/// A server of the S3 protocol with one empty bucket. Dropping it deletes all objects.
#[derive(Debug)]
pub struct Bucket {
    dir: tempfile::TempDir,
    address: SocketAddr,
    line: Arc<Line>,
    /// Dropped together with its running tasks.
    _runtime: Runtime,
}

/// Faults of the connections to the server.
#[derive(Debug)]
struct Line {
    /// Bytes that may arrive before one connection is cut; then all connections work again.
    until_cut: AtomicU64,
    cuts: AtomicU64,
    /// True while the server answers no call.
    is_closed: AtomicBool,
}

impl Bucket {
    /// Starts a server on a free port.
    pub fn start() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        std::fs::create_dir(dir.path().join(NAME)).expect("a bucket is a folder");
        let line = Arc::new(Line {
            until_cut: AtomicU64::new(u64::MAX),
            cuts: AtomicU64::new(0),
            is_closed: AtomicBool::new(false),
        });
        let files = s3s_fs::FileSystem::new(dir.path()).expect("a folder to serve");
        let mut service = S3ServiceBuilder::new(files);
        service.set_auth(SimpleAuth::from_single(KEY, SECRET));
        let service = service.build();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("bucket")
            .enable_all()
            .build()
            .expect("threads for a server");
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).expect("a free port");
        let address = listener.local_addr().expect("bound");
        runtime.spawn(serve(listener, service, Arc::clone(&line)));
        Self { dir, address, line, _runtime: runtime }
    }

    /// URL of the server.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Environment of a process that uses the bucket.
    pub fn environment(&self) -> Vec<(&'static str, String)> {
        vec![
            ("AWS_ENDPOINT_URL", self.endpoint()),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
            ("AWS_ACCESS_KEY_ID", KEY.to_owned()),
            ("AWS_SECRET_ACCESS_KEY", SECRET.to_owned()),
        ]
    }

    /// A location for blobs in the bucket.
    pub fn url(prefix: &str) -> String {
        format!("s3://{NAME}/{prefix}")
    }

    /// The folder whose files are the objects.
    pub fn objects(&self) -> PathBuf {
        self.dir.path().join(NAME)
    }

    /// The number of parts of uploads that have not ended.
    pub fn parts(&self) -> usize {
        let files = std::fs::read_dir(self.dir.path()).expect("the server's folder").flatten();
        files.filter(|file| file.file_name().to_string_lossy().contains(".part-")).count()
    }

    /// Cuts a connection once, after `bytes` more bytes have arrived over all connections.
    pub fn cut_after(&self, bytes: u64) {
        self.line.until_cut.store(bytes, Ordering::SeqCst);
    }

    /// The number of connections that were cut.
    pub fn cuts(&self) -> u64 {
        self.line.cuts.load(Ordering::SeqCst)
    }

    /// Ends every connection that sends data, until [`open`](Self::open).
    pub fn close(&self) {
        self.line.is_closed.store(true, Ordering::SeqCst);
    }

    /// Answers calls again.
    pub fn open(&self) {
        self.line.is_closed.store(false, Ordering::SeqCst);
    }
}

async fn serve(listener: TcpListener, service: S3Service, line: Arc<Line>) {
    while let Ok((stream, _)) = listener.accept().await {
        let (service, stream) = (service.clone(), OnLine { stream, line: Arc::clone(&line) });
        // The client notices if a connection ends.
        tokio::spawn(async move { http1::Builder::new().serve_connection(TokioIo::new(stream), service).await });
    }
}

/// The server's end of a connection.
struct OnLine {
    stream: TcpStream,
    line: Arc<Line>,
}

impl AsyncRead for OnLine {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = into.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, into))?;
        let came = (into.filled().len() - before) as u64;
        let line = &self.line;
        // The other side has closed the connection.
        if came == 0 {
            return Poll::Ready(Ok(()));
        }
        let count = |left: u64| match left {
            u64::MAX => None,
            left if came > left => Some(u64::MAX),
            left => Some(left - came),
        };
        let left = line.until_cut.fetch_update(Ordering::SeqCst, Ordering::SeqCst, count);
        if left.is_ok_and(|left| came > left) || line.is_closed.load(Ordering::SeqCst) {
            line.cuts.fetch_add(1, Ordering::SeqCst);
            return Poll::Ready(Err(io::ErrorKind::ConnectionReset.into()));
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for OnLine {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
