//! A client that knows several addresses of a server: the leader's and those of its stand-bys.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::Duration;

use access::Server;
use reqwest::{Method, StatusCode};

/// A server on a port of this machine that answers each call by `head`, or closes the connection if that is empty.
struct Fake {
    address: SocketAddr,
    calls: Arc<AtomicU32>,
}

impl Fake {
    fn start(head: &'static str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("bound");
        let calls = Arc::new(AtomicU32::new(0));
        let counted = Arc::clone(&calls);
        thread::spawn(move || {
            for stream in listener.incoming() {
                let mut stream = stream.expect("a connection");
                let reader = BufReader::new(stream.try_clone().expect("a socket"));
                let lines = reader.lines().map_while(Result::ok);
                lines.take_while(|line| !line.is_empty()).for_each(drop);
                counted.fetch_add(1, Ordering::SeqCst);
                stream.write_all(head.as_bytes()).expect("sent");
            }
        });
        Self { address, calls }
    }

    fn calls(&self) -> u32 {
        self.calls.load(Ordering::SeqCst)
    }
}

const WELL: &str = "HTTP/1.1 200 OK\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const SUPERSEDED: &str = "HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";

fn closed() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port")
}

fn client(addresses: &[SocketAddr]) -> Server {
    let addresses: Vec<String> = addresses.iter().map(SocketAddr::to_string).collect();
    Server::new(&addresses.join(","), None, None).expect("a client")
}

async fn status(server: &Server) -> reqwest::Result<StatusCode> {
    let request = server.request(Method::POST, "/v1/runs?a=b").timeout(Duration::from_secs(5));
    server.send(request).await.map(|answer| answer.status())
}

#[tokio::test]
async fn an_address_that_accepts_no_connection_is_left_at_once() {
    let leader = Fake::start(WELL);
    let server = client(&[closed(), closed(), leader.address]);
    let clone = server.clone();
    assert_eq!(status(&server).await.expect("an answer"), StatusCode::OK);
    assert_eq!(clone.url(), format!("http://{}", leader.address), "clones share the address that answers");
    assert_eq!(leader.calls(), 1);
}

#[tokio::test]
async fn a_server_that_leads_no_more_is_left_for_the_next_call() {
    let (old, new) = (Fake::start(SUPERSEDED), Fake::start(WELL));
    let server = client(&[old.address, new.address]);
    assert_eq!(status(&server).await.expect("an answer"), StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(status(&server).await.expect("an answer"), StatusCode::OK);
    assert_eq!((old.calls(), new.calls()), (1, 1));
}

#[tokio::test]
async fn a_call_that_broke_off_is_not_made_twice() {
    let (broken, other) = (Fake::start(""), Fake::start(WELL));
    let server = client(&[broken.address, other.address]);
    assert!(status(&server).await.is_err(), "the first may have done it");
    assert_eq!(other.calls(), 0);
    assert_eq!(status(&server).await.expect("an answer"), StatusCode::OK);
}

#[tokio::test]
async fn addresses_that_are_all_away_are_asked_once_each() {
    let server = client(&[closed(), closed()]);
    let error = status(&server).await.expect_err("nobody is there");
    assert!(error.is_connect(), "{error}");
}
