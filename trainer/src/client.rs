//! The HTTP client of a coordinator. The coordinator is the one of `--server`, the one that holds the store, or one
//! started for a command that changes something. Commands that only read use a [`Reader`](crate::reader::Reader).

use std::path::Path;

use access::{Server, ServerOptions, UNREACHABLE, describe, explain, local};
use coordinator::shell::{CurveSeries, Curves, RunSettings, StageMetrics};
use coordinator::{Config, Coordinator, Handle, WorkerView};
use protocol::message::{ApiError, Listing, RunSummary, RunView, Submit};
use protocol::{Digest, RunId};
use registry::cli::{Answer, Command};
use registry::{Axis, Holder, LogRow, Page, ReadStore, RunListQuery, RunOrder, Store, Window};
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::report::problem::{Problem, Result, exit};

/// Number of tries to reach a busy server.
const BUSY_TRIES: usize = 20;

/// Destination of a command.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Target {
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    pub(crate) store: std::path::PathBuf,
    #[command(flatten)]
    pub(crate) server: ServerOptions,
}

/// A client of a coordinator.
#[derive(Debug)]
pub(crate) struct Client {
    server: Server,
    /// A coordinator of our own, kept alive if no other one is running.
    own: Option<Handle>,
}

impl Client {
    /// Returns a client if a coordinator of `target` is running: the one that is named, or the one that holds the
    /// store.
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

    /// Connects to the coordinator of `target`. If none is running, starts one that ends with the client.
    pub(crate) async fn connect(target: &Target) -> Result<Self> {
        if let Some(client) = Self::running(target).await? {
            return Ok(client);
        }
        let store = Store::open_existing(&target.store, Holder::this_process("trainer")).await?;
        let handle = Coordinator::start(store, Config::embedded()).await?;
        let client = Self::of(&handle)?;
        Ok(Self { own: Some(handle), ..client })
    }

    /// Connects to a coordinator in this process.
    fn of(handle: &Handle) -> Result<Self> {
        let server = Server::new(&handle.local_url(), Some(handle.token().clone()), None)?;
        Ok(Self { server, own: None })
    }

    /// Shuts down a coordinator of our own and closes its store.
    pub(crate) async fn close(self) {
        if let Some(handle) = self.own {
            handle.shutdown().await;
        }
    }

    async fn try_send(&self, request: RequestBuilder) -> Result<Response> {
        self.server.send(request).await.map_err(|error| {
            let (urls, (why, advice)) = (self.server.urls(), describe(&error));
            let problem = Problem::new(exit::UNREACHABLE, anyhow::anyhow!("cannot reach `{urls}`: {why}"));
            problem.hint(advice.unwrap_or(UNREACHABLE))
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
        problem.code = Some(error.code);
        Err(problem)
    }

    async fn read<T: DeserializeOwned>(&self, request: RequestBuilder) -> Result<T> {
        let answer = self.send(request).await?;
        answer.json().await.map_err(|error| {
            let problem =
                Problem::failed(format!("cannot parse the answer of `{}`: {}", self.server.url(), explain(&error)));
            problem.hint("use the same build for client and server")
        })
    }

    async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T> {
        self.read(self.server.request(Method::GET, path)).await
    }

    async fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> Result<T> {
        self.read(self.server.request(Method::POST, path).json(body)).await
    }

    /// Addresses of the server, separated by commas.
    pub(crate) fn urls(&self) -> String {
        self.server.urls()
    }

    pub(crate) async fn submit(&self, submit: &Submit) -> Result<RunId> {
        Ok(self.post::<coordinator::shell::Submitted>("/v1/runs", submit).await?.run)
    }

    /// A part of the list of runs, in the order of submissions.
    pub(crate) async fn run_list(&self, asked: &RunListQuery) -> Result<Listing<RunSummary>> {
        let sort = if asked.order == RunOrder::Oldest { "oldest" } else { "newest" };
        let mut query = vec![("limit", asked.limit.to_string()), ("sort", sort.to_owned())];
        query.extend(asked.pipeline.as_ref().map(|pipeline| ("pipeline", pipeline.clone())));
        query.extend((!asked.words.is_empty()).then(|| ("q", asked.words.clone())));
        query.extend(asked.after.as_ref().map(|after| ("after", after.clone())));
        self.get(&with_query("/v1/runs", &query)).await
    }

    pub(crate) async fn run(&self, run: &RunId) -> Result<RunView> {
        self.get(&format!("/v1/runs/{run}")).await
    }

    /// The settings of a run's stages, and why each was computed.
    pub(crate) async fn settings(&self, run: &RunId) -> Result<RunSettings> {
        self.get(&format!("/v1/runs/{run}/settings")).await
    }

    /// Sends `pause`, `resume` or `cancel`.
    pub(crate) async fn control(&self, run: &RunId, action: &str) -> Result<RunView> {
        self.post(&format!("/v1/runs/{run}/{action}"), &()).await
    }

    /// At most `limit` lines after line `after`.
    pub(crate) async fn logs(&self, run: &RunId, stage: Option<&str>, after: i64, limit: u32) -> Result<Vec<LogRow>> {
        let stage = stage.map(|stage| format!("&stage={stage}")).unwrap_or_default();
        self.get(&format!("/v1/runs/{run}/logs?after={after}&limit={limit}{stage}")).await
    }

    pub(crate) async fn curves(
        &self,
        run: &RunId,
        stage: Option<&str>,
        keys: &[String],
        window: &Window,
    ) -> Result<Vec<CurveSeries>> {
        let x = match window.axis {
            Axis::Step => "step",
            Axis::Time => "time",
            Axis::Hours => "hours",
        };
        let mut query = vec![("run", run.to_string()), ("x", x.to_owned()), ("buckets", window.buckets.to_string())];
        query.extend(stage.map(|stage| ("stage", stage.to_owned())));
        query.extend(keys.iter().map(|key| ("key", key.clone())));
        query.extend(window.from.map(|from| ("from", from.to_string())));
        query.extend(window.to.map(|to| ("to", to.to_string())));
        Ok(self.get::<Curves>(&with_query("/v1/metrics", &query)).await?.series)
    }

    pub(crate) async fn points(&self, run: &RunId, stage: &str, key: &str, page: Page) -> Result<StageMetrics> {
        let mut query = vec![("stage", stage.to_owned()), ("key", key.to_owned()), ("limit", page.limit.to_string())];
        query.extend(page.after.map(|after| ("after", after.to_string())));
        self.get(&with_query(&format!("/v1/runs/{run}/metrics"), &query)).await
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

/// A path with a percent-encoded query.
fn with_query(path: &str, query: &[(&str, String)]) -> String {
    let escaped = |text: &str| -> String {
        let escape = |byte: u8| match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' | b'.' => char::from(byte).to_string(),
            other => format!("%{other:02X}"),
        };
        text.bytes().map(escape).collect()
    };
    let query: Vec<String> = query.iter().map(|(name, value)| format!("{name}={}", escaped(value))).collect();
    format!("{path}?{}", query.join("&"))
}

/// Publishes the address and token of `handle` for the commands of this user. Dropping the returned value withdraws
/// them; do so before the store is dropped.
pub(crate) fn announce(store: &Store, handle: &Handle) -> Result<local::Published> {
    let announced = local::publish(store.dir(), handle.token())
        .and_then(|published| store.set_address(handle.local_url()).map(|()| published));
    announced.map_err(|error| Problem::usage(format!("cannot write to the store `{}`: {error}", store.dir().display())))
}

/// Formats a store's folder for messages.
pub(crate) fn shown(store: &Path) -> String {
    store.display().to_string()
}
