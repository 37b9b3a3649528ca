//! The server over real sockets.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic, and prints what it measured")]

#[path = "../simulation/pipelines.rs"]
mod pipelines;
#[path = "../common/shell.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod shell;

mod access;
mod crowd;
mod demand;
mod errors;
mod events;
mod exposition;
mod front;
mod http;
mod http2;
mod limits;
mod openapi;
mod owners;
mod page;
mod tls;
mod webhooks;
mod workers;
