//! What each [`Write`] does to the tables. Runs inside the writer's transaction, which is what makes the check of the fence
//! and the write it guards one thing.

use std::collections::BTreeMap;

use protocol::message::{Grant, MetricRow};
use protocol::{Digest, Fence, Manifest, TaskId};
use sqlx::{Row, SqliteConnection};

use super::write_error;
use crate::blob::{BlobStore, ManifestError};
use crate::{Write, WriteError, catalog, clock};

type Result<T> = std::result::Result<T, WriteError>;

pub(crate) async fn apply(conn: &mut SqliteConnection, blobs: &BlobStore, write: &Write) -> Result<()> {
    match write {
        Write::Journal(event) => {
            let insert = sqlx::query("INSERT INTO journal (at_ms, event) VALUES (?, ?)");
            run(conn, insert.bind(clock::now_ms()).bind(event.to_string())).await.map(|_| ())
        }
        Write::Fence { task, fence } => set_fence(conn, task, *fence).await,
        Write::Run { run, pipeline, source, state, idempotency_key } => {
            set_run(conn, run.as_str(), &pipeline.to_string(), source, state, idempotency_key.as_deref()).await
        }
        Write::Metrics { grant, rows } => {
            check(conn, grant).await?;
            add_metrics(conn, grant, rows).await
        }
        Write::Logs { grant, first, lines } => {
            check(conn, grant).await?;
            add_logs(conn, grant, *first, lines).await
        }
        Write::Checkpoint { grant, step, manifest, metrics } => {
            check(conn, grant).await?;
            complete(blobs, *manifest)?;
            let insert = sqlx::query(
                "INSERT INTO checkpoints (task, attempt, step, manifest, metrics, at_ms) VALUES (?, ?, ?, ?, ?, ?) \
                 ON CONFLICT DO NOTHING",
            );
            let insert = insert.bind(grant.task.as_str()).bind(int(grant.attempt.0)).bind(int(*step));
            run(conn, insert.bind(manifest.to_string()).bind(json(metrics)).bind(clock::now_ms())).await.map(|_| ())
        }
        Write::Shard { grant, output } => {
            check(conn, grant).await?;
            complete(blobs, *output)?;
            set_shard(conn, &grant.task, *output).await
        }
        Write::StageResult { grant, key, run, stage, kind, outputs, metrics, inputs, wall_s } => {
            if let Some(grant) = grant {
                check(conn, grant).await?;
            }
            let made = Made {
                key: *key,
                run: run.as_str(),
                stage: stage.as_str(),
                kind,
                outputs,
                metrics,
                inputs,
                wall_s: *wall_s,
            };
            set_result(conn, blobs, &made).await
        }
        Write::Version { model, artifact, metrics, source } => {
            let manifest = complete(blobs, *artifact)?;
            catalog::register(conn, model, *artifact, manifest.kind, metrics, source).await.map(|_| ())
        }
        Write::Promote { model, alias, artifact, require, reason, actor } => {
            let order = catalog::PromoteOrder {
                model: model.clone(),
                alias: alias.clone(),
                to: catalog::Which::Artifact(*artifact),
                expect: None,
                require: require.clone(),
                reason: reason.clone(),
                actor: actor.clone(),
            };
            catalog::promote(conn, &order).await.map(|_| ())
        }
    }
}

pub(crate) type Query<'q> = sqlx::query::Query<'q, sqlx::Sqlite, sqlx::sqlite::SqliteArguments>;

/// Runs a statement and returns how many rows it changed.
pub(crate) async fn run(conn: &mut SqliteConnection, query: Query<'_>) -> Result<u64> {
    query.execute(conn).await.map(|done| done.rows_affected()).map_err(write_error)
}

pub(crate) async fn one(conn: &mut SqliteConnection, query: Query<'_>) -> Result<Option<sqlx::sqlite::SqliteRow>> {
    query.fetch_optional(conn).await.map_err(write_error)
}

/// SQLite's integers are signed; none of our counters comes near the sign.
pub(crate) fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

pub(crate) fn json<T: serde::Serialize>(value: &T) -> String {
    // Maps of names to numbers or digests always serialise.
    serde_json::to_string(value).unwrap_or_else(|e| panic!("a row that is no JSON: {e}"))
}

async fn fence_of(conn: &mut SqliteConnection, task: &TaskId) -> Result<Option<Fence>> {
    let row = one(conn, sqlx::query("SELECT fence FROM fences WHERE task = ?").bind(task.as_str())).await?;
    Ok(row.map(|row| Fence(row.get::<i64, _>(0).unsigned_abs())))
}

/// The check that every write with a grant passes: the grant is the newest that the store knows for its task.
async fn check(conn: &mut SqliteConnection, grant: &Grant) -> Result<()> {
    match fence_of(conn, &grant.task).await? {
        Some(current) if current == grant.fence => Ok(()),
        Some(current) if current > grant.fence => {
            Err(WriteError::StaleFence { task: grant.task.clone(), current, carried: grant.fence })
        }
        current => Err(WriteError::Conflict(format!(
            "the write for task `{}` carries fence {}, which was never granted: the newest is {}",
            grant.task,
            grant.fence,
            current.map_or_else(|| "none".into(), |fence| fence.to_string())
        ))),
    }
}

async fn set_fence(conn: &mut SqliteConnection, task: &TaskId, fence: Fence) -> Result<()> {
    if let Some(current) = fence_of(conn, task).await?.filter(|current| *current >= fence) {
        return Err(WriteError::StaleFence { task: task.clone(), current, carried: fence });
    }
    let set = "INSERT INTO fences (task, fence) VALUES (?, ?) ON CONFLICT (task) DO UPDATE SET fence = excluded.fence";
    run(conn, sqlx::query(set).bind(task.as_str()).bind(int(fence.0))).await.map(|_| ())
}

async fn set_run(
    conn: &mut SqliteConnection,
    run_id: &str,
    pipeline: &str,
    source: &str,
    state: &str,
    key: Option<&str>,
) -> Result<()> {
    if let Some(key) = key {
        let holder = one(conn, sqlx::query("SELECT run FROM runs WHERE idempotency_key = ?").bind(key)).await?;
        let holder: Option<String> = holder.map(|row| row.get(0));
        if let Some(holder) = holder.filter(|holder| holder != run_id) {
            return Err(WriteError::Conflict(format!("idempotency key `{key}` is run `{holder}`'s already")));
        }
    }
    let now = clock::now_ms();
    let set = sqlx::query(
        "INSERT INTO runs (run, pipeline, source, state, idempotency_key, created_ms, updated_ms) VALUES (?, ?, ?, ?, ?, ?, ?) \
         ON CONFLICT (run) DO UPDATE SET pipeline = excluded.pipeline, source = excluded.source, state = excluded.state, \
         idempotency_key = coalesce(excluded.idempotency_key, idempotency_key), updated_ms = excluded.updated_ms",
    );
    run(conn, set.bind(run_id).bind(pipeline).bind(source).bind(state).bind(key).bind(now).bind(now)).await.map(|_| ())
}

/// A task's run and stage, out of its name.
pub(crate) fn run_and_stage(task: &TaskId) -> (&str, &str) {
    let mut parts = task.as_str().split('/');
    (parts.next().unwrap_or_default(), parts.next().unwrap_or_default())
}

async fn add_metrics(conn: &mut SqliteConnection, grant: &Grant, rows: &[MetricRow]) -> Result<()> {
    let (of_run, stage) = run_and_stage(&grant.task);
    let mut series: BTreeMap<&str, i64> = BTreeMap::new();
    for row in rows {
        let id = match series.get(row.key.as_str()) {
            Some(id) => *id,
            None => {
                let (task, attempt) = (grant.task.as_str(), int(grant.attempt.0));
                let find = "SELECT id FROM series WHERE task = ? AND attempt = ? AND key = ?";
                let found = one(conn, sqlx::query(find).bind(task).bind(attempt).bind(&row.key)).await?;
                let id = match found {
                    Some(found) => found.get(0),
                    None => {
                        let add =
                            "INSERT INTO series (run, stage, task, attempt, key) VALUES (?, ?, ?, ?, ?) RETURNING id";
                        let add = sqlx::query(add).bind(of_run).bind(stage).bind(task).bind(attempt).bind(&row.key);
                        add.fetch_one(&mut *conn).await.map_err(write_error)?.get(0)
                    }
                };
                series.insert(&row.key, id);
                id
            }
        };
        let value = (!row.value.is_nan()).then_some(row.value);
        let add = "INSERT INTO metrics (series, step, value) VALUES (?, ?, ?) ON CONFLICT DO NOTHING";
        run(conn, sqlx::query(add).bind(id).bind(int(row.step)).bind(value)).await?;
    }
    Ok(())
}

async fn add_logs(conn: &mut SqliteConnection, grant: &Grant, first: u64, lines: &[String]) -> Result<()> {
    let (of_run, stage) = run_and_stage(&grant.task);
    let now = clock::now_ms();
    for (number, line) in (first..).zip(lines) {
        let add = sqlx::query(
            "INSERT INTO logs (run, stage, task, attempt, worker, line, at_ms, text) VALUES (?, ?, ?, ?, ?, ?, ?, ?) \
             ON CONFLICT DO NOTHING",
        );
        let add = add.bind(of_run).bind(stage).bind(grant.task.as_str()).bind(int(grant.attempt.0));
        run(conn, add.bind(grant.worker.as_str()).bind(int(number)).bind(now).bind(line)).await?;
    }
    Ok(())
}

/// The manifest, once all that it lists is there: before that, no row may name it.
pub(crate) fn complete(blobs: &BlobStore, digest: Digest) -> Result<Manifest> {
    blobs.complete_manifest(digest).map_err(|e| match e {
        ManifestError::Blob(checkpoint::BlobError::NotFound(digest)) => WriteError::NotFound(format!(
            "blob {digest} is not in the store; upload a manifest and all that it lists before naming it"
        )),
        ManifestError::Blob(checkpoint::BlobError::Storage(message)) => WriteError::Storage(message),
        ManifestError::Blob(e) => WriteError::Internal(e.to_string()),
        ManifestError::Incomplete { .. } => {
            WriteError::NotFound(format!("{e}; upload every blob before the manifest is named"))
        }
        ManifestError::NotAManifest { .. } | ManifestError::Format { .. } => WriteError::Conflict(e.to_string()),
    })
}

async fn set_shard(conn: &mut SqliteConnection, task: &TaskId, output: Digest) -> Result<()> {
    let (of_run, _) = run_and_stage(task);
    let stored = one(conn, sqlx::query("SELECT output FROM shards WHERE task = ?").bind(task.as_str())).await?;
    let output = output.to_string();
    match stored.map(|row| row.get::<String, _>(0)) {
        Some(stored) if stored == output => Ok(()),
        Some(stored) => {
            Err(WriteError::Conflict(format!("shard `{task}` is stored as {stored} already; now it is {output}")))
        }
        None => {
            let add = sqlx::query("INSERT INTO shards (task, run, output, at_ms) VALUES (?, ?, ?, ?)");
            run(conn, add.bind(task.as_str()).bind(of_run).bind(output).bind(clock::now_ms())).await.map(|_| ())
        }
    }
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

async fn set_result(conn: &mut SqliteConnection, blobs: &BlobStore, made: &Made<'_>) -> Result<()> {
    let (key, outputs) = (made.key.to_string(), json(made.outputs));
    let stored = one(conn, sqlx::query("SELECT outputs FROM stage_results WHERE key = ?").bind(&key)).await?;
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
    let now = clock::now_ms();
    let add = sqlx::query(
        "INSERT INTO stage_results (key, run, stage, kind, outputs, metrics, inputs, wall_s, at_ms) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
    );
    let add = add.bind(&key).bind(made.run).bind(made.stage).bind(made.kind).bind(outputs).bind(json(made.metrics));
    run(conn, add.bind(json(made.inputs)).bind(made.wall_s).bind(now)).await?;
    for output in made.outputs.values() {
        let manifest = complete(blobs, *output)?;
        let kind =
            serde_json::to_value(manifest.kind).ok().and_then(|k| k.as_str().map(str::to_owned)).unwrap_or_default();
        let bytes: u64 = manifest.files.values().map(|file| file.bytes).sum();
        let add = sqlx::query(
            "INSERT INTO artifacts (digest, kind, bytes, run, stage, key, at_ms) VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
        );
        let add = add.bind(output.to_string()).bind(kind).bind(int(bytes)).bind(made.run).bind(made.stage);
        run(conn, add.bind(&key).bind(now)).await?;
        for (role, input) in made.inputs {
            let add = sqlx::query("INSERT INTO edges (parent, child, role) VALUES (?, ?, ?) ON CONFLICT DO NOTHING");
            run(conn, add.bind(input.to_string()).bind(output.to_string()).bind(role)).await?;
        }
    }
    Ok(())
}
