//! The registry's commands, once: the `registry` binary, `trainer registry` and the server's `POST /v1/registry` all call
//! [`run`].
//!
//! [`Command`] is what may be asked and [`Answer`] what comes back, both plain data, so that a client can send the one and
//! show the other. A command never names a place on the machine that runs it: what `export` writes, the client fetches and
//! writes itself. [`EXIT_CODES`] lists what the process exits with.

mod args;
mod bundles;
mod client;
mod export;
mod print;

use std::collections::BTreeMap;

use access::Scope;
use checkpoint::model::{self, Model as ModelMeta, Parts};
use protocol::artifact::Role;
use protocol::message::ApiError;
use protocol::{Alias, Digest, Manifest, ModelName, RunId};
use serde::{Deserialize, Serialize};

pub use args::{Output, OutputArg, Verb};
pub use bundles::import;
pub use client::{ask, execute};
pub use print::{render, show_error};

use crate::audit::{self, AuditEntry};
use crate::backup::{BackupError, Summary};
use crate::forget::Forgotten;
use crate::leaderboard::{self, Comparison, Leaderboard, Style};
use crate::retention::{GRACE_MS, Plan};
use crate::versions::{BEST, Expect, Gate, LATEST, Model, ModelRef, Promotion, Version};
use crate::{LineageNode, OpenError, QueryError, ReadStore, Store, StoreId, WriteError, fsck};

/// The table of exit codes for `--help`. They mean the same in `trainer`.
pub const EXIT_CODES: &str = "\
Exit codes:
    0  done
    1  what was asked for failed
    2  wrong usage, or a store that cannot be used; nothing was changed
    4  a conflict with what is stored
    5  the token is missing or not enough
    6  the process that holds the store does not answer
    7  there is no such model, version, run or artifact
    9  stored data is damaged
   10  a gate does not hold; nothing was changed";

/// What may be asked of a registry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "kebab-case")]
pub enum Command {
    /// All models.
    List,
    /// A model with its versions, or one version.
    Show {
        /// `MODEL`, `MODEL@ALIAS`, `MODEL:VERSION`.
        reference: String,
    },
    /// The moves of a model's aliases.
    History {
        model: String,
        /// Only of this alias.
        alias: Option<String>,
    },
    /// Moves an alias to a version.
    Promote {
        /// `MODEL@ALIAS`, `MODEL@best`, `MODEL:VERSION`.
        reference: String,
        /// The alias.
        to: String,
        /// What the alias must point at now.
        expect: Option<Expect>,
        /// Gates as written.
        require: Vec<String>,
        /// Why.
        reason: String,
    },
    /// Moves an alias back.
    Rollback {
        model: String,
        alias: String,
        /// To this version; otherwise to the one before the last promotion.
        to: Option<u64>,
        /// What the alias must point at now.
        expect: Option<Expect>,
        /// Why.
        reason: String,
    },
    /// Two versions, metric by metric.
    Compare {
        /// `MODEL`, `MODEL@ALIAS`, `MODEL:VERSION`; a model alone is its best version.
        left: String,
        /// Likewise.
        right: String,
        /// How the table is written.
        style: Style,
    },
    /// All versions of a model, or of all models of a data format, beside what the papers print.
    Leaderboard {
        /// A model, or `humanml3d` or `kit`.
        of: String,
        /// Whether the papers' rows are shown.
        published: bool,
        /// How the table is written.
        style: Style,
    },
    /// What an artifact was made of.
    Lineage {
        /// A model version or a digest.
        reference: String,
    },
    /// Checks everything.
    Fsck,
    /// Removes what nothing needs.
    Gc {
        /// Only says what would go.
        dry_run: bool,
        /// Minutes for which a fresh blob is safe.
        grace_minutes: Option<u32>,
    },
    /// Forgets a run that has ended.
    Forget {
        /// Which.
        run: String,
    },
    /// Forgets runs that ended before a time.
    ForgetEnded {
        /// In milliseconds since 1970.
        before_ms: i64,
    },
    /// Forgets what runs that ended before a time have left behind and nobody needs; the runs stay.
    ForgetLeftovers {
        /// In milliseconds since 1970.
        before_ms: i64,
    },
    /// The newest lines of the audit log.
    Audit {
        /// How many.
        limit: usize,
    },
}

impl Command {
    /// What a token must allow for it.
    pub fn scope(&self) -> Scope {
        match self {
            Self::List
            | Self::Show { .. }
            | Self::History { .. }
            | Self::Compare { .. }
            | Self::Leaderboard { .. }
            | Self::Lineage { .. } => Scope::Read,
            Self::Promote { .. } | Self::Rollback { .. } => Scope::Promote,
            // Reads every byte of the store.
            Self::Audit { .. }
            | Self::Fsck
            | Self::Gc { .. }
            | Self::Forget { .. }
            | Self::ForgetEnded { .. }
            | Self::ForgetLeftovers { .. } => Scope::Admin,
        }
    }

    /// The model and the alias that it moves.
    pub fn moves(&self) -> Option<(&str, &str)> {
        match self {
            Self::Promote { reference, to, .. } => Some((reference, to)),
            Self::Rollback { model, alias, .. } => Some((model, alias)),
            _ => None,
        }
    }

    /// The command and what it names, for a log.
    pub fn in_short(&self) -> String {
        match self {
            Self::List => "list".into(),
            Self::Show { reference } => format!("show {reference}"),
            Self::History { model, .. } => format!("history {model}"),
            Self::Promote { reference, to, .. } => format!("promote {reference} to {to}"),
            Self::Rollback { model, alias, .. } => format!("rollback {model}@{alias}"),
            Self::Compare { left, right, .. } => format!("compare {left} {right}"),
            Self::Leaderboard { of, .. } => format!("leaderboard {of}"),
            Self::Lineage { reference } => format!("lineage {reference}"),
            Self::Fsck => "fsck".into(),
            Self::Gc { dry_run, .. } => if *dry_run { "gc --dry-run" } else { "gc" }.into(),
            Self::Forget { run } => format!("forget {run}"),
            Self::ForgetEnded { before_ms } => format!("forget --ended-before {before_ms}"),
            Self::ForgetLeftovers { before_ms } => format!("forget --leftovers-before {before_ms}"),
            Self::Audit { limit } => format!("audit {limit}"),
        }
    }

    /// Whether it changes nothing in the store, so that it needs nobody who holds it.
    pub fn only_reads(&self) -> bool {
        match self {
            Self::List
            | Self::Show { .. }
            | Self::History { .. }
            | Self::Compare { .. }
            | Self::Leaderboard { .. }
            | Self::Lineage { .. }
            | Self::Audit { .. }
            | Self::Fsck => true,
            Self::Gc { dry_run, .. } => *dry_run,
            Self::Promote { .. }
            | Self::Rollback { .. }
            | Self::Forget { .. }
            | Self::ForgetEnded { .. }
            | Self::ForgetLeftovers { .. } => false,
        }
    }
}

/// What a command gives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[expect(missing_docs, reason = "each field is the type it holds")]
pub enum Data {
    /// Of `list`.
    Models { models: Vec<Model> },
    /// Of `show MODEL`.
    Model { model: Model, versions: Vec<Version> },
    /// Of `show MODEL@ALIAS`.
    Version {
        version: Version,
        manifest: Manifest,
        /// For each part of a model those that it was made for.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        fits: BTreeMap<Role, Parts>,
        /// Versions of any model that a control part was made beside, as `MODEL:VERSION`; the newest [`MOST_BASES`] are looked at.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        bases: Vec<String>,
    },
    /// Of `history`.
    History { model: ModelName, history: Vec<Promotion> },
    /// Of `promote` and `rollback`.
    Promotion { promotion: Promotion },
    /// Of `compare`.
    Comparison { comparison: Comparison, style: Style },
    /// Of `leaderboard`.
    Leaderboard { leaderboard: Leaderboard, style: Style },
    /// Of `lineage`.
    Lineage { nodes: Vec<LineageNode> },
    /// Of `fsck`.
    Fsck { report: fsck::Report },
    /// Of `gc`.
    Gc { dry_run: bool, plan: Plan },
    /// Of `adopt`.
    Adopted { store: StoreId },
    /// Of `audit`.
    Audit { entries: Vec<AuditEntry> },
    /// Of `forget`.
    Forgotten { runs: Vec<(RunId, Forgotten)> },
    /// Of `backup`.
    BackedUp { summary: Summary, dir: std::path::PathBuf },
    /// Of `restore`.
    Restored { summary: Summary, dir: std::path::PathBuf },
    /// Of `export`.
    Exported {
        version: Version,
        dir: std::path::PathBuf,
        files: Vec<String>,
        /// Parts that the layout has no place for.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        left_out: Vec<String>,
    },
    /// Of `import`.
    Imported { version: Version, file: String },
}

/// What came of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Answer {
    /// The process's exit code.
    pub exit: u8,
    /// What was asked for.
    pub data: Option<Data>,
    /// Why it was refused, or what was found to be wrong.
    pub error: Option<ApiError>,
}

impl Answer {
    fn done(data: Data) -> Self {
        Self { exit: 0, data: Some(data), error: None }
    }

    /// Refused, with the exit code that belongs to the error's code.
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
            QueryError::NotFound(_) => error("not-found", e, Some("`registry list` shows what there is")),
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
            WriteError::Conflict(_) => error("conflict", e, Some("`registry history MODEL` shows who moved what")),
            WriteError::Gate(_) => error(
                "gate",
                e,
                Some("nothing was changed; `registry show MODEL` lists every version with its metrics"),
            ),
            WriteError::NotFound(_) => error("not-found", e, Some("`registry list` shows what there is")),
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
        let code = match e {
            OpenError::NotAStore(_) => "not-found",
            _ => "store",
        };
        Self::refused(error(code, e, Some(&e.hint())))
    }
}

impl From<BackupError> for Answer {
    fn from(e: BackupError) -> Self {
        match e {
            BackupError::Folder(_) => Self::refused(error("invalid", e, Some("name another folder"))),
            BackupError::Damaged(_) => Self::refused(error("damaged", e, Some("`registry fsck` checks a store"))),
            BackupError::Disk { .. } => {
                Self::refused(error("storage", e, Some("see to the disk and run the same command again")))
            }
            BackupError::Query(e) => Self::from(e),
        }
    }
}

fn invalid(message: impl ToString) -> Refused {
    Refused::from(error("invalid", message, Some("`registry help` shows how commands are written")))
}

/// A refusal on its way out of a function.
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

/// Runs a command on a store that this process holds, in the name of `actor`.
pub async fn run(command: Command, store: &Store, actor: &str) -> Answer {
    answer(command, store, Some((store, actor))).await.unwrap_or_else(|refused| *refused.0)
}

/// Runs a command that only reads.
pub async fn read(command: Command, store: &ReadStore) -> Answer {
    answer(command, store, None).await.unwrap_or_else(|refused| *refused.0)
}

/// `holder` is `store` if this process holds it, and in whose name it is changed.
async fn answer(command: Command, store: &ReadStore, holder: Option<(&Store, &str)>) -> Result<Answer, Refused> {
    let writes = || holder.ok_or_else(|| invalid("the command changes the store, which was opened for reading"));
    let data = match command {
        Command::List => Data::Models { models: store.models().await? },
        Command::Show { reference } => show(store, &reference).await?,
        Command::History { model, alias } => {
            let model = known(store, &model).await?.model;
            let alias = alias.map(|alias| alias.parse::<Alias>()).transpose().map_err(invalid)?;
            let history = store.history(&model, alias.as_ref()).await?;
            Data::History { model, history }
        }
        Command::Promote { reference, to, expect, require, reason } => {
            let reference: ModelRef = reference.parse().map_err(invalid)?;
            let alias: Alias = to.parse().map_err(invalid)?;
            for gate in &require {
                gate.parse::<Gate>().map_err(invalid)?;
            }
            let Some(pick) = reference.pick else {
                let model = reference.model;
                return Err(invalid(format!(
                    "`{model}` has several versions: say `{model}@best` or `{model}:VERSION`"
                )));
            };
            let (store, actor) = writes()?;
            let promotion = store.promote(&reference.model, pick, &alias, expect, require, &reason, actor).await?;
            Data::Promotion { promotion }
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
        Command::Lineage { reference } => {
            let digest = match reference.parse::<Digest>() {
                Ok(digest) => digest,
                Err(_) => store.resolve(&reference).await?.artifact,
            };
            let nodes = store.lineage(digest).await?;
            if nodes.iter().all(|node| node.kind.is_none() && node.inputs.is_empty()) && !exists(store, digest).await? {
                return Err(Refused::from(QueryError::NotFound(format!("no artifact {digest}"))));
            }
            Data::Lineage { nodes }
        }
        Command::Audit { limit } => {
            let dir = store.dir().to_owned();
            let read = tokio::task::spawn_blocking(move || audit::read(&dir, limit.min(MOST_LINES))).await;
            let failed = |e: &dyn std::fmt::Display| QueryError::Storage(format!("the audit log cannot be read: {e}"));
            Data::Audit { entries: read.map_err(|e| failed(&e))?.map_err(|e| failed(&e))? }
        }
        Command::Fsck => {
            let report = store.fsck().await?;
            if !report.problems.is_empty() {
                let message = format!("{} problems found; the first: {}", report.problems.len(), report.problems[0]);
                let hint = "restore the store from a backup, or remove the damaged blobs under `blobs/` and run the pipelines \
                            that made them again";
                let mut answer = Answer::refused(error("damaged", message, Some(hint)));
                answer.data = Some(Data::Fsck { report });
                return Err(answer.into());
            }
            Data::Fsck { report }
        }
        Command::Gc { dry_run, grace_minutes } => {
            let grace_ms = grace_minutes.map_or(GRACE_MS, |minutes| i64::from(minutes) * 60_000);
            let plan = if dry_run { store.gc_plan(grace_ms).await? } else { writes()?.0.gc(grace_ms).await? };
            Data::Gc { dry_run, plan }
        }
        Command::Forget { run } => {
            let run = RunId::new(run);
            let gone = writes()?.0.forget(&run).await?;
            Data::Forgotten { runs: vec![(run, gone)] }
        }
        Command::ForgetEnded { before_ms } => {
            let mut runs = Vec::new();
            // One transaction each, so that other writes get in between.
            for run in store.ended_before(before_ms).await? {
                let gone = writes()?.0.forget(&run).await?;
                runs.push((run, gone));
            }
            Data::Forgotten { runs }
        }
        Command::ForgetLeftovers { before_ms } => {
            let mut runs = Vec::new();
            for run in store.ended_before(before_ms).await? {
                let gone = writes()?.0.forget_leftovers(&run, before_ms).await?;
                if gone != Forgotten::default() {
                    runs.push((run, gone));
                }
            }
            Data::Forgotten { runs }
        }
    };
    Ok(Answer::done(data))
}

/// The version that a reference names; a model alone stands for its best one, or its newest where no metric decides.
async fn one(store: &ReadStore, text: &str) -> Result<Version, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_some() {
        return Ok(store.resolve(text).await?);
    }
    let pick = if known(store, text).await?.best.is_some() { BEST } else { LATEST };
    Ok(store.resolve(&format!("{text}@{pick}")).await?)
}

/// The data format of a version's motions, which is how the papers name their datasets.
async fn format_of(store: &ReadStore, version: &Version) -> Option<String> {
    let manifest = manifest(store, version.artifact).await.ok()?;
    ModelMeta::read(&manifest).ok().map(|model| model.format.name().to_owned())
}

async fn leaderboard(store: &ReadStore, of: &str, published: bool) -> Result<Leaderboard, Refused> {
    if leaderboard::FORMATS.contains(&of) {
        let mut all = Vec::new();
        for model in store.models().await? {
            for version in store.versions(&model.model).await? {
                if format_of(store, &version).await.as_deref() == Some(of) {
                    all.push(version);
                }
            }
        }
        return Ok(leaderboard::leaderboard(of.to_owned(), &all, None, published.then_some(of)));
    }
    let model = known(store, of).await?;
    let versions = store.versions(&model.model).await?;
    let format = match versions.first().filter(|_| published) {
        Some(version) => format_of(store, version).await,
        None => None,
    };
    Ok(leaderboard::leaderboard(of.to_owned(), &versions, model.metric.as_deref(), format.as_deref()))
}

async fn known(store: &ReadStore, name: &str) -> Result<Model, Refused> {
    let name: ModelName = name.parse().map_err(invalid)?;
    match store.model(&name).await? {
        Some(model) => Ok(model),
        // Says which models there are.
        None => Err(store
            .resolve(&format!("{name}@latest"))
            .await
            .map_or_else(Refused::from, |_| invalid("the model was made just now"))),
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

/// Versions that are looked at for bases of a control part.
pub const MOST_BASES: usize = 1_000;
/// Lines of the audit log that are shown at most.
const MOST_LINES: usize = 10_000;

async fn show(store: &ReadStore, text: &str) -> Result<Data, Refused> {
    let reference: ModelRef = text.parse().map_err(invalid)?;
    if reference.pick.is_none() {
        let model = known(store, reference.model.as_str()).await?;
        let versions = store.versions(&reference.model).await?;
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

/// Other versions whose parts are those that are `wanted`: the models that a control part fits.
async fn bases(store: &ReadStore, own: &Version, wanted: &Parts) -> Result<Vec<String>, Refused> {
    let mut all = Vec::new();
    for model in store.models().await? {
        all.extend(store.versions(&model.model).await?);
    }
    all.sort_by_key(|version| std::cmp::Reverse(version.created_ms));
    let mut bases = Vec::new();
    for version in all.iter().take(MOST_BASES).filter(|version| version.artifact != own.artifact) {
        // What is no model, or is damaged, is no base; `fsck` says so.
        let Ok(manifest) = manifest(store, version.artifact).await else { continue };
        let Ok(model) = ModelMeta::read(&manifest) else { continue };
        if wanted.iter().all(|(role, digest)| model.parts.get(role) == Some(digest)) {
            bases.push(format!("{}:{}", version.model, version.version));
        }
    }
    Ok(bases)
}

/// For each part of a model those that it was made for; nothing for what is no model.
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
