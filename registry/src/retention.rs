//! Garbage collection: marks from roots, then removes unmarked blobs that are old enough.
//!
//! Roots with a row are every version (and thus every alias), every stage result, every checkpoint that was not pruned,
//! every shard of a run that may need it, and every pin. Further roots are uploads of held tasks ([`Store::hold`]) and
//! blobs about to be named ([`BlobStore::held`]). From a root the mark follows the manifest's files, the digests in its
//! `meta`, and the lineage. The catalog has the references of most artifacts; other manifests are read.
//!
//! A blob within its grace period is never collected, because the row that names it may follow. While a run is under
//! way, blobs from before the store was opened have at least the usual grace period.
//!
//! Writes continue meanwhile. Marking reads one moment of the database; from just before it the writer records the
//! names in new rows (`proofs`). Blobs are condemned in batches in the writer and then removed beside it. A root
//! whose references are not in the catalog and whose manifest cannot be read stops the collection. So does a database or
//! blob folder that no longer belongs to the store.
//!
//! In a bucket, a collection also ends the uploads in parts that killed processes left.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use checkpoint::BlobError;
use futures::{StreamExt as _, TryStreamExt as _, stream};
use protocol::{Digest, TaskId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blob::{BlobStore, Entry, ManifestError};
use crate::catalog::{Needs, References};
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
        let planned = plan(self, &rows, &ages).await;
        let (plan, candidates) = self.explained(planned).await?;
        let bytes = candidates.iter().map(|entry| entry.bytes).sum();
        let unfinished = self.ask_blobs(BlobStore::unfinished).await;
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
        let planned = plan(self, &rows, &ages).await;
        let plan = match self.explained(planned).await {
            Ok((plan, candidates)) => self.sweep(&rows, plan, candidates, ages).await,
            Err(e) => Err(e.into()),
        };
        crate::reserve::keep(self.dir());
        let plan = plan?;
        let uploads = self.ask_blobs(BlobStore::give_up_unfinished).await;
        let uploads = uploads.map_err(|e| WriteError::Storage(e.to_string()))?;
        Ok(Plan { forget_shards: forgotten, uploads, ..plan })
    }

    /// Removes the planned blobs, except blobs that were put again or named since.
    async fn sweep(&self, rows: &Rows, mut plan: Plan, candidates: Vec<Entry>, ages: Ages) -> Result<Plan, WriteError> {
        let mut kept = Marks::default();
        for batch in candidates.chunks(BATCH) {
            // Follows the references of names in new rows.
            let marked = mark(self, rows, self.proofs().to_follow(), &mut kept).await;
            self.explained(marked).await?;
            let batch = batch.iter().map(|entry| entry.digest).filter(|digest| !kept.has(*digest));
            let condemned = Condemned(Arc::clone(self.proofs()), self.condemn(batch.collect()).await?);
            let removing = stream::iter(condemned.1.clone()).map(|digest| {
                let is_young = move |put_ms| put_ms >= ages.before_ms(put_ms);
                self.ask_blobs(move |blobs| blobs.remove_unless(digest, is_young))
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

/// Roots and lineage for a collection, as of one moment.
pub(crate) struct Rows {
    /// Artifacts that rows name, sorted.
    roots: Vec<Digest>,
    /// Artifacts that each artifact was made from, without roots.
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
        let Needs { roots, parents, done_shards: forget_shards, live } = needs;
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
/// Largest number of manifests that one call reads.
const MANIFESTS: usize = 64;
/// Largest number of artifacts whose references one query reads.
const KNOWN: usize = 1024;
/// Number of blobs removed before new rows are checked again.
const BATCH: usize = 64;

/// Marked blobs. Those of a listing take one bit each.
#[derive(Default)]
struct Marks<'a> {
    /// Stored blobs, sorted by digest; `None` if they were not listed.
    listed: Option<&'a [Entry]>,
    /// For each listed blob, true if it is marked.
    marked: Vec<bool>,
    /// Marked digests that are not listed.
    others: BTreeSet<Digest>,
}

impl<'a> Marks<'a> {
    fn among(listed: &'a [Entry]) -> Self {
        Self { listed: Some(listed), marked: vec![false; listed.len()], others: BTreeSet::new() }
    }

    fn place(&self, digest: Digest) -> Option<usize> {
        self.listed?.binary_search_by_key(&digest, |entry| entry.digest).ok()
    }

    fn has(&self, digest: Digest) -> bool {
        self.place(digest).map_or_else(|| self.others.contains(&digest), |place| self.marked[place])
    }

    /// Marks a digest. Returns false if it was marked before.
    fn add(&mut self, digest: Digest) -> bool {
        match self.place(digest) {
            Some(place) => !std::mem::replace(&mut self.marked[place], true),
            None => self.others.insert(digest),
        }
    }

    /// Returns true if the digest may be a stored blob.
    fn may_be_there(&self, digest: Digest) -> bool {
        self.listed.is_none() || self.place(digest).is_some()
    }
}

/// A reason to collect nothing.
enum MarkError {
    Query(QueryError),
    /// The references of the artifact cannot be read.
    Unreadable {
        artifact: Digest,
        why: String,
    },
}

impl From<QueryError> for MarkError {
    fn from(error: QueryError) -> Self {
        Self::Query(error)
    }
}

impl ReadStore {
    /// Names the row of an artifact whose references cannot be read.
    async fn explained<T>(&self, marked: Result<T, MarkError>) -> Result<T, QueryError> {
        match marked {
            Ok(done) => Ok(done),
            Err(MarkError::Query(e)) => Err(e),
            Err(MarkError::Unreadable { artifact, why }) => {
                let row = self.named_by(artifact).await?;
                Err(QueryError::Blob(format!("nothing was collected: cannot read the references of {row}: {why}")))
            }
        }
    }
}

/// Adds everything reachable from `queue` to `marks`.
async fn mark(store: &ReadStore, rows: &Rows, mut queue: Vec<Digest>, marks: &mut Marks<'_>) -> Result<(), MarkError> {
    let is_root = |digest: Digest| rows.roots.binary_search(&digest).is_ok();
    while !queue.is_empty() {
        queue.retain(|digest| marks.add(*digest) && (is_root(*digest) || marks.may_be_there(*digest)));
        let parents = queue.iter().filter_map(|digest| rows.parents.get(digest)).flatten().copied();
        let mut next: Vec<Digest> = parents.collect();
        let mut follow = |references: References| {
            for blob in references.blobs {
                marks.add(blob);
            }
            next.extend(references.mentioned);
        };
        let mut unknown = Vec::new();
        for batch in queue.chunks(KNOWN) {
            let mut known: HashMap<Digest, References> = store.references(batch).await?.into_iter().collect();
            for digest in batch {
                match known.remove(digest) {
                    Some(references) => follow(references),
                    None => unknown.push(*digest),
                }
            }
        }
        let each = (unknown.len() / AT_ONCE).clamp(1, MANIFESTS);
        let batches: Vec<Vec<Digest>> = unknown.chunks(each).map(<[Digest]>::to_vec).collect();
        let read = |batch: Vec<Digest>| {
            store.ask_blobs(move |blobs| {
                let read = |digest| (digest, blobs.manifest_of_many(digest).map(|manifest| References::of(&manifest)));
                batch.into_iter().map(read).collect::<Vec<_>>()
            })
        };
        let mut reading = stream::iter(batches).map(read).buffer_unordered(AT_ONCE);
        while let Some(batch) = reading.next().await {
            for (digest, read) in batch {
                match read {
                    Ok(references) => follow(references),
                    // A digest in `meta` that is not a manifest, or a blob removed since the listing.
                    Err(ManifestError::NotAManifest { .. } | ManifestError::Blob(BlobError::NotFound(_)))
                        if !is_root(digest) => {}
                    Err(e) => return Err(MarkError::Unreadable { artifact: digest, why: e.to_string() }),
                }
            }
        }
        drop(reading);
        queue = next;
    }
    Ok(())
}

/// Adds everything reachable from the roots to `marks`.
async fn mark_roots(store: &ReadStore, rows: &Rows, marks: &mut Marks<'_>) -> Result<(), MarkError> {
    for roots in rows.roots.chunks(AT_ONCE * MANIFESTS * 16) {
        mark(store, rows, roots.to_vec(), marks).await?;
    }
    Ok(())
}

/// Returns the blobs that the rows need, after checking that they exist.
pub(crate) async fn needed(store: &ReadStore, rows: &Rows) -> Result<Vec<Digest>, QueryError> {
    let check = |root: &Digest| {
        let root = *root;
        let checked = store.ask_blobs(move |blobs| blobs.complete_manifest(root));
        async move { checked.await.map(|_| ()).map_err(|e| (root, e)) }
    };
    let checked = stream::iter(&rows.roots).map(check).buffered(AT_ONCE).try_collect::<()>().await;
    if let Err((root, e)) = checked {
        return Err(QueryError::Blob(format!("{}: {e}", store.named_by(root).await?)));
    }
    let all = list(store).await?;
    let mut marks = Marks::among(&all);
    let marked = mark_roots(store, rows, &mut marks).await;
    store.explained(marked).await?;
    // A digest in `meta` need not be a stored blob; blobs that roots list were checked above.
    Ok(all.iter().zip(&marks.marked).filter(|(_, is_marked)| **is_marked).map(|(entry, _)| entry.digest).collect())
}

async fn list(store: &ReadStore) -> Result<Vec<Entry>, QueryError> {
    store.ask_blobs(BlobStore::list).await.map_err(|e| QueryError::Blob(e.to_string()))
}

fn is_damaged_manifest(blobs: &BlobStore, digest: Digest) -> bool {
    matches!(blobs.manifest(digest), Err(ManifestError::Blob(BlobError::Corrupt { .. })))
}

/// Returns the plan and the blobs that may be removed.
async fn plan(store: &ReadStore, rows: &Rows, ages: &Ages) -> Result<(Plan, Vec<Entry>), MarkError> {
    let all = list(store).await?;
    let mut marks = Marks::among(&all);
    mark_roots(store, rows, &mut marks).await?;
    // No row relies on these blobs yet, so a damaged one does not stop the collection.
    let of_rows = rows.held.clone();
    let held = move |blobs: &BlobStore| {
        let held: BTreeSet<Digest> = blobs.held().into_iter().chain(of_rows).collect();
        held.into_iter().partition(|digest| is_damaged_manifest(blobs, *digest))
    };
    let (damaged, held): (Vec<Digest>, Vec<Digest>) = store.ask_blobs(held).await;
    mark(store, rows, held, &mut marks).await?;
    for digest in damaged {
        marks.add(digest);
    }
    let mut plan = Plan { forget_shards: rows.forget_shards.clone(), ..Plan::default() };
    let mut candidates = Vec::new();
    for (entry, is_marked) in all.iter().zip(&marks.marked) {
        if *is_marked {
            plan.kept += 1;
        } else if entry.put_ms >= ages.before_ms(entry.put_ms) {
            plan.fresh += 1;
        } else {
            candidates.push(*entry);
        }
    }
    Ok((plan, candidates))
}
