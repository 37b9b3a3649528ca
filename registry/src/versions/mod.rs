//! Models, their versions, and the aliases that point at them.
//!
//! The transaction that registers a version numbers it: 1, 2, 3, without gaps. `promote` and `rollback` move an alias
//! in one transaction that compares, checks the gates on stored metrics, moves and logs. `@best` is a query over stored
//! metrics and never stored itself.

mod alias;
mod gate;
mod model;
mod rules;

use std::fmt;

pub use alias::{Action, Expect, Promotion};
pub use gate::{Gate, GateResult, ParseGateError};
pub use model::{Model, Version};
pub use protocol::model_ref::{BEST, LATEST, ModelRef, Pick};
pub(crate) use rules::{compare, evaluate, gates, pick, previous, refuse_reserved, summary, unknown};

impl fmt::Display for Expect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Version(version) => write!(f, "{version}"),
        }
    }
}
