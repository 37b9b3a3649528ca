//! Broken and hostile files for every parser of other people's files.
//!
//! A [`Target`] is a parser with files that it reads. [`mutate`] makes others of these, from a key alone; [`fuzz`] runs a target on them for a time and holds it to
//! three rules: no panic, no more than [`MEMORY`] bytes and [`MEMORY_FACTOR`] times the input's length at a time, no more than [`CPU_S`] seconds of a
//! processor. `tests/fuzz.rs` does so in every `cargo test`, and `fuzz/` at the root has the same functions for `cargo fuzz`.
//!
//! Not its job: that what is read is right; each parser's own tests say so.

pub mod canary;
pub mod fuzz;
pub mod mutate;
pub mod named;
pub mod scratch;
pub mod seeds;
pub mod targets;

/// Bytes that a parser may allocate whatever its input, together with what it reads into.
pub const MEMORY: usize = 64 << 20;
/// Bytes that it may allocate besides for each byte of input.
pub const MEMORY_FACTOR: usize = 16;
/// Seconds of a processor that an input may take.
pub const CPU_S: f64 = 2.0;

/// A parser, and what to try it with.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// Its name: of the test, of the fuzz target and of the folder in `fuzz/corpus`.
    pub name: &'static str,
    /// Reads the bytes and uses what they gave; whether they were accepted.
    pub run: fn(&[u8]) -> bool,
    /// Small files, most of which are accepted.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Files that were made to do harm: all are refused.
    pub named: fn() -> Vec<named::Named>,
    /// What stands in such files, to be put where it does not belong; `¦` between them.
    pub words: &'static str,
    /// Bytes in the place of [`MEMORY`].
    pub memory: usize,
}

impl Target {
    /// A target within [`MEMORY`].
    pub const fn new(name: &'static str, run: fn(&[u8]) -> bool, seeds: fn() -> Vec<Vec<u8>>) -> Self {
        Self { name, run, seeds, named: named::none, words: "", memory: MEMORY }
    }

    /// With files that were made to do harm.
    #[must_use]
    pub const fn named(self, named: fn() -> Vec<named::Named>) -> Self {
        Self { named, ..self }
    }

    /// With what stands in its files.
    #[must_use]
    pub const fn words(self, words: &'static str) -> Self {
        Self { words, ..self }
    }

    /// Within so many bytes.
    #[must_use]
    pub const fn within(self, memory: usize) -> Self {
        Self { memory, ..self }
    }
}
