//! The page: its files, sessions of browsers, and what a browser shows of runs whose every text is hostile.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic, and prints what it measured")]

mod files;
mod http;
mod in_browser;
mod sessions;
#[path = "../common/shell.rs"]
#[allow(dead_code, reason = "shared with other tests")]
mod shell;
