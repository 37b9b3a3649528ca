//! Application of each [`Write`] to the tables, inside the writer's transaction, so that the check of a fence and the
//! guarded writes are atomic.
//!
//! The writes of one order are first checked one by one against the fences in this transaction, then stored table by
//! table. One statement stores many rows, because with hundreds of workers the number of statements dominates the cost.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::message::Grant;
use protocol::{Digest, Fence, RunId, TaskId};

use super::error::write_error;
use super::recording::Recording;
use super::statement::{Builder, Column, Conn, ROWS, Values, insert, int, json, one, query, run, run_and_stage};
use super::{history, logs, moves, owners};
use crate::catalog::{PromoteOrder, References, Which};
use crate::proofs::{Artifact, Proofs};
use crate::write::two_states;
use crate::{Write, WriteError, clock};

type Result<T> = std::result::Result<T, WriteError>;

/// Does all of `writes`, or says why one of them is refused; then the caller rolls back.
pub(super) async fn apply(
    conn: &mut Conn<'_>,
    proofs: &Proofs,
    recording: &mut Recording,
    writes: &[Write],
) -> Result<()> {
    let mut fences = Fences::read(conn, writes).await?;
    // One time for the end of a run and of its last stage, in any order of their rows.
    let now = clock::now_ms();
    let mut decisions = Vec::new();
    let mut shards = BTreeMap::new();
    for write in writes {
        if let Some(grant) = write.grant() {
            fences.check(grant)?;
        }
        match write {
            Write::Facts { seq, facts } => decisions.push((*seq, facts.as_str())),
            Write::SnapshotParts { seq, parts } => set_parts(conn, *seq, parts).await?,
            Write::Snapshot { seq, state } => set_snapshot(conn, *seq, state).await?,
            Write::Fence { task, fence } => fences.raise(task, *fence)?,
            Write::Run { run, pipeline, source, state, idempotency_key } => {
                set_run(conn, run.as_str(), &pipeline.to_string(), source, state, idempotency_key.as_deref()).await?;
            }
            Write::Submission { run, digest } => add_submission(conn, run, *digest).await?,
            Write::RunOwner { run, owner } => owners::own_run(conn, run, owner).await?,
            Write::ModelOwner { model, owner } => owners::claim(conn, model, owner).await?,
            Write::RunState { run, state } => set_run_state(conn, run, state, now).await?,
            Write::RunEnded { run, state, view, archive } => end_run(conn, run, state, view, archive, now).await?,
            Write::Archive { key, run, stage, execution } => {
                set_archive(conn, *key, run.as_str(), stage.as_str(), execution.as_deref()).await?;
            }
            Write::History(entries) => history::add(conn, entries, now).await?,
            Write::Metrics { grant, rows } => recording.add(conn, grant, rows).await?,
            Write::Logs { grant, first, lines } => logs::add(conn, grant, *first, lines).await?,
            Write::Checkpoint { grant, step, manifest, metrics } => {
                proven(conn, proofs, *manifest).await?;
                add_checkpoint(conn, grant, *step, *manifest, &json(metrics)).await?;
            }
            Write::Shard { grant, output } => {
                proven(conn, proofs, *output).await?;
                add_shard(&mut shards, &grant.task, *output)?;
            }
            Write::StageResult { grant: _, key, run, stage, kind, outputs, metrics, inputs, wall_s } => {
                let run = run.as_str();
                let stage = stage.as_str();
                let made = Made { key: *key, run, stage, kind, outputs, metrics, inputs, wall_s: *wall_s };
                set_result(conn, proofs, &made).await?;
            }
            Write::Version { model, artifact, metrics, source } => {
                let kind = proven(conn, proofs, *artifact).await?.kind;
                moves::register(conn, model, *artifact, kind, metrics, source).await?;
            }
            Write::Promote { model, alias, artifact, require, reason, actor } => {
                let model = model.clone();
                let alias = alias.clone();
                let to = Which::Artifact(*artifact);
                let require = require.clone();
                let reason = reason.clone();
                let actor = actor.clone();
                moves::promote(conn, &PromoteOrder { model, alias, to, expect: None, require, reason, actor }).await?;
            }
        }
    }
    add_facts(conn, &decisions).await?;
    add_shards(conn, &shards).await?;
    fences.write(conn).await
}

async fn add_submission(conn: &mut Conn<'_>, of: &RunId, digest: Digest) -> Result<()> {
    let set = query("INSERT INTO submissions (run, digest) VALUES (?, ?) ON CONFLICT DO NOTHING");
    run(conn, set.bind(of.as_str()).bind(digest.to_string())).await.map(drop)
}

async fn set_run_state(conn: &mut Conn<'_>, of: &RunId, state: &str, now: i64) -> Result<()> {
    let set = query("UPDATE runs SET state = ?, updated_ms = ? WHERE run = ?");
    run(conn, set.bind(state).bind(now).bind(of.as_str())).await.map(drop)
}

async fn end_run(conn: &mut Conn<'_>, of: &RunId, state: &str, view: &str, archive: &str, now: i64) -> Result<()> {
    set_run_state(conn, of, state, now).await?;
    let set = query("UPDATE runs SET view = ?, archive = ? WHERE run = ?").bind(view).bind(archive);
    run(conn, set.bind(of.as_str())).await.map(drop)
}

async fn add_checkpoint(conn: &mut Conn<'_>, grant: &Grant, step: u64, manifest: Digest, metrics: &str) -> Result<()> {
    one_checkpoint_a_step(conn, &grant.task, step, manifest).await?;
    let insert = query(
        "INSERT INTO checkpoints (task, attempt, step, manifest, metrics, at_ms) VALUES (?, ?, ?, ?, ?, ?) \
         ON CONFLICT DO NOTHING",
    );
    let insert = insert.bind(grant.task.as_str()).bind(int(grant.attempt.0)).bind(int(step));
    run(conn, insert.bind(manifest.to_string()).bind(metrics).bind(clock::now_ms())).await.map(drop)
}

/// Largest number of references of an artifact that are recorded. A collection reads longer lists from the manifest.
const REFERENCES: usize = 256;

/// Checks that an artifact which a row is about to name is proven. Records its blobs as stored, and its references.
pub(super) async fn proven(conn: &mut Conn<'_>, proofs: &Proofs, digest: Digest) -> Result<Arc<Artifact>> {
    let artifact = proofs.name(digest)?;
    let now = clock::now_ms();
    let rows: Vec<(&Digest, &u64)> = artifact.blobs.iter().collect();
    let values = |row: &mut Values<'_, '_>, (digest, bytes): &(&Digest, &u64)| {
        row.push_bind(digest.to_string()).push_bind(int(**bytes)).push_bind(now);
    };
    insert(conn, "INSERT INTO blobs (digest, bytes, verified_ms) ", &rows, values, " ON CONFLICT DO NOTHING").await?;
    let References { blobs, mentioned } = &artifact.references;
    if blobs.len() + mentioned.len() <= REFERENCES {
        let refers = query("INSERT INTO manifests (digest, refers) VALUES (?, ?) ON CONFLICT DO NOTHING");
        run(conn, refers.bind(digest.to_string()).bind(json(&artifact.references))).await?;
    }
    Ok(artifact)
}

/// Runs `select` for `tasks` and returns the values by task. `select` has two columns, the task first, and ends in an
/// open list: `... WHERE task IN (`.
async fn by_task<T>(conn: &mut Conn<'_>, select: &'static str, tasks: &[&TaskId]) -> Result<BTreeMap<TaskId, T>>
where
    T: for<'r> Column<'r>,
{
    let mut found = BTreeMap::new();
    for tasks in tasks.chunks(ROWS) {
        let mut find = Builder::new(select);
        for (place, task) in tasks.iter().enumerate() {
            find.push(if place == 0 { "" } else { ", " }).push_bind(task.as_str());
        }
        find.push(")");
        let rows = find.build().fetch_all(&mut *conn).await.map_err(write_error)?;
        found.extend(rows.iter().map(|row| (TaskId::from(row.get::<&str, _>(0)), row.get::<T, _>(1))));
    }
    Ok(found)
}

/// The task whose fence decides on a write.
fn fenced_task(write: &Write) -> Option<&TaskId> {
    match write {
        Write::Fence { task, .. } => Some(task),
        other => other.grant().map(|grant| &grant.task),
    }
}

/// The fences of an order's tasks, as of its transaction.
struct Fences {
    known: BTreeMap<TaskId, Fence>,
    raised: BTreeSet<TaskId>,
}

impl Fences {
    async fn read(conn: &mut Conn<'_>, writes: &[Write]) -> Result<Self> {
        let tasks: BTreeSet<&TaskId> = writes.iter().filter_map(fenced_task).collect();
        let tasks: Vec<&TaskId> = tasks.into_iter().collect();
        let known = by_task::<i64>(conn, "SELECT task, fence FROM fences WHERE task IN (", &tasks).await?;
        let known = known.into_iter().map(|(task, fence)| (task, Fence(fence.unsigned_abs()))).collect();
        Ok(Self { known, raised: BTreeSet::new() })
    }

    /// Checks that a write's grant is the newest one of its task.
    fn check(&self, grant: &Grant) -> Result<()> {
        match self.known.get(&grant.task) {
            Some(current) if *current == grant.fence => Ok(()),
            Some(current) if *current > grant.fence => {
                Err(WriteError::StaleFence { task: grant.task.clone(), current: *current, carried: grant.fence })
            }
            _ => Err(WriteError::Conflict(format!(
                "the write for task `{}` carries fence {}, which was never granted",
                grant.task, grant.fence
            ))),
        }
    }

    fn raise(&mut self, task: &TaskId, fence: Fence) -> Result<()> {
        if let Some(current) = self.known.get(task).filter(|current| **current >= fence) {
            return Err(WriteError::StaleFence { task: task.clone(), current: *current, carried: fence });
        }
        self.known.insert(task.clone(), fence);
        self.raised.insert(task.clone());
        Ok(())
    }

    async fn write(self, conn: &mut Conn<'_>) -> Result<()> {
        let rows: Vec<(&TaskId, Fence)> = self.raised.iter().map(|task| (task, self.known[task])).collect();
        let begin = "INSERT INTO fences (task, fence) ";
        let end = " ON CONFLICT (task) DO UPDATE SET fence = excluded.fence";
        let values = |row: &mut Values<'_, '_>, (task, fence): &(&TaskId, Fence)| {
            row.push_bind(task.as_str().to_owned()).push_bind(int(fence.0));
        };
        insert(conn, begin, &rows, values, end).await
    }
}

async fn add_facts(conn: &mut Conn<'_>, decisions: &[(u64, &str)]) -> Result<()> {
    let now = clock::now_ms();
    if let Some((first, _)) = decisions.first() {
        let find = "SELECT {greatest}(coalesce((SELECT max(seq) FROM facts), 0), coalesce((SELECT max(seq) FROM snapshots), 0))";
        let newest: i64 = one(conn, query(find)).await?.map_or(0, |row| row.get(0));
        if newest >= int(*first) {
            return Err(WriteError::Internal(format!(
                "decision {first} is already stored (the newest is {newest}); check if another coordinator uses the store"
            )));
        }
    }
    let values = |row: &mut Values<'_, '_>, (seq, facts): &(u64, &str)| {
        row.push_bind(int(*seq)).push_bind(now).push_bind((*facts).to_owned());
    };
    insert(conn, "INSERT INTO facts (seq, at_ms, facts) ", decisions, values, "").await
}

async fn set_parts(conn: &mut Conn<'_>, seq: u64, parts: &[(String, Option<String>)]) -> Result<()> {
    let values = |row: &mut Values<'_, '_>, (part, state): &(String, Option<String>)| {
        row.push_bind(part.clone()).push_bind(int(seq)).push_bind(state.clone());
    };
    let begin = "INSERT INTO snapshot_parts (part, seq, state) ";
    insert(conn, begin, parts, values, " ON CONFLICT (part, seq) DO UPDATE SET state = excluded.state").await
}

/// Stores a snapshot. Deletes the facts it covers, the previous snapshot, and replaced parts.
async fn set_snapshot(conn: &mut Conn<'_>, seq: u64, state: &str) -> Result<()> {
    // Parts of a snapshot that was never completed.
    let given_up = "DELETE FROM snapshot_parts WHERE seq < ? AND seq > (SELECT coalesce(max(seq), 0) FROM snapshots WHERE seq < ?)";
    run(conn, query(given_up).bind(int(seq)).bind(int(seq))).await?;
    let superseded = "DELETE FROM snapshot_parts WHERE (part, seq) IN (SELECT old.part, old.seq FROM snapshot_parts new \
                      JOIN snapshot_parts old ON old.part = new.part AND old.seq < new.seq WHERE new.seq = ?)";
    run(conn, query(superseded).bind(int(seq))).await?;
    run(conn, query("DELETE FROM snapshot_parts WHERE seq = ? AND state IS NULL").bind(int(seq))).await?;
    let set = query(
        "INSERT INTO snapshots (seq, at_ms, state) VALUES (?, ?, ?) ON CONFLICT (seq) DO UPDATE SET state = excluded.state",
    );
    run(conn, set.bind(int(seq)).bind(clock::now_ms()).bind(state)).await?;
    run(conn, query("DELETE FROM snapshots WHERE seq < ?").bind(int(seq))).await?;
    run(conn, query("DELETE FROM facts WHERE seq <= ?").bind(int(seq))).await.map(|_| ())
}

async fn set_archive(conn: &mut Conn<'_>, key: Digest, of: &str, stage: &str, execution: Option<&str>) -> Result<()> {
    let Some(execution) = execution else {
        return run(conn, query("DELETE FROM executions WHERE key = ?").bind(key.to_string())).await.map(|_| ());
    };
    let set = query(
        "INSERT INTO executions (key, run, stage, execution, at_ms) VALUES (?, ?, ?, ?, ?) ON CONFLICT (key) DO UPDATE \
         SET run = excluded.run, stage = excluded.stage, execution = excluded.execution, at_ms = excluded.at_ms",
    );
    run(conn, set.bind(key.to_string()).bind(of).bind(stage).bind(execution).bind(clock::now_ms())).await.map(|_| ())
}

/// Refuses a second state of one step. Two states break a guarantee, and continuing from either would hide that.
async fn one_checkpoint_a_step(conn: &mut Conn<'_>, task: &TaskId, step: u64, manifest: Digest) -> Result<()> {
    let find = "SELECT manifest FROM checkpoints WHERE task = ? AND step = ? AND manifest <> ?";
    let find = query(find).bind(task.as_str()).bind(int(step)).bind(manifest.to_string());
    match one(conn, find).await?.map(|row| row.get::<String, _>(0)) {
        Some(stored) => Err(WriteError::Conflict(two_states(task, step, &stored, &manifest.to_string()))),
        None => Ok(()),
    }
}

async fn set_run(
    conn: &mut Conn<'_>,
    run_id: &str,
    pipeline: &str,
    source: &str,
    state: &str,
    key: Option<&str>,
) -> Result<()> {
    if let Some(key) = key {
        let holder = one(conn, query("SELECT run FROM runs WHERE idempotency_key = ?").bind(key)).await?;
        let holder: Option<String> = holder.map(|row| row.get(0));
        if let Some(holder) = holder.filter(|holder| holder != run_id) {
            return Err(WriteError::Conflict(format!("idempotency key `{key}` already belongs to run `{holder}`")));
        }
    }
    let now = clock::now_ms();
    let set = query(
        "INSERT INTO runs (run, pipeline, source, state, idempotency_key, created_ms, updated_ms) VALUES (?, ?, ?, ?, ?, ?, ?) \
         ON CONFLICT (run) DO UPDATE SET pipeline = excluded.pipeline, source = excluded.source, state = excluded.state, \
         idempotency_key = coalesce(excluded.idempotency_key, runs.idempotency_key), updated_ms = excluded.updated_ms",
    );
    run(conn, set.bind(run_id).bind(pipeline).bind(source).bind(state).bind(key).bind(now).bind(now)).await.map(|_| ())
}

/// Adds a shard to the shards of an order.
fn add_shard<'a>(shards: &mut BTreeMap<&'a TaskId, Digest>, task: &'a TaskId, output: Digest) -> Result<()> {
    match shards.insert(task, output) {
        Some(other) if other != output => Err(two_shards(task, &other.to_string(), output)),
        Some(_) | None => Ok(()),
    }
}

fn two_shards(task: &TaskId, stored: &str, output: Digest) -> WriteError {
    WriteError::Conflict(format!("shard `{task}` is already stored as {stored}, but this attempt made {output}"))
}

async fn add_shards(conn: &mut Conn<'_>, shards: &BTreeMap<&TaskId, Digest>) -> Result<()> {
    let tasks: Vec<&TaskId> = shards.keys().copied().collect();
    let stored = by_task::<String>(conn, "SELECT task, output FROM shards WHERE task IN (", &tasks).await?;
    for (task, stored) in &stored {
        let output = shards[task];
        if *stored != output.to_string() {
            return Err(two_shards(task, stored, output));
        }
    }
    let now = clock::now_ms();
    let rows: Vec<_> = shards.iter().filter(|(task, _)| !stored.contains_key(**task)).collect();
    let values = |row: &mut Values<'_, '_>, (task, output): &(&&TaskId, &Digest)| {
        row.push_bind(task.as_str().to_owned()).push_bind(run_and_stage(task).0.to_owned());
        row.push_bind(output.to_string()).push_bind(now);
    };
    insert(conn, "INSERT INTO shards (task, run, output, at_ms) ", &rows, values, "").await
}

struct Made<'a> {
    key: Digest,
    run: &'a str,
    stage: &'a str,
    kind: &'a str,
    outputs: &'a BTreeMap<String, Digest>,
    metrics: &'a BTreeMap<String, f64>,
    inputs: &'a BTreeMap<String, Digest>,
    wall_s: f64,
}

async fn set_result(conn: &mut Conn<'_>, proofs: &Proofs, made: &Made<'_>) -> Result<()> {
    let key = made.key.to_string();
    let outputs = json(made.outputs);
    let stored = one(conn, query("SELECT outputs FROM stage_results WHERE key = ?").bind(&key)).await?;
    match stored.map(|row| row.get::<String, _>(0)) {
        Some(stored) if stored == outputs => return Ok(()),
        Some(stored) => {
            return Err(WriteError::Conflict(format!(
                "stage `{}` of run `{}` has the key {key}, whose outputs are stored as {stored}; this attempt made {outputs}",
                made.stage, made.run
            )));
        }
        None => {}
    }
    proofs.note(made.inputs.values().copied());
    let now = clock::now_ms();
    let add = query(
        "INSERT INTO stage_results (key, run, stage, kind, outputs, metrics, inputs, wall_s, at_ms) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
    );
    let add = add.bind(&key).bind(made.run).bind(made.stage).bind(made.kind).bind(outputs).bind(json(made.metrics));
    run(conn, add.bind(json(made.inputs)).bind(made.wall_s).bind(now)).await?;
    for output in made.outputs.values() {
        let artifact = proven(conn, proofs, *output).await?;
        let kind =
            serde_json::to_value(artifact.kind).ok().and_then(|k| k.as_str().map(str::to_owned)).unwrap_or_default();
        let add = query(
            "INSERT INTO artifacts (digest, kind, bytes, run, stage, key, at_ms) VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
        );
        let add = add.bind(output.to_string()).bind(kind).bind(int(artifact.bytes)).bind(made.run).bind(made.stage);
        run(conn, add.bind(&key).bind(now)).await?;
        for (role, input) in made.inputs {
            let add = query("INSERT INTO edges (parent, child, role) VALUES (?, ?, ?) ON CONFLICT DO NOTHING");
            run(conn, add.bind(input.to_string()).bind(output.to_string()).bind(role)).await?;
        }
    }
    Ok(())
}
