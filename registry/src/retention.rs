//! Garbage collection: marks from roots, then removes unmarked blobs that are old enough.
//!
//! Roots with a row are every version (and thus every alias), every stage result, every checkpoint that was not pruned,
//! every shard of a run that may need it, and every pin. Further roots are uploads of held tasks ([`Store::hold`]) and
//! blobs about to be named ([`BlobStore::held`]). From a root the mark follows the manifest's files, the digests in its
//! `meta`, and the lineage.
//!
//! A blob within its grace period is never collected, because the row that names it may follow. While a run is under
//! way, blobs from before the store was opened have at least the usual grace period.
//!
//! Writes continue meanwhile. Marking reads one moment of the database; from just before it the writer records the
//! names in new rows (`proofs`). Blobs are condemned in batches in the writer and then removed beside it. A root with
//! an unreadable manifest stops the collection, because its references are unknown. So does a database or blob folder
//! that no longer belongs to the store.
//!
//! In a bucket, a collection also ends the uploads in parts that killed processes left.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use checkpoint::BlobError;
use futures::{StreamExt as _, TryStreamExt as _, stream};
use protocol::artifact::mentioned;
use protocol::{Digest, TaskId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blob::{BlobStore, Entry, ManifestError};
use crate::calls::Calls;
use crate::catalog::{Needs, Root};
use crate::lock::CollectionLock;
use crate::proofs::Proofs;
use crate::{QueryError, ReadStore, Store, WriteError, clock};

/// Grace period of a fresh blob: longer than any upload waits for its row.
pub const GRACE_MS: i64 = 60 * 60 * 1000;

/// Blobs that a collection removes, or would remove.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Plan {
    /// Unneeded blobs by digest.
    pub remove: Vec<Digest>,
    /// Total bytes of these blobs.
    pub bytes: u64,
    /// Number of unneeded blobs within their grace period.
    pub fresh: u64,
    /// Number of blobs that are needed.
    pub kept: u64,
    /// Deleted shards of finished runs, by task.
    pub forget_shards: Vec<TaskId>,
    /// Number of uploads in parts that ended processes left in a bucket.
    #[serde(default)]
    pub uploads: u64,
}

impl ReadStore {
    /// Returns the plan that [`Store::gc`] would carry out.
    pub async fn gc_plan(&self, grace_ms: i64) -> Result<Plan, QueryError> {
        let rows = Rows::of(self).await?;
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        let (plan, candidates) = plan(&BlobCalls::of(self), &rows, &ages).await?;
        let bytes = candidates.iter().map(|entry| entry.bytes).sum();
        let unfinished = BlobCalls::of(self).ask(BlobStore::unfinished).await;
        let uploads = unfinished.map_err(|e| QueryError::Blob(e.to_string()))?.len() as u64;
        let remove = candidates.iter().map(|entry| entry.digest).collect();
        Ok(Plan { remove, bytes, uploads, ..plan })
    }
}

impl Store {
    /// Removes unneeded blobs whose last put is more than `grace_ms` ago, and returns them. Writes continue meanwhile.
    /// A killed collection has removed only unneeded blobs; the next one removes the rest.
    pub async fn gc(&self, grace_ms: i64) -> Result<Plan, WriteError> {
        let lock = CollectionLock::collect(self.dir()).await;
        let _alone = lock.map_err(|e| WriteError::Storage(format!("nothing was collected: no lock: {e}")))?;
        self.check_identity().await.map_err(|why| WriteError::Storage(format!("nothing was collected: {why}")))?;
        crate::reserve::release_if_full(self.dir());
        let _recording = NameRecording(Arc::clone(self.proofs()));
        let forgotten = self.begin_collection().await?;
        let rows = Rows::of(self).await?;
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        let place = BlobCalls::of(self);
        let plan = match plan(&place, &rows, &ages).await {
            Ok((plan, candidates)) => self.sweep(&place, &rows, &ages, plan, candidates).await,
            Err(e) => Err(e.into()),
        };
        crate::reserve::keep(self.dir());
        let plan = plan?;
        let uploads = place.ask(BlobStore::give_up_unfinished).await;
        let uploads = uploads.map_err(|e| WriteError::Storage(e.to_string()))?;
        Ok(Plan { forget_shards: forgotten, uploads, ..plan })
    }

    /// Removes the planned blobs, except blobs that were put again or named since.
    async fn sweep(
        &self,
        place: &BlobCalls,
        rows: &Rows,
        ages: &Ages,
        mut plan: Plan,
        candidates: Vec<Entry>,
    ) -> Result<Plan, WriteError> {
        let mut kept = BTreeSet::new();
        for batch in candidates.chunks(BATCH) {
            // Follows the references of names in new rows.
            mark(place, rows, |_| true, self.proofs().to_follow(), &mut kept).await?;
            let batch = batch.iter().map(|entry| entry.digest).filter(|digest| !kept.contains(digest));
            let condemned = Condemned(Arc::clone(self.proofs()), self.condemn(batch.collect()).await?);
            let removing = stream::iter(condemned.1.clone()).map(|digest| {
                let ages = *ages;
                let is_young = move |put_ms| put_ms >= ages.before_ms(put_ms);
                place.ask(move |blobs| blobs.remove_unless(digest, is_young))
            });
            let removed = removing.buffer_unordered(AT_ONCE).try_collect::<Vec<Option<Entry>>>().await;
            drop(condemned);
            for entry in removed.map_err(|e| WriteError::Storage(e.to_string()))?.into_iter().flatten() {
                plan.remove.push(entry.digest);
                plan.bytes += entry.bytes;
            }
        }
        plan.remove.sort();
        Ok(plan)
    }
}

/// Ends the recording when the collection ends or fails.
struct NameRecording(Arc<Proofs>);

impl Drop for NameRecording {
    fn drop(&mut self) {
        self.0.end_collection();
    }
}

/// Ends the removal of blobs when it succeeds or fails.
struct Condemned(Arc<Proofs>, Vec<Digest>);

impl Drop for Condemned {
    fn drop(&mut self) {
        self.0.removed(&self.1);
    }
}

/// The blobs' backend, with its limit of calls.
pub(crate) struct BlobCalls {
    blobs: BlobStore,
    calls: Calls,
}

impl BlobCalls {
    pub(crate) fn of(store: &ReadStore) -> Self {
        Self { blobs: store.blobs().clone(), calls: store.calls().clone() }
    }

    async fn ask<T: Send + 'static>(&self, call: impl FnOnce(&BlobStore) -> T + Send + 'static) -> T {
        let blobs = self.blobs.clone();
        self.calls.run(move || call(&blobs)).await
    }

    async fn list(&self) -> Result<BTreeMap<Digest, Entry>, QueryError> {
        self.ask(BlobStore::list).await.map_err(|e| QueryError::Blob(e.to_string()))
    }
}

/// Roots and lineage for a collection, as of one moment.
pub(crate) struct Rows {
    roots: BTreeMap<Digest, String>,
    /// Artifacts that each artifact was made from.
    parents: HashMap<Digest, Vec<Digest>>,
    /// Tasks whose shards are deleted.
    forget_shards: Vec<TaskId>,
    /// Blobs that held tasks have stored.
    held: BTreeSet<Digest>,
    /// True while a run is under way.
    live: bool,
}

impl Rows {
    async fn of(store: &ReadStore) -> Result<Self, QueryError> {
        let needs = store.needs().await?;
        let held = store.held().await?.into_values().flatten().collect();
        Ok(Self { held, ..Self::from(needs) })
    }
}

impl From<Needs> for Rows {
    fn from(needs: Needs) -> Self {
        let forgotten: BTreeSet<&TaskId> = needs.done_shards.iter().collect();
        let stays = |root: &&Root| root.shard.as_ref().is_none_or(|task| !forgotten.contains(task));
        let roots = needs.roots.iter().filter(stays).map(|root| (root.digest, root.what.clone())).collect();
        let parents = needs.parents;
        let forget_shards = needs.done_shards;
        let live = needs.live;
        Self { roots, parents, forget_shards, held: BTreeSet::new(), live }
    }
}

/// Ages from which blobs may be collected.
#[derive(Debug, Clone, Copy)]
struct Ages {
    now_ms: i64,
    grace_ms: i64,
    /// Time at which this process opened the store.
    opened_ms: i64,
    /// True while a run is under way.
    live: bool,
}

impl Ages {
    /// Returns the time before which a blob with put time `put_ms` may be collected.
    fn before_ms(&self, put_ms: i64) -> i64 {
        let unknown = self.live && put_ms < self.opened_ms;
        let grace_ms = if unknown { self.grace_ms.max(GRACE_MS) } else { self.grace_ms };
        self.now_ms.saturating_sub(grace_ms)
    }
}

/// Number of concurrent reads of manifests and removals of blobs.
const AT_ONCE: usize = 16;
/// Number of blobs removed before new rows are checked again.
const BATCH: usize = 64;

/// Adds everything reachable from `queue` to `marked`. `is_there` returns true for digests of stored blobs.
async fn mark(
    place: &BlobCalls,
    rows: &Rows,
    is_there: impl Fn(Digest) -> bool,
    mut queue: Vec<Digest>,
    marked: &mut BTreeSet<Digest>,
) -> Result<(), QueryError> {
    while !queue.is_empty() {
        queue.retain(|digest| marked.insert(*digest) && (rows.roots.contains_key(digest) || is_there(*digest)));
        let parents = queue.iter().filter_map(|digest| rows.parents.get(digest)).flatten().copied();
        let mut next: Vec<Digest> = parents.collect();
        let read = |digest: Digest| place.ask(move |blobs| (digest, blobs.manifest(digest)));
        let mut reading = stream::iter(queue).map(read).buffer_unordered(AT_ONCE);
        while let Some((digest, read)) = reading.next().await {
            match (read, rows.roots.get(&digest)) {
                (Ok(manifest), _) => {
                    marked.extend(manifest.blobs().map(|blob| blob.digest));
                    mentioned(&manifest.meta, &mut next);
                }
                // A digest in `meta` that is not a manifest, or a blob removed since the listing.
                (Err(ManifestError::NotAManifest { .. } | ManifestError::Blob(BlobError::NotFound(_))), None) => {}
                (Err(e), why) => {
                    let why = why.map_or_else(|| format!("artifact {digest}"), Clone::clone);
                    return Err(QueryError::Blob(format!(
                        "nothing was collected: cannot read the references of {why}: {e}"
                    )));
                }
            }
        }
        drop(reading);
        queue = next;
    }
    Ok(())
}

/// Returns the blobs that the rows need, after checking that they exist.
pub(crate) async fn needed(place: &BlobCalls, rows: &Rows) -> Result<BTreeSet<Digest>, QueryError> {
    let check = |(root, why): (&Digest, &String)| {
        let root = *root;
        let why = why.clone();
        let checked = place.ask(move |blobs| blobs.complete_manifest(root));
        async move { checked.await.map(|_| ()).map_err(|e| QueryError::Blob(format!("{why}: {e}"))) }
    };
    stream::iter(&rows.roots).map(check).buffered(AT_ONCE).try_collect::<()>().await?;
    let all = place.list().await?;
    let mut marked = BTreeSet::new();
    mark(place, rows, |digest| all.contains_key(&digest), rows.roots.keys().copied().collect(), &mut marked).await?;
    // A digest in `meta` need not be a stored blob; blobs that roots list were checked above.
    marked.retain(|digest| all.contains_key(digest));
    Ok(marked)
}

fn is_damaged_manifest(blobs: &BlobStore, digest: Digest) -> bool {
    matches!(blobs.manifest(digest), Err(ManifestError::Blob(BlobError::Corrupt { .. })))
}

/// Returns the plan and the blobs that may be removed.
async fn plan(place: &BlobCalls, rows: &Rows, ages: &Ages) -> Result<(Plan, Vec<Entry>), QueryError> {
    let all = place.list().await?;
    let mut marked = BTreeSet::new();
    let is_there = |digest| all.contains_key(&digest);
    mark(place, rows, is_there, rows.roots.keys().copied().collect(), &mut marked).await?;
    // No row relies on these blobs yet, so a damaged one does not stop the collection.
    let of_rows = rows.held.clone();
    let held = move |blobs: &BlobStore| {
        let held: BTreeSet<Digest> = blobs.held().into_iter().chain(of_rows).collect();
        held.into_iter().partition(|digest| is_damaged_manifest(blobs, *digest))
    };
    let (damaged, held): (Vec<Digest>, Vec<Digest>) = place.ask(held).await;
    mark(place, rows, is_there, held, &mut marked).await?;
    marked.extend(damaged);
    let mut plan = Plan { forget_shards: rows.forget_shards.clone(), ..Plan::default() };
    let mut candidates = Vec::new();
    for entry in all.into_values() {
        if marked.contains(&entry.digest) {
            plan.kept += 1;
        } else if entry.put_ms >= ages.before_ms(entry.put_ms) {
            plan.fresh += 1;
        } else {
            candidates.push(entry);
        }
    }
    Ok((plan, candidates))
}
