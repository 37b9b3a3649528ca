//! Commands that only read ask the best source: the server that is named, the coordinator that holds the store, or, where nobody
//! holds it, the store itself. They start nothing and leave the store as it is.

use coordinator::{Records, WorkerView};
use protocol::message::RunView;
use protocol::{Digest, RunId, StageName, limits};
use registry::LogRow;
use registry::cli::{Answer, Command};

use crate::client::{Client, Target};
use crate::problem::{Problem, Result, exit};

/// Lines of a log that are asked for at once.
const LINES: u32 = 1000;

/// What can be asked about runs and models.
#[derive(Debug)]
pub(crate) enum Reader {
    /// A coordinator that runs.
    Server(Box<Client>),
    /// A store that nobody holds.
    Store(Box<Records>),
}

impl Reader {
    /// Finds what answers for `target`.
    pub(crate) async fn open(target: &Target) -> Result<Self> {
        match Client::running(target).await? {
            Some(client) => Ok(Self::Server(Box::new(client))),
            None => Ok(Self::Store(Box::new(Records::open(&target.store).await?))),
        }
    }

    /// Lets go of the store, for somebody who wants to hold it.
    pub(crate) async fn close(self) {
        if let Self::Store(records) = self {
            records.close().await;
        }
    }

    /// Whether what is read may change: a coordinator is at work.
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
                Problem::failed(format!("what is kept of a run does not read: {error}"))
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

    pub(crate) async fn workers(&self) -> Result<Vec<WorkerView>> {
        match self {
            Self::Server(client) => client.workers().await,
            Self::Store(records) => Ok(records.workers()),
        }
    }

    /// Asks the registry something that changes nothing.
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

    /// The run that `text` means: its name, a unique beginning of it, or `@last`.
    pub(crate) async fn find(&self, text: &str) -> Result<RunView> {
        let runs = if text == "@last" { self.runs_before(None, 1).await? } else { self.runs().await? };
        let not_found = |message: String| Problem::new(exit::NOT_FOUND, anyhow::anyhow!("{message}"));
        if text == "@last" {
            return runs.into_iter().next_back().ok_or_else(|| {
                not_found("there are no runs yet".into()).hint("`trainer run configs/quickstart.yaml` makes one")
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
                Err(Problem::usage(format!("`{text}` could be {}", names.join(", "))).hint("give more of the name"))
            }
        }
    }
}
