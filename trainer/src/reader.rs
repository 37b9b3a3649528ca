//! Source of commands that only read: the named server, the coordinator that holds the store, or a store without a
//! coordinator. They start nothing and leave the store unchanged.

use coordinator::shell::{CurveSeries, RunSettings};
use coordinator::{Records, WorkerView};
use protocol::message::{Listing, RunSummary, RunView};
use protocol::{Digest, RunId, StageName, limits};
use registry::cli::{Answer, Command};
use registry::{LogRow, Page, Point, RunListQuery, RunOrder, Window};

use crate::client::{Client, Target};
use crate::report::problem::{Problem, Result, exit};

/// Lines of a log per request.
const LINES: u32 = 1000;
/// Largest number of runs that an error names.
const NAMED: usize = 10;

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

    /// All runs by submission, the oldest first.
    pub(crate) async fn runs(&self) -> Result<Vec<RunSummary>> {
        let mut asked = RunListQuery { limit: limits::RUNS_LISTED, order: RunOrder::Oldest, ..RunListQuery::default() };
        let mut all = Vec::new();
        loop {
            let mut part = self.run_list(&asked).await?;
            all.append(&mut part.items);
            asked.after = part.next;
            if asked.after.is_none() {
                return Ok(all);
            }
        }
    }

    /// The newest run, or the newest of a pipeline.
    pub(crate) async fn newest(&self, pipeline: Option<&str>) -> Result<Option<RunView>> {
        let asked = RunListQuery { pipeline: pipeline.map(str::to_owned), limit: 1, ..RunListQuery::default() };
        match self.run_list(&asked).await?.items.first() {
            Some(newest) => Ok(Some(self.run(&newest.run).await?)),
            None => Ok(None),
        }
    }

    /// A part of the list of runs.
    pub(crate) async fn run_list(&self, asked: &RunListQuery) -> Result<Listing<RunSummary>> {
        match self {
            Self::Server(client) => client.run_list(asked).await,
            Self::Store(records) => Ok(records.run_list(asked).await?),
        }
    }

    pub(crate) async fn run(&self, run: &RunId) -> Result<RunView> {
        match self {
            Self::Server(client) => client.run(run).await,
            Self::Store(records) => Ok(records.run_view(run).await?),
        }
    }

    /// The settings of a run's stages, and why each was computed.
    pub(crate) async fn settings(&self, run: &RunId) -> Result<RunSettings> {
        match self {
            Self::Server(client) => client.settings(run).await,
            Self::Store(records) => Ok(records.settings(run).await?),
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
        let not_found = |message: String| Problem::new(exit::NOT_FOUND, anyhow::anyhow!("{message}"));
        if text == "@last" {
            let hint = "`trainer run configs/quickstart.yaml` starts one";
            return self.newest(None).await?.ok_or_else(|| not_found("there are no runs yet".into()).hint(hint));
        }
        // A path of a call has no further part.
        if !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte)) {
            match self.run(&RunId::from(text)).await {
                Err(problem) if problem.exit == exit::NOT_FOUND => {}
                found => return found,
            }
        }
        let mut begins: Vec<RunId> = Vec::new();
        let mut asked = RunListQuery { words: text.to_owned(), limit: limits::RUNS_LISTED, ..RunListQuery::default() };
        loop {
            let part = self.run_list(&asked).await?;
            begins.extend(part.items.into_iter().map(|row| row.run).filter(|run| run.as_str().starts_with(text)));
            asked.after = part.next;
            if asked.after.is_none() || begins.len() >= NAMED {
                break;
            }
        }
        match begins.as_slice() {
            [run] => self.run(run).await,
            [] => Err(not_found(format!("there is no run `{text}`")).hint("`trainer status --all` lists runs")),
            several => {
                let more = if several.len() > NAMED { " or another one" } else { "" };
                let names: Vec<&str> = several.iter().take(NAMED).map(RunId::as_str).collect();
                let message = format!("`{text}` could be {}{more}", names.join(", "));
                Err(Problem::usage(message).hint("write more of the name"))
            }
        }
    }
}
