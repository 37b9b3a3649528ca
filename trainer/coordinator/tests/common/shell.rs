//! A coordinator with its shell, for tests over HTTP.

use std::path::Path;

use access::Server;
use coordinator::{Config, Coordinator, Handle};
use protocol::message::{Join, PROTOCOL_VERSION, Submit};
use protocol::stage::Backend;
use registry::{Holder, Store};

pub(crate) type TestResult<T = ()> = Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// The secret of worker `a`.
pub(crate) const SECRET: &str = "the-secret-of-worker-a-of-the-tests";

const TEXT: &str = "name: p\nseed: 1\ndataset: {format: synthetic}\nstages: {vae: {kind: train.vae}}\n";

/// Starts a server whose polls wait for `poll_ms`, and a client of it.
pub(crate) async fn start(dir: &Path, poll_ms: u64) -> TestResult<(Handle, Server)> {
    let store = Store::open(dir, Holder::this_process("a test")).await?;
    let mut config = Config { alone: false, park: false, ..Config::embedded() };
    config.policy.poll_ms = poll_ms;
    let handle = Coordinator::start(store, config).await?;
    let server = Server::new(&handle.url(), Some(handle.token().clone()), None)?;
    Ok((handle, server))
}

pub(crate) fn submission() -> TestResult<Submit> {
    let pipeline = pipeline::read("p.yaml", TEXT, &[]).map_err(|mistakes| mistakes.to_string())?;
    Ok(Submit { pipeline: serde_json::to_value(pipeline)?, source: TEXT.into(), idempotency_key: None, until: None })
}

/// The join message of worker `a`.
pub(crate) fn offer() -> Join {
    Join {
        protocol: PROTOCOL_VERSION,
        worker: "a".into(),
        pid: 1,
        backend: Backend::Flex,
        instruction_set: "avx2".into(),
        code_versions: protocol::stage::StageSettings::code_versions(),
        peer_address: "a:1".into(),
        labels: Default::default(),
    }
}
