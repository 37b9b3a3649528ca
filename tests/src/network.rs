//! Separate hosts for workers: one network namespace each, all on one bridge with the coordinator, by lines of a chosen
//! bandwidth and latency. Also slow lines without namespaces.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use serde_json::Value;

use crate::cable;

/// The line of each host, in both directions.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// Bandwidth in megabits per second.
    pub megabits: u32,
    /// Time from one host to another.
    pub late: Duration,
}

impl Line {
    /// Arguments of `tc` for one direction. The burst is one of a millisecond, so that it hides no bandwidth.
    fn shape(self) -> String {
        let burst = (self.megabits * 125).max(16_000);
        format!("root tbf rate {}mbit burst {burst} latency 50ms", self.megabits)
    }
}

/// Traffic over a line in one direction.
#[derive(Debug, Clone, Copy)]
pub struct Sent {
    /// With all headers of each packet.
    pub bytes: u64,
    /// Number of packets.
    pub packets: u64,
}

impl Sent {
    /// Headers of a packet: Ethernet, IPv4, and TCP with timestamps.
    const HEADERS: u64 = 14 + 20 + 32;

    /// Bytes of TCP streams, without the headers of packets.
    pub fn payload(self) -> u64 {
        self.bytes.saturating_sub(self.packets * Self::HEADERS)
    }
}

/// A bridge and a namespace per worker; removed when dropped.
#[derive(Debug)]
pub struct Network {
    id: u32,
    hosts: usize,
}

fn ip(arguments: &str) -> Result<(), String> {
    tool("ip", arguments)
}

fn tool(name: &str, arguments: &str) -> Result<(), String> {
    let done = Command::new(name).args(arguments.split(' ')).output().map_err(|e| format!("{name}: {e}"))?;
    if done.status.success() {
        return Ok(());
    }
    Err(format!("{name} {arguments}: {}", String::from_utf8_lossy(&done.stderr).trim()))
}

impl Network {
    /// Creates the hosts. Skips the test where namespaces cannot be created.
    pub fn new(hosts: usize) -> Option<Self> {
        // Another harness may use the first choice of id; its bridge is neither used nor removed.
        let bridge = |id: u32| ip(&format!("link add stride{id} type bridge")).map(|()| Self { id, hosts });
        let first = std::process::id() % 250;
        let made = bridge(first).or_else(|_| bridge((first + 101) % 250));
        match made.and_then(|network| network.build(None).map(|()| network)) {
            Ok(network) => Some(network),
            Err(error) => {
                fixtures::skip(&format!("network cuts need root and `ip netns`: {error}"));
                None
            }
        }
    }

    /// Creates hosts with such lines.
    ///
    /// # Errors
    /// If this process may not create namespaces, or the kernel has no `tbf` or no TAP devices.
    pub fn with_lines(hosts: usize, line: Line) -> Result<Self, String> {
        let id = std::process::id() % 250;
        ip(&format!("link add stride{id} type bridge"))?;
        let network = Self { id, hosts };
        network.build(Some(line)).map(|()| network)
    }

    /// Connects host `i` to the bridge: `sv` at the bridge, `eth0` in its namespace.
    fn connect(&self, i: usize, late: Duration) -> Result<(), String> {
        let (id, space) = (self.id, self.space(i));
        if late.is_zero() {
            return ip(&format!("link add sv{id}-{i} type veth peer name eth0 netns {space}"));
        }
        let inner = format!("sw{id}-{i}");
        // Every packet passes two cables.
        cable::lay([&format!("sv{id}-{i}"), &inner], late / 2).map_err(|e| format!("a TAP device: {e}"))?;
        ip(&format!("link set sv{id}-{i} txqueuelen 10000"))?;
        ip(&format!("link set {inner} txqueuelen 10000 netns {space} name eth0"))
    }

    fn build(&self, line: Option<Line>) -> Result<(), String> {
        let id = self.id;
        ip(&format!("addr add 10.77.{id}.1/24 dev stride{id}"))?;
        ip(&format!("link set stride{id} up"))?;
        for i in 0..self.hosts {
            let space = self.space(i);
            ip(&format!("netns add {space}"))?;
            self.connect(i, line.map_or(Duration::ZERO, |line| line.late))?;
            if let Some(line) = line {
                tool("tc", &format!("qdisc add dev sv{id}-{i} {}", line.shape()))?;
                tool("tc", &format!("-n {space} qdisc add dev eth0 {}", line.shape()))?;
            }
            ip(&format!("link set sv{id}-{i} master stride{id} up"))?;
            ip(&format!("-n {space} addr add 10.77.{id}.{}/24 dev eth0", i + 2))?;
            ip(&format!("-n {space} link set eth0 up"))?;
            ip(&format!("-n {space} link set lo up"))?;
        }
        Ok(())
    }

    fn space(&self, i: usize) -> String {
        format!("stride{}-{i}", self.id)
    }

    /// Address of the coordinator.
    pub fn coordinator(&self) -> SocketAddr {
        SocketAddr::from(([10, 77, u8::try_from(self.id).expect("below 250"), 1], 7700))
    }

    /// Address of host `i`.
    pub fn host(&self, i: usize) -> Ipv4Addr {
        let [id, own] =
            [self.id, u32::try_from(i).expect("few hosts") + 2].map(|n| u8::try_from(n).expect("below 250"));
        Ipv4Addr::new(10, 77, id, own)
    }

    /// The traffic that host `i` has sent by its line. Needs [`with_lines`](Self::with_lines).
    pub fn sent(&self, i: usize) -> Sent {
        let space = self.space(i);
        let arguments = ["-n", &space, "-s", "-j", "qdisc", "show", "dev", "eth0"];
        let shown = Command::new("tc").args(arguments).output().expect("tc runs");
        let shown: Value = serde_json::from_slice(&shown.stdout).expect("JSON of tc");
        let shaped = shown.as_array().and_then(|all| all.iter().find(|one| one["kind"] == "tbf"));
        let count = |key: &str| shaped.and_then(|one| one[key].as_u64()).expect("a shaped line");
        Sent { bytes: count("bytes"), packets: count("packets") }
    }

    /// The command prefix that runs a command on host `i`.
    pub fn inside(&self, i: usize) -> Vec<String> {
        ["ip", "netns", "exec", &self.space(i)].map(str::to_owned).to_vec()
    }

    /// Cuts host `i` off in both directions, without closing its connections.
    pub fn cut(&self, i: usize) {
        ip(&format!("link set sv{}-{i} nomaster", self.id)).unwrap_or_else(|e| panic!("{e}"));
    }

    /// Limits the bandwidth towards host `i` from now on. Returns false with a notice where `tc` cannot do that.
    pub fn slow_down(&self, i: usize, kilobits: u32) -> bool {
        let shape = format!("qdisc add dev sv{}-{i} root tbf rate {kilobits}kbit burst 32kb latency 400ms", self.id);
        tool("tc", &shape).map_err(|error| fixtures::skip(&format!("a slow link: {error}"))).is_ok()
    }

    /// Drops all packets of host `i` to the other hosts, or stops dropping them. It still receives theirs, and the
    /// coordinator still receives its packets.
    pub fn mute(&self, i: usize, is_mute: bool) {
        let (verb, space) = (if is_mute { "add" } else { "del" }, self.space(i));
        for other in (0..self.hosts).filter(|other| *other != i) {
            ip(&format!("-n {space} route {verb} blackhole 10.77.{}.{}/32", self.id, other + 2))
                .unwrap_or_else(|e| panic!("{e}"));
        }
    }

    /// Restores the host and its connections.
    pub fn mend(&self, i: usize) {
        ip(&format!("link set sv{0}-{i} master stride{0}", self.id)).unwrap_or_else(|e| panic!("{e}"));
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        // Ignore hosts that were never created.
        for i in 0..self.hosts {
            let _ = ip(&format!("link del sv{}-{i}", self.id));
            let _ = ip(&format!("netns del {}", self.space(i)));
        }
        let _ = ip(&format!("link del stride{}", self.id));
    }
}

/// A relay to a server that limits the speed of each connection's answers.
#[derive(Debug)]
pub struct SlowLine {
    address: SocketAddr,
    bytes_per_second: Arc<AtomicU64>,
}

impl SlowLine {
    /// Longest pause between two pieces.
    const BEAT: Duration = Duration::from_millis(50);

    /// Listens on this machine and forwards everything to `server`. It lasts as long as the process.
    pub fn to(server: SocketAddr, bytes_per_second: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("bound");
        let rate = Arc::new(AtomicU64::new(bytes_per_second));
        let shared = rate.clone();
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                // While the server is down, a caller finds the connection closed.
                let Ok(server) = TcpStream::connect(server) else { continue };
                let (there, back) = (pair(&client, &server), pair(&server, &client));
                let rate = shared.clone();
                thread::spawn(move || pass(there, &AtomicU64::new(u64::MAX)));
                thread::spawn(move || pass(back, &rate));
            }
        });
        Self { address, bytes_per_second: rate }
    }

    /// URL to use in place of the server's.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Removes the speed limit.
    pub fn open(&self) {
        self.bytes_per_second.store(u64::MAX, Ordering::SeqCst);
    }
}

fn pair(from: &TcpStream, to: &TcpStream) -> (TcpStream, TcpStream) {
    (from.try_clone().expect("a socket twice"), to.try_clone().expect("a socket twice"))
}

fn pass((mut from, mut to): (TcpStream, TcpStream), bytes_per_second: &AtomicU64) {
    let mut buffer = vec![0; 64 << 10];
    loop {
        let rate = bytes_per_second.load(Ordering::SeqCst);
        let share = usize::try_from(rate / 20).unwrap_or(usize::MAX).clamp(1, buffer.len());
        let Ok(n @ 1..) = from.read(&mut buffer[..share]) else { break };
        if to.write_all(&buffer[..n]).is_err() {
            break;
        }
        if rate != u64::MAX {
            thread::sleep(SlowLine::BEAT);
        }
    }
    // The end of one direction is passed on to the other side.
    let _ = to.shutdown(Shutdown::Write);
    let _ = from.shutdown(Shutdown::Read);
}
