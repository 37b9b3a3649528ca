//! Runs a command on a store.

use protocol::units::counted;
use protocol::{Alias, ModelName, RunId};

use super::answer::{Answer, Data, Refused, error, invalid};
use super::command::Command;
use super::ranking::leaderboard;
use super::show::{known, lineage, one, show};
use crate::forget::Forgotten;
use crate::retention::GRACE_MS;
use crate::versions::{Expect, Gate, ModelRef, Promotion};
use crate::{QueryError, ReadStore, Store, audit, fsck, leaderboard};

/// Limit of shown lines of the audit log.
const MOST_LINES: usize = 10_000;

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
