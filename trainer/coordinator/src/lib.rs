//! Who works on what, and whose results count.
//!
//! The crate has two halves. The pure one ([`decide`], [`observe`], [`batch`], [`state`], [`fact`], [`journal`]) is a function of state, time
//! and event, whose result are facts; it is tested under virtual time in microseconds. The thin one (the shell) is the HTTP server, the clock and the
//! runner of effects. The store is the fence: nothing here is trusted to notice in time that a worker lost its lease,
//! because every write carries a fence that the transaction checks.
//!
//! Not its job: what a stage computes, what a blob holds, how gang members talk to each other.

pub mod batch;
pub mod decide;
pub mod event;
pub mod fact;
pub mod failpoints;
pub mod invariants;
pub mod journal;
pub mod observe;
mod outcome;
pub mod policy;
mod reconcile;
pub mod register;
mod rejected;
mod schedule;
pub mod search;
pub mod shell;
pub mod state;
mod sweep;
mod time;
pub mod value;
mod view;

pub use batch::Refused;
pub use decide::decide;
pub use event::{Effect, Event, Observation};
pub use fact::Fact;
pub use observe::observe;
pub use outcome::refused_for_good;
pub use policy::{GrantOrder, Policy};
pub use rejected::Rejected;
pub use shell::{
    Allowances, Config, Connections, Coordinator, Door, Handle, Records, RecordsError, StartError, Trouble,
    resolve_versions,
};
pub use state::State;
pub use state::run::Control;
pub use time::{Millis, Moment};
pub use view::WorkerView;
