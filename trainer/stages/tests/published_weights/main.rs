//! Published weights through `import.model`: checkpoints of the fixtures (`01_*`, `02_control_*`, `04_*` to `06_*`, `07_mdm*`) against the outputs that
//! these store, the same files out again, and what is refused.

#[path = "../../../models/tests/common/mod.rs"]
mod fixtures;

mod evaluator;
mod exports;
mod latent;
mod motion;
mod refused;
mod tokens;
mod world;
