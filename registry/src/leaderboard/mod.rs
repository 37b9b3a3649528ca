//! Comparison of models by the field's metrics: intervals, differences beyond noise, and tables in the papers' column
//! order.
//!
//! A metric `fid` may come with `fid.lower` and `fid.upper`, the 95 % interval of its mean over repeats. Or it comes
//! with `fid_sd`, the standard deviation over repeats; the interval is then 1.96 sd (wider than the mean's). A stage's
//! name in front (`eval_4.fid`) separates metrics of several evaluations of one model; each such stage has its own row.
//!
//! Published rows are the papers' numbers, on the full test splits with the published evaluators. They show the target
//! of a result and are only comparable with numbers of that evaluator on that split.

mod column;
mod compare;
mod measures;
mod print;
mod published;
mod row;
mod table;

pub use column::{Better, FORMATS};
pub use compare::{Comparison, Difference, Verdict, compare};
pub(crate) use measures::{in_brief, in_order, measured};
pub use print::Style;
pub(crate) use print::in_words;
pub use row::{Measure, Row};
pub use table::{Evaluation, Leaderboard, evaluations, leaderboard};

#[cfg(test)]
mod tests;
