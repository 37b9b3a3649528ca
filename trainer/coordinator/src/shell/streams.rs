//! Counts of open streams of events.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use protocol::limits;

use super::failure::Failure;

/// Open streams by token.
#[derive(Debug, Default)]
pub(crate) struct Streams(Mutex<HashMap<String, usize>>);

impl Streams {
    pub(super) fn enter(&self, name: &str) -> Result<(), Failure> {
        let mut open = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let all = open.values().sum::<usize>();
        let own = open.get(name).copied().unwrap_or_default();
        let full = |whose: &str, most| Failure::busy(format!("{most} streams of events of {whose} are open"));
        if own >= limits::STREAMS_OF_TOKEN {
            let failure = full(&format!("the token of `{name}`"), limits::STREAMS_OF_TOKEN);
            return Err(failure.hint("close one, or share one among the pages of a browser"));
        }
        if all >= limits::STREAMS {
            return Err(full("this server", limits::STREAMS));
        }
        open.insert(name.to_owned(), own + 1);
        Ok(())
    }

    pub(super) fn leave(&self, name: &str) {
        let mut open = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(own) = open.get_mut(name) {
            *own -= 1;
            if *own == 0 {
                open.remove(name);
            }
        }
    }
}
