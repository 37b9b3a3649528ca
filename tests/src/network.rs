//! Hosts of their own for workers: a network namespace each, all on one bridge with the coordinator.

use std::net::SocketAddr;
use std::process::Command;

/// A bridge and a namespace per worker; gone when dropped.
#[derive(Debug)]
pub struct Network {
    id: u32,
    hosts: usize,
}

fn ip(arguments: &str) -> Result<(), String> {
    let done = Command::new("ip").args(arguments.split(' ')).output().map_err(|e| format!("ip: {e}"))?;
    if done.status.success() {
        return Ok(());
    }
    Err(format!("ip {arguments}: {}", String::from_utf8_lossy(&done.stderr).trim()))
}

impl Network {
    /// `None`, loudly, where namespaces cannot be made.
    pub fn new(hosts: usize) -> Option<Self> {
        // Another harness may have the first choice: its bridge is neither used nor removed.
        let bridge = |id: u32| ip(&format!("link add stride{id} type bridge")).map(|()| Self { id, hosts });
        let first = std::process::id() % 250;
        let made = bridge(first).or_else(|_| bridge((first + 101) % 250));
        match made.and_then(|network| network.build().map(|()| network)) {
            Ok(network) => Some(network),
            Err(error) => {
                eprintln!("SKIPPED: network cuts need root and `ip netns`: {error}");
                None
            }
        }
    }

    fn build(&self) -> Result<(), String> {
        let id = self.id;
        ip(&format!("addr add 10.77.{id}.1/24 dev stride{id}"))?;
        ip(&format!("link set stride{id} up"))?;
        for i in 0..self.hosts {
            let space = self.space(i);
            ip(&format!("netns add {space}"))?;
            ip(&format!("link add sv{id}-{i} type veth peer name eth0 netns {space}"))?;
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

    /// Where the coordinator listens.
    pub fn coordinator(&self) -> SocketAddr {
        SocketAddr::from(([10, 77, u8::try_from(self.id).expect("below 250"), 1], 7700))
    }

    /// What runs a command on host `i`.
    pub fn inside(&self, i: usize) -> Vec<String> {
        ["ip", "netns", "exec", &self.space(i)].map(str::to_owned).to_vec()
    }

    /// Nothing reaches host `i` and nothing leaves it; no connection is told.
    pub fn cut(&self, i: usize) {
        ip(&format!("link set sv{}-{i} nomaster", self.id)).unwrap_or_else(|e| panic!("{e}"));
    }

    /// The host is back, and so are its connections.
    pub fn mend(&self, i: usize) {
        ip(&format!("link set sv{0}-{i} master stride{0}", self.id)).unwrap_or_else(|e| panic!("{e}"));
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        // What was never made cannot be removed, and that is fine.
        for i in 0..self.hosts {
            let _ = ip(&format!("link del sv{}-{i}", self.id));
            let _ = ip(&format!("netns del {}", self.space(i)));
        }
        let _ = ip(&format!("link del stride{}", self.id));
    }
}
