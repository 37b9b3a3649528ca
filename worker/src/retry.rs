//! Retries calls for as long as the grant holds. A coordinator that restarts or whose disk is full is waited for
//! without a limit.

use std::time::{Duration, Instant};

use crate::active_assignment::ActiveAssignment;
use crate::client::{CallError, Credential};

/// Reason why a call under a grant was given up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum GaveUp {
    /// The grant has ended.
    Ended(String),
    /// The answer is final.
    Answer(CallError),
}

/// Consecutive answers "internal error" after which the error is final.
const FAULTS: u32 = 8;

/// Longest pause between two tries.
const LONGEST: Duration = Duration::from_secs(1);

/// Time to try a call that may also be made later.
const PATIENCE: Duration = Duration::from_secs(2);

/// Calls until success, a final refusal or the end of the grant. `call` gets the newest grant each time.
pub(crate) fn until_ended<T>(
    held: &ActiveAssignment,
    what: &str,
    call: impl FnMut(&Credential) -> Result<T, CallError>,
) -> Result<T, GaveUp> {
    until(held, what, |_| false, call)
}

/// Like [`until_ended`], and gives up a call that fails once `is_over`.
pub(crate) fn until_over<T>(
    held: &ActiveAssignment,
    what: &str,
    is_over: impl Fn() -> bool,
    call: impl FnMut(&Credential) -> Result<T, CallError>,
) -> Result<T, GaveUp> {
    until(held, what, |_| is_over(), call)
}

/// Like [`until_ended`], for a part of a checkpoint. If the checkpoint may be saved later, a part that cannot be stored
/// now is put off.
pub(crate) fn until_put_off<T>(
    held: &ActiveAssignment,
    what: &str,
    call: impl FnMut(&Credential) -> Result<T, CallError>,
) -> Result<T, GaveUp> {
    let done = until(held, what, |tried| tried >= PATIENCE && held.may_put_off(), call);
    held.was_put_off(matches!(&done, Err(GaveUp::Answer(error)) if error.may_pass()));
    done
}

fn until<T>(
    held: &ActiveAssignment,
    what: &str,
    is_put_off: impl Fn(Duration) -> bool,
    mut call: impl FnMut(&Credential) -> Result<T, CallError>,
) -> Result<T, GaveUp> {
    let begun = Instant::now();
    let mut warned = begun;
    let mut pause = Duration::from_millis(50);
    let mut faults = 0;
    loop {
        if let Some(reason) = held.ended() {
            return Err(GaveUp::Ended(reason));
        }
        let credential = held.credential();
        match call(&credential) {
            Ok(done) => {
                if warned != begun {
                    tracing::info!("{what}: succeeded after {:.0} s", begun.elapsed().as_secs_f64());
                }
                return Ok(done);
            }
            Err(CallError::Stale(message)) => {
                tracing::debug!(task = %credential.grant.task, "{what}: {message}");
                held.after_stale(&credential).map_err(GaveUp::Ended)?;
            }
            Err(CallError::Fault(message)) if faults == FAULTS => {
                return Err(GaveUp::Answer(CallError::Fault(message)));
            }
            Err(error) if error.may_pass() && is_put_off(begun.elapsed()) => return Err(GaveUp::Answer(error)),
            Err(error) if error.may_pass() => {
                faults += u32::from(matches!(error, CallError::Fault(_)));
                if warned == begun || warned.elapsed() > Duration::from_secs(10) {
                    tracing::warn!("{what}: {error}; trying again");
                    warned = Instant::now();
                }
                let asked = if let CallError::Busy(_, after) = error { after } else { Duration::ZERO };
                held.pause(pause.max(asked)).map_err(GaveUp::Ended)?;
                pause = (pause * 2).min(LONGEST);
            }
            Err(error) => return Err(GaveUp::Answer(error)),
        }
    }
}
