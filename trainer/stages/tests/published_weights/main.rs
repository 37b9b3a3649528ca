//! Published weights through `import.model`: checkpoints of the fixtures (`01_*`, `02_control_*`, `04_*` to `06_*`,
//! `07_mdm*`) against their stored outputs, the same files exported again, and refused files.

#[path = "../../../models/tests/common/mod.rs"]
mod fixtures;

mod evaluator;
mod exports;
mod latent;
mod motion;
mod refused;
mod tokens;
mod world;
