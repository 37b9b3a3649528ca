//! Assigns work to workers and decides which results count.
//!
//! The crate has two halves. The pure half ([`decide`], [`observe`], [`batch`], [`state`], [`fact`], [`journal`]) maps
//! state, time and event to facts; tests run it under virtual time in microseconds. The shell is the thin half: HTTP
//! server, clock and execution of effects. The store is the fence: every write carries a fence that its transaction
//! checks. Correctness therefore never depends on noticing a lost lease in time.
//!
//! Computation of stages, contents of blobs and communication within gangs are elsewhere.

pub mod batch;
pub mod decide;
mod demand;
pub mod event;
pub mod fact;
pub mod failpoints;
mod history;
pub mod invariants;
pub mod journal;
mod note;
pub mod observe;
pub mod policy;
pub mod register;
mod rejected;
pub mod search;
pub mod shell;
pub mod state;
mod time;
pub mod value;
mod view;
mod waiting;

pub use batch::Refused;
pub use decide::decide;
pub use decide::outcome::refused_for_good;
pub use event::{Effect, Event, Observation};
pub use fact::Fact;
pub use observe::observe;
pub use policy::{GrantOrder, Policy};
pub use rejected::Rejected;
pub use shell::{
    Allowances, Config, Connections, Coordinator, Handle, Records, RecordsError, RouteServer, StartError, Trouble,
    resolve_versions,
};
pub use state::State;
pub use state::run::Control;
pub use time::{Millis, Moment};
pub use view::WorkerView;
