//! What may go. Marks from roots, then sweeps what was not marked and is old enough.
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
use std::sync::Arc;

use checkpoint::BlobError;
use protocol::artifact::mentioned;
use protocol::{Digest, TaskId};
use serde::{Deserialize, Serialize};

use crate::blob::{BlobStore, ManifestError};
use crate::catalog::{Needs, Root};
use crate::lock::CollectionLock;
use crate::vouched::Named;
use crate::{QueryError, ReadStore, Store, WriteError, clock};

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
        let (rows, blobs) = (Rows::from(self.needs().await?), self.blobs().clone());
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
        let (rows, blobs, named) = (Rows::from(self.needs().await?), self.blobs().clone(), Arc::clone(self.named()));
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

/// Ends the noting, however the collection ends.
struct Noting(Arc<Named>);

impl Drop for Noting {
    fn drop(&mut self) {
        self.0.end();
    }
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

impl From<Needs> for Rows {
    fn from(needs: Needs) -> Self {
        let forgotten: BTreeSet<&TaskId> = needs.done_shards.iter().collect();
        let stays = |root: &&Root| root.shard.as_ref().is_none_or(|task| !forgotten.contains(task));
        let roots = needs.roots.iter().filter(stays).map(|root| (root.digest, root.what.clone())).collect();
        Self { roots, parents: needs.parents, forget_shards: needs.done_shards, live: needs.live }
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
                mentioned(&manifest.meta, &mut queue);
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
