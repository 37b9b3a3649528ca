//! Broken and hostile files for every parser of untrusted files.
//!
//! A [`Target`] is a parser with sample files. [`mutate`] derives other files from these by a key. [`fuzz`] runs a
//! target on them for a limited time and checks three rules:
//! - no panic;
//! - at most [`MEMORY`] bytes plus [`MEMORY_FACTOR`] times the input's length at a time;
//! - at most [`CPU_S`] seconds of CPU time.
//!
//! `tests/fuzz.rs` does this in every `cargo test`, and `fuzz/` at the root runs the same functions with `cargo fuzz`.
//!
//! Not its job: the correctness of parsed values, which each parser's own tests check.

pub mod canary;
pub mod fuzz;
pub mod mutate;
pub mod named;
pub mod scratch;
pub mod seeds;
pub mod targets;

/// Bytes that a parser may allocate for any input, including its buffers.
pub const MEMORY: usize = 64 << 20;
/// Further bytes that it may allocate per byte of input.
pub const MEMORY_FACTOR: usize = 16;
/// CPU seconds that an input may take.
pub const CPU_S: f64 = 2.0;

/// A parser with the inputs to try.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Name of the test, of the fuzz target and of the folder in `fuzz/corpus`.
    pub name: &'static str,
    /// Parses the bytes and uses the result. Returns true if they were accepted.
    pub run: fn(&[u8]) -> bool,
    /// Small files; most of them are accepted.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Hostile files; all of them are refused.
    pub named: fn() -> Vec<named::Named>,
    /// Words of such files, to be inserted at wrong places; separated by `¦`.
    pub words: &'static str,
    /// Limit of allocated bytes that replaces [`MEMORY`].
    pub memory: usize,
}

impl Target {
    /// Creates a target with the limit [`MEMORY`].
    pub const fn new(name: &'static str, run: fn(&[u8]) -> bool, seeds: fn() -> Vec<Vec<u8>>) -> Self {
        Self { name, run, seeds, named: named::none, words: "", memory: MEMORY }
    }

    /// Adds hostile files.
    #[must_use]
    pub const fn named(self, named: fn() -> Vec<named::Named>) -> Self {
        Self { named, ..self }
    }

    /// Adds words of its files.
    #[must_use]
    pub const fn words(self, words: &'static str) -> Self {
        Self { words, ..self }
    }

    /// Sets the limit of allocated bytes.
    #[must_use]
    pub const fn within(self, memory: usize) -> Self {
        Self { memory, ..self }
    }
}
