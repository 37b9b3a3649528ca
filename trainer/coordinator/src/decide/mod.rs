//! Turns (state, moment, event) into facts and effects. No other code decides.
//!
//! Nothing here reads a clock, a socket or a generator. A decision is a list of facts; `Deciding::record` is the only
//! way to change the state, and keeps each fact. The facts are stored in one transaction with the rows that they imply,
//! before any other effect. Recovery applies them without deciding again. A decision has these steps:
//!
//! 1. Apply the event itself.
//! 2. Reconcile every run that it touched: stages whose work is over, stages whose inputs are available.
//! 3. Ask workers on unwanted work to drain.
//! 4. Assign ready work to idle workers.
//! 5. Move ended runs and unused executions from memory to the tables.
//!
//! A decision inspects only the objects that its facts touch, so its cost does not grow with the number of past runs.
//!
//! `steps` defines their order. Each topic has a file of its own in this folder, and all of them build on `deciding`.

pub(crate) mod attempts;
pub(crate) mod deciding;
pub(crate) mod executions;
mod forget;
mod gangs;
mod mending;
mod moves;
pub(crate) mod outcome;
mod reconcile;
mod runs;
pub(crate) mod schedule;
pub(crate) mod shares;
mod start;
mod steps;
pub(crate) mod sweep;
mod workers;

pub use self::steps::decide;
