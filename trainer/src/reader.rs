//! Source of commands that only read: the named server, the coordinator that holds the store, or a store without a
//! coordinator. They start nothing and leave the store unchanged.

use coordinator::shell::CurveSeries;
use coordinator::{Records, WorkerView};
use protocol::message::RunView;
use protocol::{Digest, RunId, StageName, limits};
use registry::cli::{Answer, Command};
use registry::{LogRow, Page, Point, Window};

use crate::client::{Client, Target};
use crate::report::problem::{Problem, Result, exit};

/// Lines of a log per request.
const LINES: u32 = 1000;

/// A source of runs and models.
#[derive(Debug)]
pub(crate) enum Reader {
    /// A running coordinator.
    Server(Box<Client>),
    /// A store that no coordinator holds.
    Store(Box<Records>),
}

impl Reader {
    /// Opens the source for `target`.
    pub(crate) async fn open(target: &Target) -> Result<Self> {
        match Client::running(target).await? {
            Some(client) => Ok(Self::Server(Box::new(client))),
            None => Ok(Self::Store(Box::new(Records::open(&target.store).await?))),
        }
    }

    /// Closes the store, so that a coordinator can open it.
    pub(crate) async fn close(self) {
        if let Self::Store(records) = self {
            records.close().await;
        }
    }

    /// Returns true if a coordinator is running, so that the data may change.
    pub(crate) fn is_live(&self) -> bool {
        matches!(self, Self::Server(_))
    }

    /// All runs by submission.
    pub(crate) async fn runs(&self) -> Result<Vec<RunView>> {
        let mut all = Vec::new();
        loop {
            let before = all.last().map(|run: &RunView| run.run.clone());
            let mut part = self.runs_before(before.as_ref(), limits::RUNS_LISTED).await?;
            if part.is_empty() {
                all.reverse();
                return Ok(all);
            }
            part.reverse();
            all.append(&mut part);
        }
    }

    /// The newest runs by submission, or those before a run.
    async fn runs_before(&self, before: Option<&RunId>, limit: u32) -> Result<Vec<RunView>> {
        let records = match self {
            Self::Server(client) => return client.runs_before(before, limit).await,
            Self::Store(records) => records,
        };
        let read = |view: String| {
            serde_json::from_str(&view).map_err(|error| {
                Problem::failed(format!("cannot parse the stored data of a run: {error}"))
                    .hint("use the build that wrote it")
            })
        };
        records.run_views(before, limit).await?.into_iter().map(read).collect()
    }

    pub(crate) async fn run(&self, run: &RunId) -> Result<RunView> {
        match self {
            Self::Server(client) => client.run(run).await,
            Self::Store(records) => Ok(records.run_view(run).await?),
        }
    }

    pub(crate) async fn logs(&self, run: &RunId, stage: Option<&str>, after: i64) -> Result<Vec<LogRow>> {
        match self {
            Self::Server(client) => client.logs(run, stage, after, LINES).await,
            Self::Store(records) => Ok(records.logs(run, stage.map(StageName::new).as_ref(), after, LINES).await?),
        }
    }

    /// The curves of a run in buckets; of all stages and keys, or of those named.
    pub(crate) async fn curves(
        &self,
        run: &RunId,
        stage: Option<&str>,
        keys: &[String],
        window: &Window,
    ) -> Result<Vec<CurveSeries>> {
        let records = match self {
            Self::Server(client) => return client.curves(run, stage, keys, window).await,
            Self::Store(records) => records,
        };
        let (stage, keys) = (stage.map(StageName::new), (!keys.is_empty()).then_some(keys));
        let stages = records.buckets(run, stage.as_ref(), keys, window).await?;
        Ok(CurveSeries::of(run, stages))
    }

    /// A part of the values of one key of a stage.
    pub(crate) async fn points(&self, run: &RunId, stage: &str, key: &str, page: Page) -> Result<Vec<Point>> {
        let (name, keys) = (StageName::new(stage), [key.to_owned()]);
        let mut stages = match self {
            Self::Server(client) => client.points(run, stage, key, page).await?,
            Self::Store(records) => records.points(run, Some(&name), Some(&keys), page).await?,
        };
        let curve = stages.remove(&name).and_then(|mut curves| curves.remove(key));
        Ok(curve.map(|curve| curve.points).unwrap_or_default())
    }

    pub(crate) async fn workers(&self) -> Result<Vec<WorkerView>> {
        match self {
            Self::Server(client) => client.workers().await,
            Self::Store(records) => Ok(records.workers()),
        }
    }

    /// Sends a read-only command to the registry.
    pub(crate) async fn registry(&self, command: &Command) -> Result<Answer> {
        match self {
            Self::Server(client) => client.registry(command).await,
            Self::Store(records) => Ok(registry::cli::read(command.clone(), records.store()).await),
        }
    }

    pub(crate) async fn blob(&self, digest: Digest) -> Result<Vec<u8>> {
        let records = match self {
            Self::Server(client) => return client.blob(digest).await,
            Self::Store(records) => records,
        };
        let blobs = records.store().blobs().clone();
        let read = tokio::task::spawn_blocking(move || blobs.get(digest)).await;
        let read = read.map_err(|error| Problem::new(exit::FAULT, error))?;
        read.map_err(|error| Problem::failed(error).hint("`trainer registry fsck` checks the store"))
    }

    /// Finds a run by its name, a unique beginning of it, or `@last`.
    pub(crate) async fn find(&self, text: &str) -> Result<RunView> {
        let runs = if text == "@last" { self.runs_before(None, 1).await? } else { self.runs().await? };
        let not_found = |message: String| Problem::new(exit::NOT_FOUND, anyhow::anyhow!("{message}"));
        if text == "@last" {
            return runs.into_iter().next_back().ok_or_else(|| {
                not_found("there are no runs yet".into()).hint("`trainer run configs/quickstart.yaml` starts one")
            });
        }
        if let Some(exact) = runs.iter().find(|run| run.run.as_str() == text) {
            return Ok(exact.clone());
        }
        let begins: Vec<&RunView> = runs.iter().filter(|run| run.run.as_str().starts_with(text)).collect();
        match begins.as_slice() {
            [run] => Ok((*run).clone()),
            [] => Err(not_found(format!("there is no run `{text}`")).hint("`trainer status --all` lists runs")),
            several => {
                let names: Vec<&str> = several.iter().map(|run| run.run.as_str()).collect();
                Err(Problem::usage(format!("`{text}` could be {}", names.join(", "))).hint("write more of the name"))
            }
        }
    }
}
