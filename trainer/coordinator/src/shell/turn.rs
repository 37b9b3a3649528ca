//! Turns of calls that read much of the tables.

use protocol::limits;
use tokio::sync::SemaphorePermit;

use super::actor_handle::ActorHandle;
use super::failure::Failure;

/// A turn among the questions that read much: few at a time, or they would fill memory and take the threads from heartbeats.
pub(super) async fn turn(actor_handle: &ActorHandle) -> Result<(SemaphorePermit<'_>, SemaphorePermit<'_>), Failure> {
    let most = limits::READS_WAITING;
    let full = |_| Failure::busy(format!("{most} calls for lists and curves already wait"));
    let waiting = actor_handle.readers.try_acquire().map_err(full)?;
    // The semaphore is never closed.
    let closed = |_| Failure::busy("the server is stopping".to_owned());
    Ok((waiting, actor_handle.reads.acquire().await.map_err(closed)?))
}
