//! The HTTP client of a coordinator: the one given by `--server`, the one that holds the store, or one started for the
//! length of a command that changes something. What only reads asks a [`Reader`](crate::reader::Reader).

use std::path::Path;

use access::{Server, ServerOptions, explain, local};
use coordinator::{Config, Coordinator, Handle, WorkerView};
use protocol::message::{ApiError, RunView, Submit};
use protocol::{Digest, RunId};
use registry::cli::{Answer, Command};
use registry::{Holder, LogRow, ReadStore, Store};
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::problem::{Problem, Result, exit};

/// How often a server that has too much to do is asked again.
const BUSY_TRIES: usize = 20;

/// Where a command is sent.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Target {
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    pub(crate) store: std::path::PathBuf,
    #[command(flatten)]
    pub(crate) server: ServerOptions,
}

/// A coordinator that can be asked.
#[derive(Debug)]
pub(crate) struct Client {
    server: Server,
    /// Kept alive: a coordinator of our own, if nobody else's was running.
    own: Option<Handle>,
}

impl Client {
    /// The coordinator of `target` if one is running: the one that is named, or the one that holds the store.
    pub(crate) async fn running(target: &Target) -> Result<Option<Self>> {
        if let Some(server) = target.server.connect()? {
            return Ok(Some(Self { server, own: None }));
        }
        match ReadStore::holder_of(&target.store)? {
            Some(Holder { address: Some(address), .. }) => {
                Ok(Some(Self { server: target.server.holder(&target.store, &address)?, own: None }))
            }
            _ => Ok(None),
        }
    }

    /// The coordinator of `target`; if none is running, one is started and goes with this.
    pub(crate) async fn connect(target: &Target) -> Result<Self> {
        if let Some(client) = Self::running(target).await? {
            return Ok(client);
        }
        let store = Store::open_existing(&target.store, Holder::this_process("trainer")).await?;
        let handle = Coordinator::start(store, Config::embedded()).await?;
        let client = Self::of(&handle)?;
        Ok(Self { own: Some(handle), ..client })
    }

    /// A client of a coordinator in this process.
    fn of(handle: &Handle) -> Result<Self> {
        let server = Server::new(&handle.local_url(), Some(handle.token().clone()), None)?;
        Ok(Self { server, own: None })
    }

    /// Ends a coordinator of our own, and lets go of its store.
    pub(crate) async fn close(self) {
        if let Some(handle) = self.own {
            handle.shutdown().await;
        }
    }

    async fn try_send(&self, request: RequestBuilder) -> Result<Response> {
        let url = self.server.url();
        request.send().await.map_err(|error| {
            let problem = Problem::new(exit::UNREACHABLE, anyhow::anyhow!("cannot reach `{url}`: {}", explain(&error)));
            problem.hint("start it with `trainer serve`, or give its address with --server")
        })
    }

    async fn send(&self, request: RequestBuilder) -> Result<Response> {
        let url = self.server.url();
        let mut tries = std::iter::successors(request.try_clone(), RequestBuilder::try_clone).take(BUSY_TRIES);
        let mut answer = self.try_send(request).await?;
        while answer.status() == StatusCode::TOO_MANY_REQUESTS
            && let Some(again) = tries.next()
        {
            tokio::time::sleep(access::retry_after(&answer)).await;
            answer = self.try_send(again).await?;
        }
        if answer.status().is_success() {
            return Ok(answer);
        }
        let status = answer.status();
        let body = answer.bytes().await.unwrap_or_default();
        let error = serde_json::from_slice::<ApiError>(&body).unwrap_or_else(|_| ApiError {
            code: "internal".into(),
            message: format!("`{url}` answered {status}: {}", String::from_utf8_lossy(&body)),
            hint: None,
        });
        let code = match (status.as_u16(), error.code.as_str()) {
            (401 | 403, _) => exit::UNAUTHORISED,
            (_, "not-found") => exit::NOT_FOUND,
            (_, "invalid") => exit::USAGE,
            (_, "conflict" | "stale-fence") => exit::CONFLICT,
            _ => exit::FAILED,
        };
        let mut problem = Problem::new(code, anyhow::anyhow!("{}", error.message));
        problem.hint = error.hint;
        Err(problem)
    }

    async fn read<T: DeserializeOwned>(&self, request: RequestBuilder) -> Result<T> {
        let answer = self.send(request).await?;
        answer.json().await.map_err(|error| {
            let problem =
                Problem::failed(format!("the answer of `{}` does not read: {}", self.server.url(), explain(&error)));
            problem.hint("use one build for client and server")
        })
    }

    async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T> {
        self.read(self.server.request(Method::GET, path)).await
    }

    async fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> Result<T> {
        self.read(self.server.request(Method::POST, path).json(body)).await
    }

    pub(crate) async fn submit(&self, submit: &Submit) -> Result<RunId> {
        Ok(self.post::<coordinator::shell::Submitted>("/v1/runs", submit).await?.run)
    }

    /// The newest runs by submission, or those before a run: at most `limit`, and at most as many as the server gives at a time.
    pub(crate) async fn runs_before(&self, before: Option<&RunId>, limit: u32) -> Result<Vec<RunView>> {
        let before = before.map(|run| format!("&before={run}")).unwrap_or_default();
        self.get(&format!("/v1/runs?limit={limit}{before}")).await
    }

    pub(crate) async fn run(&self, run: &RunId) -> Result<RunView> {
        self.get(&format!("/v1/runs/{run}")).await
    }

    /// `pause`, `resume` or `cancel`.
    pub(crate) async fn control(&self, run: &RunId, action: &str) -> Result<RunView> {
        self.post(&format!("/v1/runs/{run}/{action}"), &()).await
    }

    /// At most `limit` lines after line `after`.
    pub(crate) async fn logs(&self, run: &RunId, stage: Option<&str>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        let stage = stage.map(|stage| format!("&stage={stage}")).unwrap_or_default();
        self.get(&format!("/v1/runs/{run}/logs?after={after}&limit={limit}{stage}")).await
    }

    pub(crate) async fn workers(&self) -> Result<Vec<WorkerView>> {
        self.get("/v1/workers").await
    }

    pub(crate) async fn registry(&self, command: &Command) -> Result<Answer> {
        self.post("/v1/registry", command).await
    }

    pub(crate) async fn blob(&self, digest: Digest) -> Result<Vec<u8>> {
        let answer = self.send(self.server.request(Method::GET, &format!("/v1/blobs/{digest}"))).await?;
        let bytes = answer.bytes().await.map_err(|error| Problem::failed(explain(&error)))?;
        Ok(bytes.into())
    }
}

/// Tells the commands of this user where `handle` answers and how to be let in. What is given back takes that away again, and
/// is to be dropped before the store is.
pub(crate) fn announce(store: &Store, handle: &Handle) -> Result<local::Published> {
    let announced = local::publish(store.dir(), handle.token())
        .and_then(|published| store.set_address(handle.local_url()).map(|()| published));
    announced.map_err(|error| Problem::usage(format!("cannot write to the store `{}`: {error}", store.dir().display())))
}

/// A store's folder as messages show it.
pub(crate) fn shown(store: &Path) -> String {
    store.display().to_string()
}
