//! The lease on blobs that other folders can reach too: in a bucket, or in a folder of their own.
//!
//! The lock in the store's folder keeps out no process that has a copy of that folder. So the marker beside the blobs also says which
//! process holds them, and that process renews what it says there, each time by a compare-and-set.
//!
//! | the marker is | a process that opens the store |
//! |---|---|
//! | held by nobody | takes it |
//! | held by a process that had the lock which is now its own | takes it: that process is over |
//! | held, and is renewed while it watches | is refused, with the holder's name |
//! | held, and is not renewed for the length of the lease | takes it |
//!
//! No two clocks are compared: the one who opens measures for how long nothing changes, and the holder for how long ago it began the
//! newest renewal that was done. The holder relies on its lease for less time than the other one waits. Without it no row names an
//! artifact and no blob is removed.

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

/// How long things take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LeaseTerms {
    /// How often it is renewed.
    pub renewed: Duration,
    /// For how long after a renewal began the holder relies on it.
    pub relied_on: Duration,
    /// For how long one who waits must see no renewal. Longer by all that a removal may take on its way to the server.
    pub waited_for: Duration,
}

impl Default for LeaseTerms {
    fn default() -> Self {
        let [renewed, relied_on, waited_for] = [3, 15, 30].map(Duration::from_secs);
        Self { renewed, relied_on, waited_for }
    }
}

/// How often one who waits looks.
const LOOK: Duration = Duration::from_millis(200);
/// How long the end of a process waits until nobody holds the blobs any more.
const RELEASE: Duration = Duration::from_secs(3);

/// Why there is no lease.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NoLease {
    /// It was not renewed in time. It may be again.
    #[error("the lease on the blobs has run out, for `{place}` could not be written to for {} s; it is renewed as soon as it can be", since.as_secs())]
    RunOut { place: String, since: Duration },
    /// Another process holds the blobs.
    #[error(
        "{by} holds the blobs now, by `{place}`; stop one of the two, and go on with the store that has the newer work"
    )]
    Taken { place: String, by: String },
}

/// The lock that a process has with the folder `dir`: no two processes of all machines have it at once.
pub(crate) fn lock_of(dir: &Path) -> io::Result<String> {
    let metadata = fs::metadata(dir)?;
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_else(|_| "no boot id".to_owned());
    Ok(format!("{} {} {}", boot.trim(), metadata.dev(), metadata.ino()))
}

/// What the marker says of a process that takes it now.
pub(crate) fn held(dir: &Path, holder: &Holder) -> io::Result<Held> {
    let host = nix::unistd::gethostname().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let by = format!("{holder} on `{host}` for store `{}`", dir.display());
    Ok(Held { by, lock: lock_of(dir)?, opening: StoreId::random()?.to_string(), renewals: 0 })
}

/// Waits until nobody else holds the blobs at `place`; gives the holder's name if somebody does and goes on doing so.
pub(crate) fn wait_until_free(
    place: &dyn Backend,
    own_lock: &str,
    terms: LeaseTerms,
) -> Result<Result<(), String>, MarkerError> {
    let begun = Instant::now();
    let first = Marker::read(place)?.and_then(|marker| marker.held);
    let Some(first) = first.filter(|held| held.lock != own_lock) else { return Ok(Ok(())) };
    tracing::info!("`{}` says that {} holds the blobs; looking whether it still does", place.marker_place(), first.by);
    loop {
        // Looked at once more after the whole time.
        let is_over = begun.elapsed() >= terms.waited_for;
        match Marker::read(place)?.and_then(|marker| marker.held) {
            None => return Ok(Ok(())),
            Some(held) if held != first => return Ok(Err(held.by)),
            Some(_) if is_over => return Ok(Ok(())),
            Some(_) => std::thread::sleep(LOOK.min(terms.waited_for / 4)),
        }
    }
}

/// A lease that a process holds, and the thread that renews it. Nobody holds the blobs once this is dropped.
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
    /// When the newest renewal that was done began.
    renewed: Instant,
    /// Who has taken it.
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

    /// Says beside the blobs that this process still holds them; `false` once another one does.
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
            // An answer that did not come was to a renewal that was done.
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
            tracing::warn!(%error, "`{marker}` still says that this process holds the blobs; the next one waits for a while");
        }
    }
}

/// Whether a process still holds the blobs. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct LeaseCheck(Arc<State>);

impl LeaseCheck {
    pub(crate) fn check(&self) -> Result<(), NoLease> {
        self.0.check()
    }

    /// The same, for a removal.
    pub(crate) fn may_remove(&self) -> Result<(), BlobError> {
        self.check().map_err(|e| BlobError::Unreachable(format!("nothing was removed: {e}")))
    }
}

impl Lease {
    /// Renews a lease that the `marker` at `place` gives since `since`.
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
            // The one who waits for it may have given up.
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
        // A place that does not answer keeps no process from its end.
        let released = self.released.get_mut().unwrap_or_else(PoisonError::into_inner);
        let _ = released.recv_timeout(RELEASE);
    }
}
