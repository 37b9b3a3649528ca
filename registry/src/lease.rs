//! The lease on blobs that several folders can reach: in a bucket, or in a separate folder.
//!
//! The lock in the store's folder does not stop a process with a copy of that folder. So the marker beside the blobs
//! also names the process that holds them, and that process renews its entry, each time by compare-and-set.
//!
//! | the marker is | a process that opens the store |
//! |---|---|
//! | free | takes it |
//! | held by a process whose lock this process now has | takes it: that process has ended |
//! | held, and renewed while it watches | is refused, with the holder's name |
//! | held, and not renewed for the length of the lease | takes it |
//!
//! No two clocks are compared. The opening process measures the time without a change; the holder measures the time
//! since the start of its newest successful renewal. The holder relies on its lease for less time than the other
//! process waits. A process without the lease names no artifact and removes no blob.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use checkpoint::BlobError;

use crate::blob::Backend;
use crate::identity::{Held, Marker, MarkerError};
use crate::lock::Holder;
use crate::store_id::StoreId;

/// Durations of a lease.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LeaseTerms {
    /// Interval of renewals.
    pub renewed: Duration,
    /// Time after the start of a renewal for which the holder relies on the lease.
    pub relied_on: Duration,
    /// Time without a renewal after which a waiting process takes the lease. Longer, so that a removal on its way to
    /// the server has ended.
    pub waited_for: Duration,
}

impl Default for LeaseTerms {
    fn default() -> Self {
        let [renewed, relied_on, waited_for] = [3, 15, 30].map(Duration::from_secs);
        Self { renewed, relied_on, waited_for }
    }
}

/// Interval at which a waiting process reads the marker.
const LOOK: Duration = Duration::from_millis(200);
/// Time limit of the release when a process ends.
const RELEASE: Duration = Duration::from_secs(3);

/// Reason why a lease is not valid.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NoLease {
    /// The lease was not renewed in time; a later renewal may succeed.
    #[error("the lease on the blobs has expired: `{place}` could not be written for {} s; it is renewed as soon as possible", since.as_secs())]
    RunOut { place: String, since: Duration },
    /// Another process holds the blobs.
    #[error(
        "{by} holds the blobs now (`{place}`); stop one of the two and continue with the store that has the newer work"
    )]
    Taken { place: String, by: String },
}

/// Names the lock that a process has on the folder `dir`. The name is unique across machines.
pub(crate) fn lock_of(dir: &Path) -> io::Result<String> {
    let metadata = fs::metadata(dir)?;
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_else(|_| "no boot id".to_owned());
    Ok(format!("{} {} {}", boot.trim(), metadata.dev(), metadata.ino()))
}

/// Returns this process's entry for the marker.
pub(crate) fn held(dir: &Path, holder: &Holder) -> io::Result<Held> {
    let host = nix::unistd::gethostname().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let by = format!("{holder} on `{host}` for store `{}`", dir.display());
    Ok(Held { by, lock: lock_of(dir)?, opening: StoreId::random()?.to_string(), renewals: 0 })
}

/// Waits until the blobs at `place` are free. Returns the holder's name if it keeps renewing its entry.
pub(crate) fn wait_until_free(
    place: &dyn Backend,
    own_lock: &str,
    terms: LeaseTerms,
) -> Result<Result<(), String>, MarkerError> {
    let begun = Instant::now();
    let first = Marker::read(place)?.and_then(|marker| marker.held);
    let Some(first) = first.filter(|held| held.lock != own_lock) else { return Ok(Ok(())) };
    tracing::info!(
        "`{}` names {} as the holder of the blobs; waiting to see if it renews its lease",
        place.marker_place(),
        first.by
    );
    loop {
        // The marker is read once more after the whole time.
        let is_over = begun.elapsed() >= terms.waited_for;
        match Marker::read(place)?.and_then(|marker| marker.held) {
            None => return Ok(Ok(())),
            Some(held) if held != first => return Ok(Err(held.by)),
            Some(_) if is_over => return Ok(Ok(())),
            Some(_) => std::thread::sleep(LOOK.min(terms.waited_for / 4)),
        }
    }
}

/// A lease held by this process, with the thread that renews it. Dropping it releases the blobs.
#[derive(Debug)]
pub(crate) struct Lease {
    state: Arc<State>,
    stop: Option<mpsc::Sender<()>>,
    released: Mutex<mpsc::Receiver<()>>,
}

#[derive(Debug)]
struct State {
    place: Arc<dyn Backend>,
    terms: LeaseTerms,
    now: Mutex<Now>,
}

#[derive(Debug)]
struct Now {
    marker: Marker,
    /// Start of the newest successful renewal.
    renewed: Instant,
    /// Name of the process that has taken the lease.
    taken: Option<String>,
}

impl State {
    fn lock(&self) -> MutexGuard<'_, Now> {
        self.now.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn check(&self) -> Result<(), NoLease> {
        let (now, place) = (self.lock(), || self.place.marker_place());
        if let Some(by) = &now.taken {
            return Err(NoLease::Taken { place: place(), by: by.clone() });
        }
        let since = now.renewed.elapsed();
        if since > self.terms.relied_on { Err(NoLease::RunOut { place: place(), since }) } else { Ok(()) }
    }

    /// Renews the entry in the marker; returns `false` once another process holds the blobs.
    fn renew(&self) -> Result<bool, MarkerError> {
        let old = self.lock().marker.clone();
        let begun = Instant::now();
        let next = Marker { held: old.held.as_ref().map(Held::renewed), ..old.clone() };
        if next.write(Some(&old), &*self.place)? {
            let mut now = self.lock();
            (now.marker, now.renewed) = (next, begun);
            return Ok(true);
        }
        let opening = |marker: &Marker| marker.held.as_ref().map(|held| held.opening.clone());
        match Marker::read(&*self.place)? {
            // An earlier renewal succeeded although its answer was lost.
            Some(marker) if opening(&marker).is_some() && opening(&marker) == opening(&old) => {
                let mut now = self.lock();
                (now.marker, now.renewed) = (marker, begun);
                Ok(true)
            }
            other => {
                let by =
                    other.and_then(|marker| marker.held).map_or_else(|| "another process".to_owned(), |held| held.by);
                tracing::error!("`{}` was taken: {by} holds the blobs now", self.place.marker_place());
                self.lock().taken = Some(by);
                Ok(false)
            }
        }
    }

    fn release(&self) {
        let old = self.lock().marker.clone();
        let free = Marker { held: None, ..old.clone() };
        if let Err(error) = free.write(Some(&old), &*self.place) {
            let marker = self.place.marker_place();
            tracing::warn!(%error, "cannot release `{marker}`; the next process waits until the lease expires");
        }
    }
}

/// Check of the lease. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct LeaseCheck(Arc<State>);

impl LeaseCheck {
    pub(crate) fn check(&self) -> Result<(), NoLease> {
        self.0.check()
    }

    /// Checks the lease before a removal.
    pub(crate) fn may_remove(&self) -> Result<(), BlobError> {
        self.check().map_err(|e| BlobError::Unreachable(format!("nothing was removed: {e}")))
    }
}

impl Lease {
    /// Starts to renew a lease that the `marker` at `place` shows since `since`.
    pub(crate) fn begin(
        place: Arc<dyn Backend>,
        marker: Marker,
        since: Instant,
        terms: LeaseTerms,
    ) -> io::Result<Self> {
        let state = Arc::new(State { place, terms, now: Mutex::new(Now { marker, renewed: since, taken: None }) });
        let ((stop, stopped), (release, released)) = (mpsc::channel(), mpsc::channel());
        let keeper = Arc::clone(&state);
        std::thread::Builder::new().name("blobs-lease".into()).spawn(move || {
            while let Err(RecvTimeoutError::Timeout) = stopped.recv_timeout(terms.renewed) {
                match keeper.renew() {
                    Ok(true) => {}
                    Ok(false) => return,
                    Err(error) => tracing::warn!(%error, "the lease on the blobs was not renewed; trying again"),
                }
            }
            keeper.release();
            // The receiver may have stopped waiting.
            let _ = release.send(());
        })?;
        Ok(Self { state, stop: Some(stop), released: Mutex::new(released) })
    }

    pub(crate) fn checked(&self) -> LeaseCheck {
        LeaseCheck(Arc::clone(&self.state))
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.stop = None;
        // An unresponsive place must not block the end of the process.
        let released = self.released.get_mut().unwrap_or_else(PoisonError::into_inner);
        let _ = released.recv_timeout(RELEASE);
    }
}
