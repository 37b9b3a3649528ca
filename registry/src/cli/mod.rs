//! The registry's commands. The `registry` binary, `trainer registry` and the server's `POST /v1/registry` all call
//! [`run`].
//!
//! [`Command`] and [`Answer`] are plain data, so that a client can send a command and print its answer. A command never
//! contains a path of the machine that runs it: for `export` the client downloads and writes the files itself.
//! [`EXIT_CODES`] lists the exit codes of the process.

mod args;
mod bundles;
mod client;
mod command;
mod export;
mod print;

use std::collections::BTreeMap;

use checkpoint::model::{self, Model as ModelMeta, Parts};
use protocol::artifact::Role;
use protocol::message::ApiError;
use protocol::stage::{DataOpen, StageSpec};
use protocol::units::counted;
use protocol::{Alias, Digest, Manifest, ModelName, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use args::{Output, OutputArg, Verb};
pub use bundles::import;
pub use client::{ask, execute};
pub use command::Command;
pub use print::{render, show_error};

use crate::audit::{self, AuditEntry};
use crate::backup::{BackupError, Summary};
use crate::forget::Forgotten;
use crate::leaderboard::{self, Comparison, Leaderboard, Style};
use crate::retention::{GRACE_MS, Plan};
use crate::versions::{BEST, Expect, Gate, LATEST, Model, ModelRef, Promotion, Version};
use crate::{LineageNode, OpenError, QueryError, ReadStore, Store, StoreId, WriteError, fsck};

/// The table of exit codes for `--help`. They have the same meaning in `trainer`.
pub const EXIT_CODES: &str = "\
Exit codes:
    0  done
    1  the requested operation failed
    2  wrong usage, or a store that cannot be used; nothing was changed
    4  a conflict with what is stored
    5  the token is missing or lacks a scope
    6  the process that holds the store does not answer
    7  there is no such model, version, run or artifact
    9  stored data is damaged
   10  a gate does not hold; nothing was changed";

/// Result of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[expect(missing_docs, reason = "each field is the type it holds")]
pub enum Data {
    /// Result of `list`.
    Models { models: Vec<Model> },
    /// Result of `show MODEL`.
    Model { model: Model, versions: Vec<Version> },
    /// Result of `show MODEL@ALIAS`.
    Version {
        version: Version,
        manifest: Manifest,
        /// For each part of a model, the parts it was made for.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        fits: BTreeMap<Role, Parts>,
        /// Versions that a control part was made for, as `MODEL:VERSION`, among the newest [`MOST_BASES`].
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        bases: Vec<String>,
    },
    /// Result of `history`.
    History { model: ModelName, history: Vec<Promotion> },
    /// Result of `promote` and `rollback`.
    Promotion { promotion: Promotion },
    /// Result of `compare`.
    Comparison { comparison: Comparison, style: Style },
    /// Result of `leaderboard`.
    Leaderboard { leaderboard: Leaderboard, style: Style },
    /// Result of `lineage`.
    Lineage { nodes: Vec<LineageNode> },
    /// Result of `fsck`.
    Fsck { report: fsck::Report },
    /// Result of `gc`.
    Gc { dry_run: bool, plan: Plan },
    /// Result of `adopt`.
    Adopted { store: StoreId },
    /// Result of `audit`.
    Audit { entries: Vec<AuditEntry> },
    /// Result of `forget`.
    Forgotten { runs: Vec<(RunId, Forgotten)> },
    /// Result of `backup`.
    BackedUp { summary: Summary, dir: std::path::PathBuf },
    /// Result of `restore`.
    Restored { summary: Summary, dir: std::path::PathBuf },
    /// Result of `migrate`.
    Migrated {
        from: String,
        to: String,
        /// Number of copied rows.
        rows: u64,
    },
    /// Result of `export`.
    Exported {
        version: Version,
        dir: std::path::PathBuf,
        files: Vec<String>,
        /// Parts that the layout cannot hold.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        left_out: Vec<String>,
    },
    /// Result of `import`.
    Imported { version: Version, file: String },
}

/// Answer to a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Answer {
    /// The process's exit code.
    pub exit: u8,
    /// Result of the command, if there is one.
    pub data: Option<Data>,
    /// Reason of a refusal, or a problem that was found.
    pub error: Option<ApiError>,
}

impl Answer {
    fn done(data: Data) -> Self {
        Self { exit: 0, data: Some(data), error: None }
    }

    /// Makes an answer of an error, with the exit code of the error's code.
    pub fn refused(error: ApiError) -> Self {
        let exit = match error.code.as_str() {
            "invalid" | "store" => 2,
            "not-found" => 7,
            "conflict" | "stale-fence" => 4,
            "unauthorized" | "forbidden" => 5,
            "unreachable" => 6,
            "damaged" => 9,
            "gate" => 10,
            _ => 1,
        };
        Self { exit, data: None, error: Some(error) }
    }
}

fn error(code: &str, message: impl ToString, hint: Option<&str>) -> ApiError {
    ApiError { code: code.into(), message: message.to_string(), hint: hint.map(str::to_owned) }
}

impl From<QueryError> for Answer {
    fn from(e: QueryError) -> Self {
        Self::refused(match &e {
            QueryError::NotFound(_) => error("not-found", e, Some("`registry list` shows the models")),
            QueryError::Invalid(_) => {
                error("invalid", e, Some("`registry list` shows models, `registry show MODEL` their versions"))
            }
            QueryError::Storage(_) => error("storage", e, None),
            QueryError::Database(_) | QueryError::Blob(_) => {
                error("internal", e, Some("`registry fsck` checks the store"))
            }
        })
    }
}

impl From<WriteError> for Answer {
    fn from(e: WriteError) -> Self {
        Self::refused(match &e {
            WriteError::StaleFence { .. } => error("stale-fence", e, None),
            WriteError::Conflict(_) => {
                error("conflict", e, Some("`registry history MODEL` shows the moves of aliases"))
            }
            WriteError::Gate(_) => error(
                "gate",
                e,
                Some("nothing was changed; `registry show MODEL` lists every version with its metrics"),
            ),
            WriteError::NotFound(_) => error("not-found", e, Some("`registry list` shows the models")),
            WriteError::Storage(_) | WriteError::Superseded { .. } => error("storage", e, None),
            WriteError::Unreachable(_) => error("unreachable", e, None),
            WriteError::Unproven { .. } | WriteError::Internal(_) => {
                error("internal", e, Some("`registry fsck` checks the store"))
            }
        })
    }
}

impl From<&OpenError> for Answer {
    fn from(e: &OpenError) -> Self {
        Self::refused(error("store", e, Some(&e.hint())))
    }
}

impl From<BackupError> for Answer {
    fn from(e: BackupError) -> Self {
        match e {
            BackupError::Folder(_) => Self::refused(error("invalid", e, Some("name another folder"))),
            BackupError::Damaged(_) => Self::refused(error("damaged", e, Some("`registry fsck` checks a store"))),
            BackupError::Disk { .. } => {
                Self::refused(error("storage", e, Some("check the disk and run the same command again")))
            }
            BackupError::Query(e) => Self::from(e),
        }
    }
}

fn invalid(message: impl ToString) -> Refused {
    Refused::from(error("invalid", message, Some("`registry help` shows the syntax")))
}

/// An answer with an error, for use with `?`.
struct Refused(Box<Answer>);

impl<E: Into<Answer>> From<E> for Refused {
    fn from(e: E) -> Self {
        Self(Box::new(e.into()))
    }
}

impl From<ApiError> for Answer {
    fn from(error: ApiError) -> Self {
        Self::refused(error)
    }
}

/// Runs a command on a store that this process holds, on behalf of `actor`.
pub async fn run(command: Command, store: &Store, actor: &str) -> Answer {
    answer(command, store, Some((store, actor))).await.unwrap_or_else(|refused| *refused.0)
}

/// Runs a read-only command.
pub async fn read(command: Command, store: &ReadStore) -> Answer {
    answer(command, store, None).await.unwrap_or_else(|refused| *refused.0)
}

/// Runs a command. `holder` is given if this process holds `store`, with the actor of changes.
async fn answer(command: Command, store: &ReadStore, holder: Option<(&Store, &str)>) -> Result<Answer, Refused> {
    let writes = || holder.ok_or_else(|| invalid("the command changes the store, which was opened for reading"));
    let data = match command {
        Command::List => Data::Models { models: store.models().await? },
        Command::Show { reference } => show(store, &reference).await?,
        Command::History { model, alias } => {
            let model = known(store, &model).await?.0.model;
            let alias = alias.map(|alias| alias.parse::<Alias>()).transpose().map_err(invalid)?;
            let history = store.history(&model, alias.as_ref()).await?;
            Data::History { model, history }
        }
        Command::Promote { reference, to, expect, require, reason } => {
            let (store, actor) = writes()?;
            let order = Move { reference: &reference, to: &to, expect, require, reason: &reason };
            Data::Promotion { promotion: promote(store, actor, order).await? }
        }
        Command::Rollback { model, alias, to, expect, reason } => {
            let (model, alias): (ModelName, Alias) = (model.parse().map_err(invalid)?, alias.parse().map_err(invalid)?);
            let (store, actor) = writes()?;
            let promotion = store.rollback(&model, &alias, to, expect, &reason, actor).await?;
            Data::Promotion { promotion }
        }
        Command::Compare { left, right, style } => {
            let comparison = leaderboard::compare(&one(store, &left).await?, &one(store, &right).await?);
            Data::Comparison { comparison, style }
        }
        Command::Leaderboard { of, published, style } => {
            Data::Leaderboard { leaderboard: leaderboard(store, &of, published).await?, style }
        }
        Command::Lineage { reference } => lineage(store, &reference).await?,
        Command::Audit { limit } => audit(store, limit).await?,
        Command::Fsck => verified(store.fsck().await?)?,
        Command::Gc { dry_run, grace_minutes } => {
            let grace_ms = grace_minutes.map_or(GRACE_MS, |minutes| i64::from(minutes) * 60_000);
            let plan = if dry_run { store.gc_plan(grace_ms).await? } else { writes()?.0.gc(grace_ms).await? };
            Data::Gc { dry_run, plan }
        }
        Command::Forget { run, ended_before, leftovers_before } => {
            let store = writes()?.0;
            let runs = match (run, ended_before, leftovers_before) {
                (Some(run), None, None) => {
                    let run = RunId::new(run);
                    let gone = store.forget(&run).await?;
                    vec![(run, gone)]
                }
                (None, Some(before_ms), None) => forget_ended(store, before_ms).await?,
                (None, None, Some(before_ms)) => forget_leftovers(store, before_ms).await?,
                _ => return Err(invalid("`forget` needs one run, `ended_before` or `leftovers_before`")),
            };
            Data::Forgotten { runs }
        }
    };
    Ok(Answer::done(data))
}

/// A promotion as written.
struct Move<'a> {
    reference: &'a str,
    to: &'a str,
    expect: Option<Expect>,
    require: Vec<String>,
    reason: &'a str,
}

async fn promote(store: &Store, actor: &str, order: Move<'_>) -> Result<Promotion, Refused> {
    let reference: ModelRef = order.reference.parse().map_err(invalid)?;
    let alias: Alias = order.to.parse().map_err(invalid)?;
    for gate in &order.require {
        gate.parse::<Gate>().map_err(invalid)?;
    }
    let Some(pick) = reference.pick else {
        let model = reference.model;
        return Err(invalid(format!("`{model}` has several versions; write `{model}@best` or `{model}:VERSION`")));
    };
    let Move { expect, require, reason, .. } = order;
    Ok(store.promote(&reference.model, pick, &alias, expect, require, reason, actor).await?)
}

async fn lineage(store: &ReadStore, reference: &str) -> Result<Data, Refused> {
    let digest = match reference.parse::<Digest>() {
        Ok(digest) => digest,
        Err(_) => store.resolve(reference).await?.artifact,
    };
    let nodes = store.lineage(digest).await?;
    if nodes.iter().all(|node| node.kind.is_none() && node.inputs.is_empty()) && !exists(store, digest).await? {
        return Err(Refused::from(QueryError::NotFound(format!("no artifact {digest}"))));
    }
    Ok(Data::Lineage { nodes })
}

async fn audit(store: &ReadStore, limit: usize) -> Result<Data, Refused> {
    let dir = store.dir().to_owned();
    let read = tokio::task::spawn_blocking(move || audit::read(&dir, limit.min(MOST_LINES))).await;
    let failed = |e: &dyn std::fmt::Display| QueryError::Storage(format!("cannot read the audit log: {e}"));
    Ok(Data::Audit { entries: read.map_err(|e| failed(&e))?.map_err(|e| failed(&e))? })
}

/// Returns the report, or an error with the report if it has problems.
fn verified(report: fsck::Report) -> Result<Data, Refused> {
    let Some(first) = report.problems.first() else { return Ok(Data::Fsck { report }) };
    let message = format!("{} found; the first: {first}", counted(report.problems.len(), "problem"));
    let hint = "restore the store from a backup, or remove the damaged blobs under `blobs/` and run the pipelines \
                that made them again";
    let mut answer = Answer::refused(error("damaged", message, Some(hint)));
    answer.data = Some(Data::Fsck { report });
    Err(answer.into())
}

/// Deletes runs in one transaction each, so that other writes can proceed in between.
async fn forget_ended(store: &Store, before_ms: i64) -> Result<Vec<(RunId, Forgotten)>, Refused> {
    let mut runs = Vec::new();
    for run in store.ended_before(before_ms).await? {
        let gone = store.forget(&run).await?;
        runs.push((run, gone));
    }
    Ok(runs)
}

async fn forget_leftovers(store: &Store, before_ms: i64) -> Result<Vec<(RunId, Forgotten)>, Refused> {
    let mut runs = Vec::new();
    for run in store.ended_before(before_ms).await? {
        let gone = store.forget_leftovers(&run, before_ms).await?;
        if gone != Forgotten::default() {
            runs.push((run, gone));
        }
    }
    Ok(runs)
}

/// Returns the version that a reference names. A model alone means its best version, or its newest if no metric ranks
/// them.
async fn one(store: &ReadStore, text: &str) -> Result<Version, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_some() {
        return Ok(store.resolve(text).await?);
    }
    let pick = if known(store, text).await?.0.best.is_some() { BEST } else { LATEST };
    Ok(store.resolve(&format!("{text}@{pick}")).await?)
}

/// Returns the data format of a version's motions; the papers' datasets have the same names.
async fn format_of(store: &ReadStore, version: &Version) -> Option<String> {
    let manifest = manifest(store, version.artifact).await.ok()?;
    ModelMeta::read(&manifest).ok().map(|model| model.format.name().to_owned())
}

/// Kind of the artifacts with clips.
const DATASET: &str = "dataset";

/// Returns true if the version learned from clips that no published table was measured on: procedural ones or recordings.
async fn is_of_other_data(store: &ReadStore, version: &Version) -> Result<bool, Refused> {
    let nodes = store.lineage(version.artifact).await?;
    let datasets = nodes.iter().filter(|node| node.kind.as_deref() == Some(DATASET));
    for key in datasets.filter_map(|node| node.key.as_ref()?.parse::<Digest>().ok()) {
        let made_by = store.stage_result(key).await?;
        if made_by.is_some_and(|made_by| made_by.kind != DataOpen::KIND) {
            return Ok(true);
        }
    }
    Ok(false)
}

async fn leaderboard(store: &ReadStore, of: &str, published: bool) -> Result<Leaderboard, Refused> {
    if leaderboard::FORMATS.contains(&of) {
        let mut all = Vec::new();
        for model in store.models().await? {
            for version in store.versions(&model.model).await? {
                if format_of(store, &version).await.as_deref() == Some(of) && !is_of_other_data(store, &version).await?
                {
                    all.push(version);
                }
            }
        }
        return Ok(leaderboard::leaderboard(of.to_owned(), &all, None, published.then_some(of)));
    }
    let (model, versions) = known(store, of).await?;
    let format = match versions.first().filter(|_| published) {
        Some(version) if !is_of_other_data(store, version).await? => format_of(store, version).await,
        _ => None,
    };
    Ok(leaderboard::leaderboard(of.to_owned(), &versions, model.metric.as_deref(), format.as_deref()))
}

/// Returns a model and its versions, oldest first.
async fn known(store: &ReadStore, name: &str) -> Result<(Model, Vec<Version>), Refused> {
    let name: ModelName = name.parse().map_err(invalid)?;
    match store.model(&name).await? {
        Some(found) => Ok(found),
        // The error of `resolve` lists the known models.
        None => Err(store
            .resolve(&format!("{name}@latest"))
            .await
            .map_or_else(Refused::from, |_| invalid("the model was created meanwhile; run the command again"))),
    }
}

async fn exists(store: &ReadStore, digest: Digest) -> Result<bool, Refused> {
    let blobs = store.blobs().clone();
    store.ask_blobs(move || blobs.exists(digest)).await.map_err(|e| Refused::from(QueryError::Blob(e.to_string())))
}

async fn manifest(store: &ReadStore, digest: Digest) -> Result<Manifest, QueryError> {
    let blobs = store.blobs().clone();
    store.ask_blobs(move || blobs.manifest(digest)).await.map_err(|e| QueryError::Blob(e.to_string()))
}

/// Number of versions searched for bases of a control part.
pub const MOST_BASES: usize = 1_000;
/// Limit of shown lines of the audit log.
const MOST_LINES: usize = 10_000;

async fn show(store: &ReadStore, text: &str) -> Result<Data, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_none() {
        let (model, versions) = known(store, reference.model.as_str()).await?;
        return Ok(Data::Model { model, versions });
    }
    let version = store.resolve(text).await?;
    let manifest = manifest(store, version.artifact).await?;
    let fits = fits(store, &manifest).await?;
    let bases = match fits.get(&Role::CONTROL) {
        Some(wanted) => bases(store, &version, wanted).await?,
        None => Vec::new(),
    };
    Ok(Data::Version { version, manifest, fits, bases })
}

/// Finds other versions that contain all `wanted` parts: the models that a control part fits.
async fn bases(store: &ReadStore, own: &Version, wanted: &Parts) -> Result<Vec<String>, Refused> {
    let mut all = Vec::new();
    for model in store.models().await? {
        all.extend(store.versions(&model.model).await?);
    }
    all.sort_by_key(|version| std::cmp::Reverse(version.created_ms));
    let mut bases = Vec::new();
    for version in all.iter().take(MOST_BASES).filter(|version| version.artifact != own.artifact) {
        // Skips artifacts that are damaged or not models; `fsck` reports them.
        let Ok(manifest) = manifest(store, version.artifact).await else { continue };
        let Ok(model) = ModelMeta::read(&manifest) else { continue };
        if wanted.iter().all(|(role, digest)| model.parts.get(role) == Some(digest)) {
            bases.push(format!("{}:{}", version.model, version.version));
        }
    }
    Ok(bases)
}

/// Returns for each part of a model the parts it was made for. Empty for other artifacts.
async fn fits(store: &ReadStore, of: &Manifest) -> Result<BTreeMap<Role, Parts>, Refused> {
    let Ok(model) = ModelMeta::read(of) else { return Ok(BTreeMap::new()) };
    let mut all = BTreeMap::new();
    for (role, digest) in model.parts {
        let part = manifest(store, digest).await?;
        let fits = model::fits(&role, &part).map_err(|e| QueryError::Blob(e.to_string()))?;
        if !fits.is_empty() {
            all.insert(role, fits);
        }
    }
    Ok(all)
}
