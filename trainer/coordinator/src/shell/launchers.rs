//! The launcher that starts workers, of several with the same labels.
//!
//! It leads for as long as it calls, and for one lease after that. The table is in memory only: after a restart of the
//! server, the first to call leads.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use protocol::stage::Backend;
use protocol::{Labels, limits};

use super::failure::Failure;
use crate::time::Millis;

/// The leading launcher of each kind of worker, and the time until which it leads.
#[derive(Debug, Default)]
pub(crate) struct Launchers(Mutex<BTreeMap<(Backend, Labels), (String, Millis)>>);

impl Launchers {
    /// Lets `launcher` lead until `until`, unless another one leads at `now`. Returns true if it leads.
    pub(super) fn lead(
        &self,
        kind: &(Backend, Labels),
        launcher: &str,
        now: Millis,
        until: Millis,
    ) -> Result<bool, Failure> {
        let mut leaders = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        leaders.retain(|_, (_, until)| *until > now);
        match leaders.get(kind) {
            Some((leader, _)) if leader != launcher => return Ok(false),
            None if leaders.len() >= limits::LAUNCHERS => {
                return Err(Failure::busy(format!("{} launchers already call", limits::LAUNCHERS)));
            }
            Some(_) | None => {}
        }
        leaders.insert(kind.clone(), (launcher.to_owned(), until));
        Ok(true)
    }
}
