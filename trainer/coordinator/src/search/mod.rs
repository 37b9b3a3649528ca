//! The searcher of a sweep, which chooses the next trials: a pure fold over results.
//!
//! Work is issued as numbered tickets, each for one rung of one trial. Results arrive in any order but are folded in
//! the order of tickets. Ticket `n` is a function of the results of tickets `0..=n - parallel` only. The decisions are
//! therefore a function of the sweep and the seed. The number of workers, their speed and their restarts change no trial,
//! no rung and no result. The cost: a slow ticket delays the `parallel` tickets after it.
//!
//! | question | answer |
//! |---|---|
//! | points to try, and their order | `grid`, `random`: fixed in advance, all different |
//! | trial to advance to the next rung | `asha` |
//! | best trial | the best result of the last rung; in a tie, the lower trial number |
//!
//! A trial that failed or has a non-finite metric counts as the worst result.

mod asha;
mod grid;
mod random;
mod score;
mod searcher;
mod ticket;

pub use self::score::Score;
pub use self::searcher::Search;
pub use self::ticket::{Progress, Ticket};

#[cfg(test)]
mod tests;
