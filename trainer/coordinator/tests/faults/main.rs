//! Panics and pauses at fail points. Fail points belong to a process, so each test sets up an exclusive scenario.

#[path = "../common/shell.rs"]
mod shell;

mod failure;
mod flood;
