//! What may go. Marks from roots, then sweeps what was not marked and is old enough; forgets checkpoints by policy.
//!
//! Roots: every version (so whatever an alias points at), every stage result, every checkpoint that was not pruned, every
//! shard of a run that may still need it, and every pin; and without a row what tasks that are held have uploaded, and what
//! somebody is about to name ([`BlobStore::held`]). From a root the mark follows the
//! manifest's files, digests in the manifest's own words (`meta`), and the lineage. A blob that was put within the grace
//! period is never collected: the row that will name it may be on its way. A loss of power may take the note of what a
//! held task had uploaded; so while a run is under way, blobs from before the store was opened have the usual grace however
//! short a one was asked for.
//!
//! The writer goes on meanwhile. Marking reads one moment of the database; from just before that moment on the writer notes
//! what new rows name (`Named`), and a blob is removed only while nobody can be noting it. A root whose manifest does not
//! read stops the collection, for nobody can say what it needs; so does a database or a folder of blobs that is not the
//! store's own any more.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Deref;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use checkpoint::BlobError;
use protocol::stage::Keep;
use protocol::{Digest, TaskId};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::{Connection, Row, SqliteConnection};

use crate::blob::{BlobStore, ManifestError};
use crate::db::apply::{int, run};
use crate::lock::CollectionLock;
use crate::query::{self, QueryError};
use crate::{ReadStore, Store, WriteError, clock};

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

impl ReadStore {
    /// What [`Store::gc`] would remove.
    pub async fn gc_plan(&self, grace_ms: i64) -> Result<Plan, QueryError> {
        let (rows, blobs) = (Rows::read(self).await?, self.blobs().clone());
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        blocking(move || plan(&blobs, &rows, &ages)).await
    }
}

impl Store {
    /// Removes blobs that nothing needs and that were last put more than `grace_ms` ago; returns what went. Writes go on
    /// meanwhile. Killed in between it has removed only what nothing needs; the next one goes on.
    pub async fn gc(&self, grace_ms: i64) -> Result<Plan, WriteError> {
        let lock = CollectionLock::collect(self.dir()).await;
        let _alone = lock.map_err(|e| WriteError::Storage(format!("nothing was collected: no lock: {e}")))?;
        self.check_identity().await.map_err(|why| WriteError::Storage(format!("nothing was collected: {why}")))?;
        crate::reserve::release_if_full(self.dir());
        let _noting = Noting(Arc::clone(self.named()));
        let forgotten = self.begin_collection().await?;
        let (rows, blobs, named) = (Rows::read(self).await?, self.blobs().clone(), Arc::clone(self.named()));
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        let plan = blocking(move || {
            let plan = plan(&blobs, &rows, &ages)?;
            sweep(&blobs, &rows, &ages, &named, plan)
        });
        let plan = plan.await;
        crate::reserve::keep(self.dir());
        Ok(Plan { forget_shards: forgotten, ..plan? })
    }
}

async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, QueryError> + Send + 'static,
) -> Result<T, QueryError> {
    let ended = |e: tokio::task::JoinError| QueryError::Blob(format!("the collection ended early: {e}"));
    tokio::task::spawn_blocking(work).await.map_err(ended)?
}

/// Blobs, for the writer: what rows come to name while a collection is under way is noted.
#[derive(Debug, Clone)]
pub(crate) struct Vouched {
    pub(crate) blobs: BlobStore,
    pub(crate) named: Arc<Named>,
}

impl Deref for Vouched {
    type Target = BlobStore;

    fn deref(&self) -> &BlobStore {
        &self.blobs
    }
}

/// What rows have come to name since a collection began; `None` while there is none.
#[derive(Debug, Default)]
pub(crate) struct Named(Mutex<Option<BTreeSet<Digest>>>);

impl Named {
    fn lock(&self) -> MutexGuard<'_, Option<BTreeSet<Digest>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// From here on names are noted.
    pub(crate) fn begin(&self) {
        *self.lock() = Some(BTreeSet::new());
    }

    /// Notes what a row is about to name. To be called before it is checked that the blob is there: whoever finds it there
    /// keeps it.
    pub(crate) fn note(&self, digests: impl IntoIterator<Item = Digest>) {
        if let Some(named) = &mut *self.lock() {
            named.extend(digests);
        }
    }

    /// Whether a collection is under way, which is when notes are taken.
    pub(crate) fn is_noting(&self) -> bool {
        self.lock().is_some()
    }

    fn noted(&self) -> BTreeSet<Digest> {
        self.lock().clone().unwrap_or_default()
    }

    /// Does `remove` unless the blob has been named; nobody can name it meanwhile.
    fn unless_named<T>(&self, digest: Digest, remove: impl FnOnce() -> T) -> Option<T> {
        let named = self.lock();
        let is_named = named.as_ref().is_some_and(|named| named.contains(&digest));
        (!is_named).then(remove)
    }
}

/// Ends the noting, however the collection ends.
struct Noting(Arc<Named>);

impl Drop for Noting {
    fn drop(&mut self) {
        *self.0.lock() = None;
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
    blobs: &Vouched,
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

/// Forgets the shards of finished runs, for which the stage's artifact stands; returns their tasks.
pub(crate) async fn forget_shards(conn: &mut SqliteConnection) -> Result<Vec<TaskId>, WriteError> {
    let forget = "DELETE FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished') RETURNING task";
    let rows = sqlx::query(forget).fetch_all(conn).await.map_err(crate::db::write_error)?;
    let mut tasks: Vec<_> = rows.iter().map(|row| TaskId::new(row.get::<String, _>(0))).collect();
    tasks.sort();
    Ok(tasks)
}

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

/// What a collection has to know of the rows, as of one moment.
pub(crate) struct Rows {
    roots: BTreeMap<Digest, String>,
    /// What each artifact was made of.
    parents: HashMap<Digest, Vec<Digest>>,
    /// Shards that go, by task.
    forget_shards: Vec<TaskId>,
    /// Whether a run is under way.
    live: bool,
}

impl Rows {
    async fn read(store: &ReadStore) -> Result<Self, QueryError> {
        let mut conn = store.readers().acquire().await?;
        // A transaction that reads sees one moment of the database.
        let mut moment = conn.begin().await?;
        let rows = Self::of(&mut moment).await?;
        moment.rollback().await?;
        Ok(rows)
    }

    pub(crate) async fn of(conn: &mut SqliteConnection) -> Result<Self, QueryError> {
        let done = "SELECT task FROM shards WHERE run IN (SELECT run FROM runs WHERE state = 'finished') ORDER BY task";
        let done = sqlx::query(done).fetch_all(&mut *conn).await?;
        let forget_shards: Vec<_> =
            done.iter().map(|row| row.try_get::<String, _>(0).map(TaskId::new)).collect::<Result<_, _>>()?;
        let forgotten: BTreeSet<_> = forget_shards.iter().map(|task| format!("shard `{task}`")).collect();
        let roots = roots(conn).await?.into_iter().filter(|(_, why)| !forgotten.contains(why)).collect();
        let mut parents: HashMap<Digest, Vec<Digest>> = HashMap::new();
        for row in sqlx::query("SELECT parent, child FROM edges").fetch_all(&mut *conn).await? {
            parents.entry(query::digest(&row, "child")?).or_default().push(query::digest(&row, "parent")?);
        }
        let live = "SELECT EXISTS (SELECT 1 FROM runs WHERE state IN ('running', 'paused'))";
        let live = sqlx::query(live).fetch_one(&mut *conn).await?.try_get(0)?;
        Ok(Self { roots, parents, forget_shards, live })
    }
}

/// How old a blob must be to go.
struct Ages {
    now_ms: i64,
    grace_ms: i64,
    /// When this process opened the store.
    opened_ms: i64,
    /// Whether a run is under way.
    live: bool,
}

impl Ages {
    /// A blob that was last put at `put_ms` goes if that is before this time.
    fn before_ms(&self, put_ms: i64) -> i64 {
        let unknown = self.live && put_ms < self.opened_ms;
        let grace_ms = if unknown { self.grace_ms.max(GRACE_MS) } else { self.grace_ms };
        self.now_ms.saturating_sub(grace_ms)
    }
}

/// Adds all that `queue` needs to `marked`. `is_there` says which digests are blobs.
fn mark(
    blobs: &BlobStore,
    rows: &Rows,
    is_there: impl Fn(Digest) -> bool,
    mut queue: Vec<Digest>,
    marked: &mut BTreeSet<Digest>,
) -> Result<(), QueryError> {
    while let Some(digest) = queue.pop() {
        let root = rows.roots.get(&digest);
        if !marked.insert(digest) || !(root.is_some() || is_there(digest)) {
            continue;
        }
        queue.extend(rows.parents.get(&digest).into_iter().flatten());
        match (blobs.manifest(digest), root) {
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
    Ok(())
}

/// The blobs that the rows need, all of them there.
pub(crate) fn needed(blobs: &BlobStore, rows: &Rows) -> Result<BTreeSet<Digest>, QueryError> {
    for (root, why) in &rows.roots {
        blobs.complete_manifest(*root).map_err(|e| QueryError::Blob(format!("{why}: {e}")))?;
    }
    let all = blobs.list().map_err(|e| QueryError::Blob(e.to_string()))?;
    let mut marked = BTreeSet::new();
    mark(blobs, rows, |digest| all.contains_key(&digest), rows.roots.keys().copied().collect(), &mut marked)?;
    // What is mentioned need not be there; what roots list is, by now.
    marked.retain(|digest| all.contains_key(digest));
    Ok(marked)
}

fn plan(blobs: &BlobStore, rows: &Rows, ages: &Ages) -> Result<Plan, QueryError> {
    let all = blobs.list().map_err(|e| QueryError::Blob(e.to_string()))?;
    let mut marked = BTreeSet::new();
    let is_there = |digest| all.contains_key(&digest);
    mark(blobs, rows, is_there, rows.roots.keys().copied().collect(), &mut marked)?;
    // Nobody relies yet on what no row names: if it is damaged, that stops nothing.
    let (damaged, held): (Vec<_>, Vec<_>) = blobs
        .held()
        .into_iter()
        .partition(|digest| matches!(blobs.manifest(*digest), Err(ManifestError::Blob(BlobError::Corrupt { .. }))));
    mark(blobs, rows, is_there, held, &mut marked)?;
    marked.extend(damaged);
    let mut plan = Plan { forget_shards: rows.forget_shards.clone(), ..Plan::default() };
    for (digest, entry) in all {
        if marked.contains(&digest) {
            plan.kept += 1;
        } else if entry.put_ms >= ages.before_ms(entry.put_ms) {
            plan.fresh += 1;
        } else {
            plan.remove.push(digest);
            plan.bytes += entry.bytes;
        }
    }
    Ok(plan)
}

/// Blobs that are removed before new rows are looked at again.
const BATCH: usize = 64;

/// Removes what was planned, but what was put again or named since.
fn sweep(blobs: &BlobStore, rows: &Rows, ages: &Ages, named: &Named, plan: Plan) -> Result<Plan, QueryError> {
    let storage = |e: BlobError| QueryError::Storage(e.to_string());
    let mut plan = Plan { bytes: 0, ..plan };
    let mut kept = BTreeSet::new();
    let candidates = std::mem::take(&mut plan.remove);
    for batch in candidates.chunks(BATCH) {
        // What new rows name has needs of its own.
        mark(blobs, rows, |_| true, named.noted().into_iter().collect(), &mut kept)?;
        for digest in batch.iter().filter(|digest| !kept.contains(digest)) {
            let Some(entry) = blobs.entry(*digest).map_err(storage)? else { continue };
            let remove = || blobs.remove_older(*digest, ages.before_ms(entry.put_ms));
            if named.unless_named(*digest, remove).transpose().map_err(storage)? == Some(true) {
                plan.remove.push(*digest);
                plan.bytes += entry.bytes;
            }
        }
    }
    Ok(plan)
}

/// Digests in a manifest's own words, such as the teacher's in a student's.
pub(crate) fn named(meta: &Value, found: &mut Vec<Digest>) {
    match meta {
        Value::String(text) => found.extend(text.parse::<Digest>()),
        Value::Array(items) => items.iter().for_each(|item| named(item, found)),
        Value::Object(map) => map.values().for_each(|item| named(item, found)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}
