//! Requests as a browser writes them, and a server to send them to.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::Duration;

use access::{Scope, Scopes, Tokens};
use coordinator::{Config, Coordinator, Handle};
use registry::{Holder, Store};
use serde_json::Value;

/// An answer, its header names in small letters.
pub(crate) struct Answer {
    pub(crate) status: u16,
    pub(crate) headers: BTreeMap<String, String>,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    pub(crate) fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&self.body)))
    }

    /// The cookie that it gives, as a browser sends it back.
    pub(crate) fn cookie(&self) -> String {
        self.header("set-cookie").split(';').next().unwrap().to_owned()
    }
}

/// One request over a connection of its own.
pub(crate) fn call(address: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)]) -> Answer {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let mut request = format!("{method} {path} HTTP/1.1\r\nconnection: close\r\ncontent-length: 0\r\n");
    if !headers.iter().any(|(name, _)| *name == "host") {
        request += &format!("host: {address}\r\n");
    }
    headers.iter().for_each(|(name, value)| request += &format!("{name}: {value}\r\n"));
    stream.write_all(format!("{request}\r\n").as_bytes()).unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).unwrap();
    let end = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
    let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let headers = head.lines().skip(1).filter_map(|line| line.split_once(": "));
    let headers = headers.map(|(name, value)| (name.to_ascii_lowercase(), value.to_owned())).collect();
    Answer { status: head[9..12].parse().unwrap(), headers, body: bytes[end + 4..].to_vec() }
}

/// The secret of the token that is named after its scope.
pub(crate) fn token(scope: Scope) -> String {
    format!("token-of-one-who-may-{scope}")
}

/// A token for each scope.
pub(crate) fn tokens() -> Tokens {
    let mut tokens = Tokens::default();
    for scope in Scope::ALL {
        assert!(tokens.add(format!("the-{scope}"), Scopes::of(&[scope]), &token(scope).parse().unwrap()));
    }
    tokens
}

pub(crate) async fn start(dir: &Path, config: Config) -> Handle {
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    Coordinator::start(store, config).await.unwrap()
}

pub(crate) async fn with_tokens(dir: &Path) -> Handle {
    start(dir, Config { tokens: tokens(), ..Config::embedded() }).await
}
