//! Prefetches the inputs of tasks that this worker may get, so that a gang does not wait for the downloads of a new
//! member.
//!
//! The coordinator names the tasks ([`Prepare`]). A separate thread fetches their inputs into the cache and verifies
//! them, and the next poll reports the tasks that are ready. A task that is no longer named is forgotten at once, even
//! during a download.
//!
//! A task is ready only once every member of its gang answers here. So a gang does not stop for a joiner that cannot
//! reach it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use checkpoint::BlobError;
use protocol::artifact::Chunk;
use protocol::message::{Member, Prepare};
use protocol::{Digest, Manifest, TaskId, WorkerId};
use tokio::sync::{Notify, watch};

use crate::cache::{Arriving, Cache, Cached};
use crate::client::{CallError, Client};
use crate::event_count::lock;
use crate::gang::endpoint::Endpoint;
use crate::gang::handshake::HandshakeError;

/// Pause between two tries to fetch a blob.
const PAUSE: Duration = Duration::from_secs(1);
/// Consecutive tries after which a missing blob counts as lost.
const MISSED: u32 = 5;

/// Tasks to prefetch, and tasks that are ready. The poll sets the first and reads the second.
#[derive(Debug)]
pub(crate) struct Preparation {
    /// `None` once the worker leaves.
    wanted: watch::Sender<Option<Vec<Prepare>>>,
    /// Tasks that are ready, with the digests of all their inputs.
    ready: Mutex<Vec<(Prepare, Vec<Digest>)>>,
    endpoint: Arc<Endpoint>,
    /// Wakes the poll, which reports the ready tasks.
    wake: Arc<Notify>,
}

/// Reason why a task is not prepared.
#[derive(Debug, thiserror::Error)]
enum Stopped {
    #[error("the assignment to prepare has changed")]
    News,
    #[error(transparent)]
    Call(#[from] CallError),
    #[error("cannot store it: {0}")]
    Local(#[from] std::io::Error),
    #[error(transparent)]
    Blob(#[from] BlobError),
    #[error("blob {0} arrived damaged")]
    Damaged(Digest),
    #[error("cannot parse the manifest {0}: {1}")]
    Manifest(Digest, serde_json::Error),
    #[error("its member `{0}` does not answer at {1}: {2}")]
    Peer(WorkerId, String, HandshakeError),
}

type News = watch::Receiver<Option<Vec<Prepare>>>;

impl Preparation {
    pub(crate) fn new(endpoint: Arc<Endpoint>, wake: Arc<Notify>) -> Self {
        Self { wanted: watch::Sender::new(Some(Vec::new())), ready: Mutex::default(), endpoint, wake }
    }

    /// Sets the tasks to prepare; forgets ready tasks that are not among them.
    pub(crate) fn want(&self, tasks: &[Prepare]) {
        lock(&self.ready).retain(|(ready, _)| tasks.contains(ready));
        self.wanted.send_if_modified(|wanted| match wanted {
            Some(wanted) if *wanted != tasks => {
                *wanted = tasks.to_vec();
                true
            }
            Some(_) | None => false,
        });
    }

    /// Ends prefetching for good.
    pub(crate) fn end(&self) {
        lock(&self.ready).clear();
        self.wanted.send_replace(None);
    }

    /// Tasks whose inputs are in the cache.
    pub(crate) fn ready(&self) -> Vec<TaskId> {
        lock(&self.ready).iter().map(|(ready, _)| ready.task.clone()).collect()
    }

    /// Fetches the wanted inputs until [`end`](Self::end). The body of a thread.
    pub(crate) fn run(&self, client: &Client, cache: &Cache) {
        let mut news = self.wanted.subscribe();
        let mut missed: BTreeMap<TaskId, u32> = BTreeMap::new();
        loop {
            let Some(wanted) = news.borrow_and_update().clone() else { return };
            missed.retain(|task, _| wanted.iter().any(|wanted| wanted.task == *task));
            let missing = wanted.into_iter().filter(|task| !lock(&self.ready).iter().any(|(ready, _)| ready == task));
            let missing: Vec<Prepare> = missing.collect();
            if missing.is_empty() {
                // `changed` cannot fail, because we hold the sender.
                let _ = client.wait(news.changed());
                continue;
            }
            // A task that cannot be prepared yet does not delay the others.
            let mut is_later = false;
            for task in missing {
                let misses = missed.entry(task.task.clone()).or_default();
                match self.prepare(&task, misses, client, cache, &mut news) {
                    Ok(all) => self.is_ready(task, all, cache, &news),
                    Err(Stopped::News) => break,
                    Err(error) => {
                        tracing::debug!(task = %task.task, "cannot prepare the task yet: {error}");
                        is_later = true;
                    }
                }
            }
            if is_later {
                let _ = client.wait(async { tokio::time::timeout(PAUSE, news.changed()).await });
            }
        }
    }

    /// Fetches the inputs of a task and checks that its members answer. Returns the digests of the inputs.
    fn prepare(
        &self,
        task: &Prepare,
        missed: &mut u32,
        client: &Client,
        cache: &Cache,
        news: &mut News,
    ) -> Result<Vec<Digest>, Stopped> {
        // Trials of a sweep read the same inputs.
        let has_all = |ready: &Prepare| (&ready.inputs, ready.resume) == (&task.inputs, task.resume);
        let known = lock(&self.ready).iter().find(|(ready, _)| has_all(ready)).map(|(_, all)| all.clone());
        let prepared = match known.map_or_else(|| prepare(task, client, cache, news), Ok) {
            // The attempt that reads the blob reports the damage; prefetching cannot.
            Err(Stopped::Call(CallError::Damaged(why))) => {
                tracing::warn!(task = %task.task, "cannot prefetch all inputs: {why}");
                Ok(Vec::new())
            }
            Err(Stopped::Call(CallError::NotFound(why))) if *missed >= MISSED => {
                tracing::warn!(task = %task.task, "cannot prefetch all inputs: {why}");
                Ok(Vec::new())
            }
            prepared => prepared,
        };
        *missed = if matches!(prepared, Err(Stopped::Call(CallError::NotFound(_)))) { *missed + 1 } else { 0 };
        let all = prepared?;
        for Member { worker, peer_address, .. } in &task.peers {
            let answers = self.endpoint.probe(peer_address);
            answers.map_err(|error| Stopped::Peer(worker.clone(), peer_address.clone(), error))?;
        }
        Ok(all)
    }

    fn is_ready(&self, task: Prepare, all: Vec<Digest>, cache: &Cache, news: &News) {
        tracing::info!(task = %task.task, "its inputs are cached");
        // If the task is no longer wanted, its blobs are merely cached.
        if news.borrow().as_ref().is_some_and(|wanted| wanted.contains(&task)) {
            let mut ready = lock(&self.ready);
            ready.push((task, all));
            // Blobs kept for earlier tasks have been read by now.
            let wanted: Vec<Digest> = ready.iter().flat_map(|(_, all)| all).copied().collect();
            cache.forget_ahead(&wanted);
            drop(ready);
            self.wake.notify_one();
        }
    }
}

/// Fetches the manifests that `task` names and the files that they list. Returns all their digests.
fn prepare(task: &Prepare, client: &Client, cache: &Cache, news: &mut News) -> Result<Vec<Digest>, Stopped> {
    let mut all = Vec::new();
    for digest in task.inputs.values().copied().chain(task.resume) {
        let bytes = fetch(digest, client, cache, news)?.into_memory()?;
        let manifest: Manifest = serde_json::from_slice(&bytes).map_err(|e| Stopped::Manifest(digest, e))?;
        all.push(digest);
        for Chunk { digest, .. } in manifest.blobs() {
            let blob = fetch(digest, client, cache, news)?;
            cache.keep_ahead(digest, &blob);
            all.push(digest);
        }
    }
    Ok(all)
}

/// Returns a blob from the cache, after fetching it if necessary. Continues an interrupted transfer as long as each try
/// brings more bytes.
fn fetch(digest: Digest, client: &Client, cache: &Cache, news: &mut News) -> Result<Cached, Stopped> {
    if let Some(blob) = cache.get(digest) {
        return Ok(blob);
    }
    let mut arriving: Option<Arriving> = None;
    loop {
        let before = arriving.as_ref().map(Arriving::written);
        match go_on(digest, &mut arriving, client, cache, news) {
            Err(Stopped::Call(CallError::Away(_))) if arriving.as_ref().map(Arriving::written) > before => {}
            done => break done?,
        }
    }
    let Some(arrived) = arriving else { return Err(Stopped::Damaged(digest)) };
    arrived.finish(cache)?.map_err(|_| Stopped::Damaged(digest))
}

fn go_on(
    digest: Digest,
    arriving: &mut Option<Arriving>,
    client: &Client,
    cache: &Cache,
    news: &mut News,
) -> Result<(), Stopped> {
    let offset = arriving.as_ref().map_or(0, Arriving::written);
    let mut download = unless_news(client, news, client.get_blob(digest, offset, false))?;
    let arriving = match arriving {
        Some(arriving) => arriving,
        None => arriving.insert(cache.arriving(digest, download.length())?),
    };
    while let Some(bytes) = unless_news(client, news, download.next())? {
        arriving.write(&bytes)?;
    }
    Ok(())
}

/// Waits for a call, unless the wanted tasks change. Dropping a download ends it.
fn unless_news<T>(
    client: &Client,
    news: &mut News,
    call: impl Future<Output = Result<T, CallError>>,
) -> Result<T, Stopped> {
    client.wait(async {
        tokio::select! {
            _ = news.changed() => Err(Stopped::News),
            done = call => Ok(done?),
        }
    })
}
