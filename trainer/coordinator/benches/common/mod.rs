//! HTTP clients over TCP, and workers that do not compute.
#![allow(dead_code, reason = "not every bench uses all of it")]

use std::collections::{BTreeMap, HashMap};
use std::net::SocketAddr;
use std::path::Path;

use protocol::message::{
    Assignment, DesiredAssignments, Join, Joined, PROTOCOL_VERSION, Poll, ReportOutcome, TaskOutcome,
};
use protocol::proof::{BlobStored, GRANT_HEADER, SECRET_HEADER, Vouched};
use protocol::stage::Backend;
use protocol::{ArtifactKind, Digest, Incarnation, Manifest, TaskId};
use registry::{Holder, OpenError, Store};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

pub(crate) type Result<T = ()> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// Opens a store; a new one has its catalog in PostgreSQL if `STRIDE_TEST_CATALOG` is `durable`.
pub(crate) async fn open(dir: &Path) -> std::result::Result<Store, OpenError> {
    cluster_tests::postgres::place_catalog(dir);
    Store::open(dir, Holder::this_process("a bench")).await
}

/// A persistent connection.
pub(crate) struct Connection {
    stream: TcpStream,
    buffer: Vec<u8>,
    token: String,
}

impl Connection {
    pub(crate) async fn open(address: SocketAddr, token: &str) -> Result<Self> {
        let stream = TcpStream::connect(address).await?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, buffer: Vec::new(), token: token.to_owned() })
    }

    pub(crate) async fn send(&mut self, what: &str, headers: &str, body: &[u8]) -> Result<Vec<u8>> {
        let length = body.len();
        let token = &self.token;
        let headers = format!("authorization: Bearer {token}\r\n{headers}content-length: {length}");
        let head = format!("{what} HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n\r\n");
        let mut request = head.into_bytes();
        request.extend_from_slice(body);
        self.stream.write_all(&request).await?;
        self.buffer.clear();
        let (mut end, mut length) = (None, 0);
        loop {
            if end.is_none()
                && let Some(at) = self.buffer.windows(4).position(|w| w == b"\r\n\r\n")
            {
                let head = std::str::from_utf8(&self.buffer[..at])?.to_lowercase();
                let value = head.lines().find_map(|line| line.strip_prefix("content-length: "));
                length = value.ok_or("no length")?.trim().parse()?;
                end = Some(at + 4);
            }
            if let Some(end) = end
                && self.buffer.len() >= end + length
            {
                let answer = self.buffer[end..end + length].to_vec();
                if &self.buffer[9..12] == b"200" {
                    return Ok(answer);
                }
                return Err(String::from_utf8_lossy(&answer).into_owned().into());
            }
            if self.stream.read_buf(&mut self.buffer).await? == 0 {
                return Err("the server closed the connection".into());
            }
        }
    }

    pub(crate) async fn post<T: DeserializeOwned>(
        &mut self,
        path: &str,
        secret: &str,
        body: &impl Serialize,
    ) -> Result<T> {
        let body = serde_json::to_vec(body)?;
        let headers = format!("content-type: application/json\r\n{SECRET_HEADER}: {secret}\r\n");
        let answer = self.send(&format!("POST {path}"), &headers, &body).await?;
        Ok(serde_json::from_slice(&answer)?)
    }

    /// Uploads a blob and returns its receipt.
    pub(crate) async fn put(&mut self, assignment: &Assignment, bytes: &[u8]) -> Result<String> {
        let grant = serde_json::to_string(&assignment.grant)?;
        let header = format!("{GRANT_HEADER}: {grant}\r\n{SECRET_HEADER}: {}\r\n", assignment.secret);
        let answer = self.send(&format!("PUT /v1/blobs/{}", Digest::of(bytes)), &header, bytes).await?;
        Ok(serde_json::from_slice::<BlobStored>(&answer)?.receipt.ok_or("a stored blob has a receipt")?)
    }
}

/// A worker that does not compute.
pub(crate) struct Worker {
    pub(crate) name: String,
    pub(crate) incarnation: Incarnation,
    pub(crate) connection: Connection,
    /// True if it says that it is ready for gangs.
    pub(crate) joins_gangs: bool,
    /// Gang tasks of the last answer whose inputs it would fetch. It fetches nothing, so it is ready at once.
    ready: Vec<TaskId>,
    /// The version of its orders that [`Self::wait`] has last received.
    version: u64,
    /// Receipts by task and blob.
    uploaded: HashMap<(TaskId, Digest), String>,
}

/// The secret of every worker in a bench.
const SECRET: &str = "the-secret-of-each-worker-of-this-bench";

impl Worker {
    pub(crate) async fn join(address: SocketAddr, token: &str, i: usize) -> Result<Self> {
        let mut connection = Connection::open(address, token).await?;
        let name = format!("w{i}");
        let join = Join {
            protocol: PROTOCOL_VERSION,
            worker: name.as_str().into(),
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            code_versions: protocol::stage::StageSettings::code_versions(),
            peer_address: "127.0.0.1:1".into(),
            labels: Default::default(),
        };
        let joined: Joined = connection.post("/v1/workers", SECRET, &join).await?;
        Ok(Self {
            name,
            incarnation: joined.incarnation,
            connection,
            joins_gangs: true,
            ready: Vec::new(),
            version: 0,
            uploaded: HashMap::new(),
        })
    }

    /// Sends a heartbeat that is answered at once.
    pub(crate) async fn poll(&mut self) -> Result<Option<Assignment>> {
        let desired = self.ask(0).await?;
        let joins_gangs = self.joins_gangs;
        self.ready = desired.prepare.into_iter().filter(|_| joins_gangs).map(|prepare| prepare.task).collect();
        Ok(desired.assignments.into_iter().next())
    }

    /// Sends a poll that is held until there are new orders, or for as long as the server holds one.
    pub(crate) async fn wait(&mut self) -> Result {
        self.version = self.ask(self.version).await?.version;
        Ok(())
    }

    async fn ask(&mut self, version: u64) -> Result<DesiredAssignments> {
        let (incarnation, ready) = (self.incarnation, self.ready.clone());
        let poll = Poll { incarnation, doing: vec![], ready, version, leaving: false };
        self.connection.post(&format!("/v1/workers/{}/poll", self.name), SECRET, &poll).await
    }

    /// An empty manifest of the required kind, uploaded once by each worker.
    pub(crate) async fn output(&mut self, assignment: &Assignment) -> Result<Digest> {
        let kind = match assignment.stage.name.as_str() {
            "dataset" => ArtifactKind::Dataset,
            "vae" => ArtifactKind::Vae,
            _ => ArtifactKind::Latents,
        };
        let manifest = Manifest::new(kind, serde_json::json!({}));
        let place = (assignment.grant.task.clone(), manifest.digest());
        if !self.uploaded.contains_key(&place) {
            let receipt = self.connection.put(assignment, &manifest.to_bytes()).await?;
            self.uploaded.insert(place, receipt);
        }
        Ok(manifest.digest())
    }

    pub(crate) async fn finish(&mut self, assignment: Assignment, output: Digest) -> Result {
        let Assignment { grant, secret, .. } = assignment;
        let receipt = self.uploaded.get(&(grant.task.clone(), output)).map(|receipt| (output, receipt.clone()));
        let outcome = TaskOutcome::Finished { output, metrics: BTreeMap::new() };
        let report = Vouched { what: ReportOutcome::new(grant, outcome), receipts: receipt.into_iter().collect() };
        self.connection.post("/v1/outcomes", &secret, &report).await
    }
}
