//! Starts and ends workers by demand, on the engine that people have: Slurm, Kubernetes, machines with ssh, or this one.
//!
//! A launcher is a stateless client of `GET /v1/demand`. The coordinator's lease is the truth: a worker that polls is
//! alive, whatever the engine reports. The engine's list is a hint, and only shows jobs on their way. A restarted
//! launcher finds its jobs by the beginning of their names. [`fleet`] decides, and [`follow`] performs it.
//!
//! Placement of tasks on workers is the coordinator's work. Restarting a job is no engine's: a new job is submitted.

pub mod cli;
pub mod command;
pub mod engine;
pub mod fleet;
pub mod follow;
pub mod hosts;
pub mod kubernetes;
pub mod slurm;
pub mod worker_command;

pub use engine::{EngineError, Job, JobState, Launcher};
pub use fleet::{Action, Fleet, Observation, Plan};
pub use follow::{FollowError, follow};
