//! What may go. Marks from roots, then sweeps what was not marked and is old enough; forgets checkpoints by policy.
//!
//! Roots: every version (so whatever an alias points at), every stage result, every checkpoint that was not pruned, every
//! shard of a run that may still need it, every pin. From a root the mark follows the manifest's files, digests in the
//! manifest's own words (`meta`), and the lineage. A blob that was put within the grace period is never collected: the row
//! that will name it may be on its way.
//!
//! Collection runs in the writer's thread, between two transactions: no row can come to name a blob while it goes, and
//! what rows no longer name is committed before a blob goes. A root whose manifest does not read stops the collection, for
//! nobody can say what it needs.

use std::collections::{BTreeMap, BTreeSet};

use checkpoint::BlobError;
use protocol::stage::Keep;
use protocol::{Digest, TaskId};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::{Row, SqliteConnection};

use crate::blob::{BlobStore, ManifestError};
use crate::db::apply::{int, run};
use crate::query::{self, QueryError};
use crate::{Store, WriteError, clock};

/// How long a fresh blob is safe from collection: longer than any upload waits for its row.
pub const GRACE_MS: i64 = 60 * 60 * 1000;

/// What a collection removes, or would.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Plan {
    /// Blobs that nothing needs, by name.
    pub remove: Vec<Digest>,
    /// Their bytes.
    pub bytes: u64,
    /// Blobs that nothing needs but that are too fresh to go.
    pub fresh: u64,
    /// Blobs that stay because something needs them.
    pub kept: u64,
    /// Shards of finished runs that are forgotten, by task.
    pub forget_shards: Vec<TaskId>,
}

impl Store {
    /// What [`Self::gc`] would remove.
    pub async fn gc_plan(&self, grace_ms: i64) -> Result<Plan, QueryError> {
        let mut conn = self.readers().acquire().await?;
        plan(&mut conn, self.blobs(), grace_ms).await
    }
}

/// Forgets a task's checkpoints but those that `keep` names. A metric that none of them has is refused, and all of them stay.
pub(crate) async fn prune(conn: &mut SqliteConnection, task: &TaskId, keep: &Keep) -> Result<Vec<Digest>, WriteError> {
    let mut rows = query::checkpoints(conn, task).await?;
    rows.reverse();
    let metrics: Vec<_> = rows.iter().map(|row| &row.metrics).collect();
    if !rows.is_empty() {
        let saved: BTreeSet<&str> = metrics.iter().flat_map(|row| row.keys().map(String::as_str)).collect();
        keep.check(saved).map_err(|why| WriteError::Conflict(format!("checkpoints of `{task}`: {why}")))?;
    }
    let kept = keep.kept(&metrics);
    let mut forgotten = Vec::new();
    for (row, _) in rows.iter().zip(kept).filter(|(_, kept)| !kept) {
        let forget = sqlx::query("DELETE FROM checkpoints WHERE task = ? AND step = ? AND manifest = ?");
        run(conn, forget.bind(task.as_str()).bind(int(row.step)).bind(row.manifest.to_string())).await?;
        forgotten.push(row.manifest);
    }
    Ok(forgotten)
}

/// Sets a pin, or ends it.
pub(crate) async fn pin(
    conn: &mut SqliteConnection,
    blobs: &BlobStore,
    digest: Digest,
    reason: Option<&str>,
) -> Result<(), WriteError> {
    let name = digest.to_string();
    let Some(reason) = reason else {
        return run(conn, sqlx::query("DELETE FROM pins WHERE digest = ?").bind(name)).await.map(|_| ());
    };
    crate::db::apply::complete(blobs, digest)?;
    let set =
        "INSERT INTO pins (digest, reason, at_ms) VALUES (?, ?, ?) ON CONFLICT DO UPDATE SET reason = excluded.reason";
    run(conn, sqlx::query(set).bind(name).bind(reason).bind(clock::now_ms())).await.map(|_| ())
}

/// Removes what nothing needs. Killed in between it has removed only what nothing needs; the next one goes on.
pub(crate) async fn collect(conn: &mut SqliteConnection, blobs: &BlobStore, grace_ms: i64) -> Result<Plan, WriteError> {
    let before_ms = clock::now_ms().saturating_sub(grace_ms);
    let mut plan = plan(conn, blobs, grace_ms).await?;
    // Outside of a transaction: on disk when it returns.
    run(conn, sqlx::query(FORGET_SHARDS)).await?;
    let mut removed = Vec::with_capacity(plan.remove.len());
    for digest in std::mem::take(&mut plan.remove) {
        match blobs.remove_older(digest, before_ms) {
            Ok(true) => removed.push(digest),
            // Put again in the meantime.
            Ok(false) => {}
            Err(e) => return Err(WriteError::Storage(e.to_string())),
        }
    }
    plan.remove = removed;
    Ok(plan)
}

/// The stage's artifact stands for the shards of a run that is finished.
const FORGET_SHARDS: &str = "DELETE FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished')";

/// Every digest that a row names and that must therefore be whole, with the row in words.
pub(crate) async fn roots(conn: &mut SqliteConnection) -> Result<Vec<(Digest, String)>, QueryError> {
    let mut roots = Vec::new();
    for row in sqlx::query("SELECT model, version, artifact FROM versions").fetch_all(&mut *conn).await? {
        let (model, version): (String, i64) = (row.try_get(0)?, row.try_get(1)?);
        roots.push((query::digest(&row, "artifact")?, format!("version {model}:{version}")));
    }
    for row in sqlx::query("SELECT key, run, stage, outputs FROM stage_results").fetch_all(&mut *conn).await? {
        let (run, stage): (String, String) = (row.try_get("run")?, row.try_get("stage")?);
        for (name, digest) in query::digests(row.try_get("outputs")?)? {
            roots.push((digest, format!("output `{name}` of `{run}/{stage}`")));
        }
    }
    for row in sqlx::query("SELECT task, step, manifest FROM checkpoints").fetch_all(&mut *conn).await? {
        let (task, step): (String, i64) = (row.try_get(0)?, row.try_get(1)?);
        roots.push((query::digest(&row, "manifest")?, format!("checkpoint of `{task}` at step {step}")));
    }
    for row in sqlx::query("SELECT task, output FROM shards").fetch_all(&mut *conn).await? {
        let task: String = row.try_get(0)?;
        roots.push((query::digest(&row, "output")?, format!("shard `{task}`")));
    }
    for row in sqlx::query("SELECT digest, reason FROM pins").fetch_all(&mut *conn).await? {
        let reason: String = row.try_get(1)?;
        roots.push((query::digest(&row, "digest")?, format!("pin ({reason})")));
    }
    Ok(roots)
}

async fn plan(conn: &mut SqliteConnection, blobs: &BlobStore, grace_ms: i64) -> Result<Plan, QueryError> {
    let done = "SELECT task FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished') ORDER BY task";
    let rows = sqlx::query(done).fetch_all(&mut *conn).await?;
    let forget_shards: Vec<_> =
        rows.iter().map(|row| row.try_get::<String, _>(0).map(TaskId::new)).collect::<Result<_, _>>()?;
    let forgotten: BTreeSet<_> = forget_shards.iter().map(|task| format!("shard `{task}`")).collect();

    let roots: BTreeMap<Digest, String> =
        roots(conn).await?.into_iter().filter(|(_, why)| !forgotten.contains(why)).collect();
    let all = blobs.list().map_err(|e| QueryError::Blob(e.to_string()))?;
    let mut queue: Vec<Digest> = roots.keys().copied().collect();
    let mut marked = BTreeSet::new();
    while let Some(digest) = queue.pop() {
        if !marked.insert(digest) || !(all.contains_key(&digest) || roots.contains_key(&digest)) {
            continue;
        }
        let parents = sqlx::query("SELECT parent FROM edges WHERE child = ?").bind(digest.to_string());
        for row in parents.fetch_all(&mut *conn).await? {
            queue.push(query::digest(&row, "parent")?);
        }
        match (blobs.manifest(digest), roots.get(&digest)) {
            (Ok(manifest), _) => {
                marked.extend(manifest.files.values().map(|file| file.digest));
                named(&manifest.meta, &mut queue);
            }
            // Mentioned, but as a blob by itself; or gone since the listing.
            (Err(ManifestError::NotAManifest { .. } | ManifestError::Blob(BlobError::NotFound(_))), None) => {}
            (Err(e), why) => {
                let why = why.map_or_else(|| format!("artifact {digest}"), Clone::clone);
                return Err(QueryError::Blob(format!(
                    "nothing was collected, for what {why} needs cannot be read: {e}"
                )));
            }
        }
    }

    let before_ms = clock::now_ms().saturating_sub(grace_ms);
    let mut plan = Plan { forget_shards, ..Plan::default() };
    for (digest, entry) in all {
        if marked.contains(&digest) {
            plan.kept += 1;
        } else if entry.put_ms >= before_ms {
            plan.fresh += 1;
        } else {
            plan.remove.push(digest);
            plan.bytes += entry.bytes;
        }
    }
    Ok(plan)
}

/// Digests in a manifest's own words, such as the teacher's in a student's.
fn named(meta: &Value, found: &mut Vec<Digest>) {
    match meta {
        Value::String(text) => found.extend(text.parse::<Digest>()),
        Value::Array(items) => items.iter().for_each(|item| named(item, found)),
        Value::Object(map) => map.values().for_each(|item| named(item, found)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}
