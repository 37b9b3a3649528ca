//! The registry's commands. The `registry` binary, `trainer registry` and the server's `POST /v1/registry` all call
//! [`run`].
//!
//! [`Command`] and [`Answer`] are plain data, so that a client can send a command and print its answer. A command never
//! contains a path of the machine that runs it: for `export` the client downloads and writes the files itself.
//! [`EXIT_CODES`] lists the exit codes of the process.

mod answer;
mod args;
mod bundles;
mod client;
mod command;
mod export;
mod print;
mod ranking;
mod run;
mod show;

pub use answer::{Answer, Data, EXIT_CODES};
pub use args::{Output, OutputArg, Verb};
pub use bundles::import;
pub use client::{ask, execute};
pub use command::Command;
pub use print::{render, show_error};
pub use run::{read, run};
pub use show::MOST_BASES;
