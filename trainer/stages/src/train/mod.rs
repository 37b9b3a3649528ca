//! The only training loop. A training kind supplies an [`Objective`] (batch to gradients) and receives the trained
//! state.
//!
//! Not its job: defining a loss, finding examples, choosing the other members.
//!
//! The non-obvious idea: training changes only a few flat f32 buffers and a step number ([`TrainState`]). A step reads
//! them and applies one sum over all slices of the step. Nothing else survives from step to step. So a checkpoint, a
//! peer's copy and a fresh start are the same thing at different steps.
//!
//! A [`Group`] is parameters with an optimizer. Its [`Turns`] select the steps that train it, so phases, alternating
//! updates and frozen parts are plans, not loops. [`Buffers`] are values that no optimizer changes;
//! [`Objective::after`] changes them from sums over the slices.
//!
//! With replicas, a member computes several updates of whole replicas before an exchange, whose sum is of states instead
//! of gradients (`replicas`). The rest of the loop is the same.

mod buffers;
pub(crate) mod consistency;
pub(crate) mod data;
pub(crate) mod feature_diffusion;
pub(crate) mod frequency;
mod group;
mod losses;
pub(crate) mod network;
mod objective;
mod order;
mod outcome;
mod replicas;
mod save;
mod start;
mod state;
mod step;
mod training_loop;
mod values;

pub use buffers::{AfterStep, BufferPlan, Buffers, SumPlan};
pub use group::{Average, Clip, Group, GroupPlan, Turns};
pub use losses::Losses;
pub use objective::{Objective, SliceResult};
pub use order::{Order, Pick};
pub use outcome::Trained;
pub(crate) use save::STATE_FILE;
pub use state::{RestoreError, TrainState};
pub use training_loop::train;
