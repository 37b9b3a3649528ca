//! Effects of anonymous connections on workers: a thousand idle connections, requests sent byte by byte, and large
//! bodies.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use coordinator::{Config, Connections, Coordinator, Handle, Policy};
use protocol::message::{DesiredAssignments, Join, Joined, PROTOCOL_VERSION, Poll};
use protocol::proof::SECRET_HEADER;
use protocol::stage::Backend;
use registry::{Holder, Store};

async fn start(dir: &std::path::Path, connections: Connections) -> Handle {
    coordinator::shell::raise_descriptor_limit();
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    let policy = Policy { poll_ms: 50, ..Policy::default() };
    Coordinator::start(store, Config { policy, connections, ..Config::embedded() }).await.unwrap()
}

/// The worker's secret.
const SECRET: &str = "the-secret-of-a-worker-of-this-test";

/// A persistent connection with a token.
struct Known {
    stream: TcpStream,
    token: String,
}

impl Known {
    fn connect(handle: &Handle) -> Self {
        let stream = TcpStream::connect(handle.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.set_nodelay(true).unwrap();
        Self { stream, token: handle.token().secret().to_owned() }
    }

    fn post<T: serde::de::DeserializeOwned>(&mut self, path: &str, body: &impl serde::Serialize) -> T {
        let body = serde_json::to_string(body).unwrap();
        let head = format!("authorization: Bearer {}\r\ncontent-type: application/json\r\n", self.token);
        let head = format!("{head}{SECRET_HEADER}: {SECRET}\r\n");
        let head = format!("POST {path} HTTP/1.1\r\nhost: localhost\r\n{head}content-length: {}\r\n\r\n", body.len());
        self.stream.write_all((head + &body).as_bytes()).unwrap();
        let mut answer = Vec::new();
        loop {
            let mut part = [0; 4096];
            let n = self.stream.read(&mut part).unwrap();
            assert!(n > 0, "the server closed a worker's connection");
            answer.extend_from_slice(&part[..n]);
            let text = String::from_utf8_lossy(&answer);
            let Some((head, body)) = text.split_once("\r\n\r\n") else { continue };
            let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")).unwrap();
            if body.len() >= length.parse().unwrap() {
                assert!(head.starts_with("HTTP/1.1 200"), "{text}");
                return serde_json::from_str(body).unwrap();
            }
        }
    }
}

fn join(handle: &Handle) -> (Known, Joined) {
    let mut known = Known::connect(handle);
    let join = Join {
        protocol: PROTOCOL_VERSION,
        worker: "w".into(),
        pid: 7,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "127.0.0.1:1".into(),
        labels: Default::default(),
    };
    let joined = known.post("/v1/workers", &join);
    (known, joined)
}

/// Sorted latencies of heartbeats on a persistent connection, of heartbeats on new connections, and of an echo thread.
/// The echo measures the load of the machine itself.
struct Times {
    kept: Vec<Duration>,
    new: Vec<Duration>,
    echo: Vec<Duration>,
}

/// A connection to a thread that returns its input.
fn echo() -> TcpStream {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    stream.set_nodelay(true).unwrap();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        let mut bytes = [0; 256];
        while stream.read_exact(&mut bytes).is_ok() && stream.write_all(&bytes).is_ok() {}
    });
    stream
}

/// Sends heartbeats until `until`. Each is answered at once, because its version is never current.
fn beat(handle: &Handle, until: Instant) -> Times {
    let (mut known, joined) = join(handle);
    let poll =
        Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: u64::MAX, leaving: false };
    let mut times = Times { kept: vec![], new: vec![], echo: vec![] };
    let mut echo = echo();
    while Instant::now() < until {
        for _ in 0..9 {
            let begun = Instant::now();
            known.post::<DesiredAssignments>("/v1/workers/w/poll", &poll);
            times.kept.push(begun.elapsed());
            let begun = Instant::now();
            echo.write_all(&[0; 256]).unwrap();
            echo.read_exact(&mut [0; 256]).unwrap();
            times.echo.push(begun.elapsed());
            thread::sleep(Duration::from_millis(3));
        }
        let begun = Instant::now();
        Known::connect(handle).post::<DesiredAssignments>("/v1/workers/w/poll", &poll);
        times.new.push(begun.elapsed());
    }
    times.kept.sort();
    times.new.sort();
    times.echo.sort();
    times
}

#[track_caller]
fn check(what: &str, times: &Times) {
    let percentile = |times: &[Duration], percent: usize| times[times.len() * percent / 100];
    let [p50, p99] = [50, 99].map(|percent| percentile(&times.kept, percent));
    let [new, echo] = [&times.new, &times.echo].map(|times| percentile(times, 99));
    println!(
        "{what}: {} heartbeats, median {p50:.1?}, p99 {p99:.1?}, over new connections {new:.1?}; an echo's p99 is {echo:.1?}",
        times.kept.len()
    );
    // An overloaded machine delays all connections.
    assert!(p99 < Duration::from_millis(100) + 4 * echo, "{what}: {p99:?}");
    assert!(new < Duration::from_secs(2), "{what}, over new connections: {new:?}");
}

fn resident_mib() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<usize>().unwrap() / 1024
}

/// Repeats `work` in `size` threads until `stop`.
fn crowd(size: usize, stop: &Arc<AtomicBool>, work: impl Fn() + Send + Sync + 'static) -> Vec<thread::JoinHandle<()>> {
    let work = Arc::new(work);
    let one = |_| {
        let (stop, work) = (Arc::clone(stop), Arc::clone(&work));
        thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                work();
            }
        })
    };
    (0..size).map(one).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_crowd_of_strangers_delays_no_heartbeat() {
    let dir = tempfile::tempdir().unwrap();
    // Roughly the limits for 200 file descriptors.
    let few = Connections { most: 100, anonymous: 50, ..Connections::default() };
    let handle = Arc::new(start(dir.path(), few).await);
    let address = handle.address();
    let before = resident_mib();

    let idle: Vec<TcpStream> = (0..1000).map(|_| TcpStream::connect(address).unwrap()).collect();
    let times = beat(&handle, Instant::now() + Duration::from_secs(2));
    check("1,000 idle connections", &times);

    let stop = Arc::new(AtomicBool::new(false));
    let mut threads = crowd(64, &stop, move || {
        let Ok(mut stream) = TcpStream::connect(address) else { return };
        for byte in b"GET /v1/runs HTTP/1.1\r\nhost: localhost\r\nx: " {
            if stream.write_all(&[*byte]).is_err() {
                return;
            }
            thread::sleep(Duration::from_millis(20));
        }
    });
    let times = beat(&handle, Instant::now() + Duration::from_secs(2));
    check("and 64 slow strangers", &times);

    // Bodies of anonymous callers are refused unread. Bodies with a token but without a grant are read within limits.
    let sent = Arc::new(AtomicUsize::new(0));
    let body = Arc::new(vec![b' '; 8 << 20]);
    let token = handle.token().secret().to_owned();
    for headers in [String::new(), format!("authorization: Bearer {token}\r\n")] {
        let (sent, body) = (Arc::clone(&sent), Arc::clone(&body));
        threads.extend(crowd(8, &stop, move || {
            let Ok(mut stream) = TcpStream::connect(address) else { return };
            let head =
                format!("POST /v1/metrics HTTP/1.1\r\nhost: localhost\r\n{headers}content-type: application/json\r\n");
            let head = format!("{head}content-length: {}\r\n\r\n", body.len());
            // The body is refused at its first bytes, or read to the end and then refused.
            let _ = stream.write_all(head.as_bytes());
            for part in body.chunks(64 << 10) {
                if stream.write_all(part).is_err() {
                    break;
                }
                sent.fetch_add(part.len(), Ordering::Relaxed);
            }
            let _ = stream.set_read_timeout(Some(Duration::from_secs(5)));
            let _ = stream.read(&mut [0; 64]);
        }));
    }
    let times = beat(&handle, Instant::now() + Duration::from_secs(3));
    let after = resident_mib();
    stop.store(true, Ordering::Relaxed);
    println!("{} MiB of bodies sent; resident memory {before} -> {after} MiB", sent.load(Ordering::Relaxed) >> 20);
    check("and large bodies without grants", &times);
    assert!(after < before + 256, "resident memory {before} -> {after} MiB");
    for thread in threads {
        thread.join().unwrap();
    }
    drop(idle);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_connections_end_and_known_ones_are_not_evicted() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Connections { most: 20, anonymous: 4, idle: Duration::from_secs(4), ..Connections::default() };
    let handle = start(dir.path(), limits).await;
    let (mut known, joined) = join(&handle);
    let poll =
        Poll { incarnation: joined.incarnation, doing: vec![], ready: vec![], version: u64::MAX, leaving: false };

    // The fifth anonymous connection replaces the first.
    let mut anonymous: Vec<TcpStream> = (0..5).map(|_| TcpStream::connect(handle.address()).unwrap()).collect();
    let ended = |stream: &mut TcpStream, within: Duration| {
        stream.set_read_timeout(Some(within)).unwrap();
        // Either the end of the stream or a reset.
        !stream
            .read(&mut [0; 64])
            .is_err_and(|e| matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut))
    };
    assert!(ended(&mut anonymous[0], Duration::from_secs(3)), "the oldest goes at once");
    known.post::<DesiredAssignments>("/v1/workers/w/poll", &poll);
    assert!(ended(&mut anonymous[4], Duration::from_secs(20)), "silence ends");

    // All connections are authenticated: another one is refused, and the existing ones stay open.
    drop(known);
    let come = |_| {
        let mut one = Known::connect(&handle);
        one.post::<DesiredAssignments>("/v1/workers/w/poll", &poll);
        one
    };
    let mut all: Vec<Known> = (0..20).map(come).collect();
    let answer = one_more(handle.address());
    assert!(answer.starts_with("HTTP/1.1 503") && answer.contains("limit of connections"), "{answer}");
    all[0].post::<DesiredAssignments>("/v1/workers/w/poll", &poll);
    handle.shutdown().await;
}

fn one_more(address: SocketAddr) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(b"GET /v1/health HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    stream.shutdown(std::net::Shutdown::Write).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}
