//! Starts and ends workers by demand, on the engine that people have: Slurm, Kubernetes, machines with ssh, or this one.
//!
//! A launcher is a stateless client of `GET /v1/demand`. The coordinator's lease is the truth: a worker that polls is
//! alive, even if the engine reports its job as lost. The engine's list is a hint, and only shows jobs on their way. A restarted
//! launcher finds its jobs by the beginning of their names. [`fleet`] decides, and [`mod@follow`] performs it.
//!
//! The coordinator places tasks on workers. No engine restarts a job: the launcher submits a new one.

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
