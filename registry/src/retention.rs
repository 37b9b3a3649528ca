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
//! what new rows name ([`Proofs`]). Some blobs at a time are condemned, in the writer, and then removed, beside it. A root whose manifest does not
//! read stops the collection, for nobody can say what it needs; so does a database or a folder of blobs that is not the
//! store's own any more.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use checkpoint::BlobError;
use futures::{StreamExt as _, TryStreamExt as _, stream};
use protocol::artifact::mentioned;
use protocol::{Digest, TaskId};
use serde::{Deserialize, Serialize};

use crate::blob::{BlobStore, Entry, ManifestError};
use crate::calls::Calls;
use crate::catalog::{Needs, Root};
use crate::lock::CollectionLock;
use crate::proofs::Proofs;
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
        let rows = Rows::from(self.needs().await?);
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        let (plan, candidates) = plan(&Asked::of(self), &rows, &ages).await?;
        let bytes = candidates.iter().map(|entry| entry.bytes).sum();
        Ok(Plan { remove: candidates.iter().map(|entry| entry.digest).collect(), bytes, ..plan })
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
        let _noting = Noting(Arc::clone(self.proofs()));
        let forgotten = self.begin_collection().await?;
        let rows = Rows::from(self.needs().await?);
        let ages = Ages { now_ms: clock::now_ms(), grace_ms, opened_ms: self.opened_ms(), live: rows.live };
        let place = Asked::of(self);
        let plan = match plan(&place, &rows, &ages).await {
            Ok((plan, candidates)) => self.sweep(&place, &rows, &ages, plan, candidates).await,
            Err(e) => Err(e.into()),
        };
        crate::reserve::keep(self.dir());
        Ok(Plan { forget_shards: forgotten, ..plan? })
    }

    /// Removes what was planned, but what was put again or named since.
    async fn sweep(
        &self,
        place: &Asked,
        rows: &Rows,
        ages: &Ages,
        mut plan: Plan,
        candidates: Vec<Entry>,
    ) -> Result<Plan, WriteError> {
        let mut kept = BTreeSet::new();
        for batch in candidates.chunks(BATCH) {
            // What new rows name has needs of its own.
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

/// Ends the noting, however the collection ends.
struct Noting(Arc<Proofs>);

impl Drop for Noting {
    fn drop(&mut self) {
        self.0.end_collection();
    }
}

/// Blobs that are being removed, however that ends.
struct Condemned(Arc<Proofs>, Vec<Digest>);

impl Drop for Condemned {
    fn drop(&mut self) {
        self.0.removed(&self.1);
    }
}

/// Where the blobs lie, and how it is asked.
pub(crate) struct Asked {
    blobs: BlobStore,
    calls: Calls,
}

impl Asked {
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
#[derive(Debug, Clone, Copy)]
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

/// Manifests that are read, and blobs that are removed, at once.
const AT_ONCE: usize = 16;
/// Blobs that are removed before new rows are looked at again.
const BATCH: usize = 64;

/// Adds all that `queue` needs to `marked`. `is_there` says which digests are blobs.
async fn mark(
    place: &Asked,
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
                    marked.extend(manifest.files.values().map(|file| file.digest));
                    mentioned(&manifest.meta, &mut next);
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
        drop(reading);
        queue = next;
    }
    Ok(())
}

/// The blobs that the rows need, all of them there.
pub(crate) async fn needed(place: &Asked, rows: &Rows) -> Result<BTreeSet<Digest>, QueryError> {
    let check = |(root, why): (&Digest, &String)| {
        let (root, why) = (*root, why.clone());
        let asked = place.ask(move |blobs| blobs.complete_manifest(root));
        async move { asked.await.map(|_| ()).map_err(|e| QueryError::Blob(format!("{why}: {e}"))) }
    };
    stream::iter(&rows.roots).map(check).buffered(AT_ONCE).try_collect::<()>().await?;
    let all = place.list().await?;
    let mut marked = BTreeSet::new();
    mark(place, rows, |digest| all.contains_key(&digest), rows.roots.keys().copied().collect(), &mut marked).await?;
    // What is mentioned need not be there; what roots list is, by now.
    marked.retain(|digest| all.contains_key(digest));
    Ok(marked)
}

/// What stays, and the blobs that may go.
async fn plan(place: &Asked, rows: &Rows, ages: &Ages) -> Result<(Plan, Vec<Entry>), QueryError> {
    let all = place.list().await?;
    let mut marked = BTreeSet::new();
    let is_there = |digest| all.contains_key(&digest);
    mark(place, rows, is_there, rows.roots.keys().copied().collect(), &mut marked).await?;
    // Nobody relies yet on what no row names: if it is damaged, that stops nothing.
    let is_damaged = |blobs: &BlobStore, digest: &Digest| {
        matches!(blobs.manifest(*digest), Err(ManifestError::Blob(BlobError::Corrupt { .. })))
    };
    let held = move |blobs: &BlobStore| blobs.held().into_iter().partition(|digest| is_damaged(blobs, digest));
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
