//! Retention in the tables: checkpoints by policy, shards of finished stages, pins, and the blobs that rows need.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use futures::TryStreamExt as _;
use protocol::stage::Keep;
use protocol::{Digest, TaskId};

use super::apply::proven;
use super::error::write_error;
use super::rows::{checkpoints, digest, digests};
use super::statement::{Conn, Row, int, json, query, run};
use crate::catalog::Needs;
use crate::proofs::Proofs;
use crate::{QueryError, WriteError, clock};

/// Deletes a task's checkpoints that `keep` does not select, under way or `at_end`. Refuses a metric that none of them has
/// and deletes nothing.
pub(super) async fn prune(
    conn: &mut Conn<'_>,
    task: &TaskId,
    keep: &Keep,
    at_end: bool,
) -> Result<Vec<Digest>, WriteError> {
    let mut rows = checkpoints(conn, task).await?;
    rows.reverse();
    let metrics: Vec<_> = rows.iter().map(|row| &row.metrics).collect();
    if !rows.is_empty() {
        let saved: BTreeSet<&str> = metrics.iter().flat_map(|row| row.keys().map(String::as_str)).collect();
        keep.check(saved).map_err(|why| WriteError::Conflict(format!("checkpoints of `{task}`: {why}")))?;
    }
    let kept = if at_end { keep.kept_at_end(&metrics) } else { keep.kept(&metrics) };
    let mut forgotten = Vec::new();
    for (row, _) in rows.iter().zip(kept).filter(|(_, kept)| !kept) {
        let forget = query("DELETE FROM checkpoints WHERE task = ? AND step = ? AND manifest = ?");
        run(conn, forget.bind(task.as_str()).bind(int(row.step)).bind(row.manifest.to_string())).await?;
        forgotten.push(row.manifest);
    }
    Ok(forgotten)
}

/// Sets or removes a pin.
pub(super) async fn pin(
    conn: &mut Conn<'_>,
    proofs: &Proofs,
    digest: Digest,
    reason: Option<&str>,
) -> Result<(), WriteError> {
    let name = digest.to_string();
    let Some(reason) = reason else {
        return run(conn, query("DELETE FROM pins WHERE digest = ?").bind(name)).await.map(|_| ());
    };
    proven(conn, proofs, digest).await?;
    let set = "INSERT INTO pins (digest, reason, at_ms) VALUES (?, ?, ?) ON CONFLICT (digest) DO UPDATE SET reason = excluded.reason";
    run(conn, query(set).bind(name).bind(reason).bind(clock::now_ms())).await.map(|_| ())
}

/// Reads the blobs of held tasks.
pub(crate) async fn held(conn: &mut Conn<'_>) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>, QueryError> {
    let mut held: BTreeMap<TaskId, BTreeSet<Digest>> = BTreeMap::new();
    for row in query("SELECT task, digest FROM held_blobs").fetch_all(&mut *conn).await? {
        held.entry(TaskId::new(row.try_get::<String, _>(0)?)).or_default().insert(digest(&row, "digest")?);
    }
    Ok(held)
}

/// Records that a held task stores a blob.
pub(super) async fn hold(conn: &mut Conn<'_>, task: &TaskId, digest: Digest) -> Result<(), WriteError> {
    let hold = "INSERT INTO held_blobs (task, digest) VALUES (?, ?) ON CONFLICT DO NOTHING";
    run(conn, query(hold).bind(task.as_str()).bind(digest.to_string())).await.map(|_| ())
}

/// Deletes the records of tasks that are no longer held.
pub(super) async fn let_go(conn: &mut Conn<'_>, tasks: &[TaskId]) -> Result<(), WriteError> {
    let let_go = "DELETE FROM held_blobs WHERE task IN {texts ?}";
    run(conn, query(let_go).bind(json(&tasks))).await.map(|_| ())
}

/// Deletes the records of blobs and manifests that no row has named since the collection began, and returns these blobs.
pub(super) async fn condemn(conn: &mut Conn<'_>, proofs: &Proofs, blobs: &[Digest]) -> Result<Vec<Digest>, WriteError> {
    let taken = proofs.condemn(blobs);
    for forget in ["DELETE FROM blobs WHERE digest IN {texts ?}", "DELETE FROM manifests WHERE digest IN {texts ?}"] {
        run(conn, query(forget).bind(json(&taken))).await?;
    }
    Ok(taken)
}

/// Deletes the shards of finished runs, which the stage's artifact replaces. Returns their tasks.
pub(super) async fn forget_shards(conn: &mut Conn<'_>) -> Result<Vec<TaskId>, WriteError> {
    let forget = "DELETE FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished') RETURNING task";
    let rows = query(forget).fetch_all(conn).await.map_err(write_error)?;
    let mut tasks: Vec<_> = rows.iter().map(|row| TaskId::new(row.get::<String, _>(0))).collect();
    tasks.sort();
    Ok(tasks)
}

/// Returns the blobs that rows need.
pub(super) async fn needs(conn: &mut Conn<'_>) -> Result<Needs, QueryError> {
    let done = "SELECT task FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished') ORDER BY task";
    let done = query(done).fetch_all(&mut *conn).await?;
    let done_shards = done.iter().map(|row| row.try_get::<String, _>(0).map(TaskId::new)).collect::<Result<_, _>>()?;
    let roots = roots(conn).await?;
    let mut parents: HashMap<Digest, Vec<Digest>> = HashMap::new();
    let mut edges = query("SELECT parent, child FROM edges").fetch(conn);
    while let Some(row) = edges.try_next().await? {
        let parent = digest(&row, "parent")?;
        if roots.binary_search(&parent).is_err() {
            parents.entry(digest(&row, "child")?).or_default().push(parent);
        }
    }
    drop(edges);
    let live = "SELECT EXISTS (SELECT 1 FROM runs WHERE state IN ('running', 'paused'))";
    let live = query(live).fetch_one(&mut *conn).await?.try_get(0)?;
    Ok(Needs { roots, parents, done_shards, live })
}

/// Rows that name an artifact: a description of the row, and the digest in the column `named`, or a list of them.
const NAMING: [&str; 5] = [
    "SELECT 'version ' || model || ':' || version AS what, artifact AS named FROM versions",
    "SELECT '`' || run || '/' || stage || '`' AS what, outputs AS named FROM stage_results",
    "SELECT 'checkpoint of `' || task || '` at step ' || step AS what, manifest AS named FROM checkpoints",
    "SELECT 'shard `' || task || '`' AS what, output AS named FROM shards \
     WHERE run NOT IN (SELECT run FROM runs WHERE state = 'finished')",
    "SELECT 'pin (' || reason || ')' AS what, digest AS named FROM pins",
];

/// The artifacts that a row of [`NAMING`] names, by the name of an output; without one, by an empty name.
fn named(row: &Row) -> Result<BTreeMap<String, Digest>, QueryError> {
    let text: &str = row.try_get("named")?;
    if text.starts_with('{') { digests(text) } else { Ok([(String::new(), digest(row, "named")?)].into()) }
}

/// Lists every artifact that a row names and that must be whole, sorted and without repetition.
async fn roots(conn: &mut Conn<'_>) -> Result<Vec<Digest>, QueryError> {
    let mut roots = Vec::new();
    for naming in NAMING {
        let mut rows = query(naming).fetch(conn);
        while let Some(row) = rows.try_next().await? {
            roots.extend(named(&row)?.into_values());
        }
    }
    roots.sort_unstable();
    roots.dedup();
    Ok(roots)
}

/// Describes a row that names an artifact.
pub(super) async fn named_by(conn: &mut Conn<'_>, artifact: Digest) -> Result<String, QueryError> {
    for naming in NAMING {
        let mut rows = query(naming).fetch(conn);
        while let Some(row) = rows.try_next().await? {
            let what: String = row.try_get("what")?;
            match named(&row)?.iter().find(|(_, named)| **named == artifact) {
                Some((output, _)) if output.is_empty() => return Ok(what),
                Some((output, _)) => return Ok(format!("output `{output}` of {what}")),
                None => {}
            }
        }
    }
    Ok(format!("artifact {artifact}"))
}
