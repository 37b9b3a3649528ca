//! The stage kinds: artifacts in, artifacts out, training in between.
//!
//! Not its job: leases, databases, HTTP. A stage's only access to the world is [`context`].

pub mod artifacts;
pub mod context;
pub mod control;
pub mod estimate;
pub mod evaluation;
pub mod evaluator;
pub mod external;
mod feedback;
pub mod flow_decoder;
pub mod generate;
pub mod generator;
pub mod hint;
pub mod kinds;
pub mod length;
pub mod motion_networks;
pub mod networks;
pub mod parts;
pub mod published;
mod refine;
mod solo;
pub mod steering;
pub mod stream;
pub mod testing;
pub mod text;
pub mod timing;
pub mod tokenizer;
pub mod train;
pub mod verify;
mod warm_start;
pub mod weights;
pub mod words;
