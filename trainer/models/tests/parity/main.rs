//! Networks, losses, one distillation step and the samplers against the published PyTorch modules.
//!
//! The fixtures drive the tests: every folder with a known prefix, every case that its arrays name, with sizes from its
//! `config.json`. `06_sjpe` holds a metric, which the crate `stages` checks. Gates are those of the fixtures' README,
//! for CPU.

mod codebooks;
#[path = "../common/mod.rs"]
mod common;
mod control;
mod denoiser;
mod discord;
mod distillation;
mod evaluator;
mod free_t2m;
mod gpt;
mod length;
mod mmm;
mod momask;
mod networks;
mod pcm_step;
mod raw_diffusion;
mod samplers;
mod schedules;
mod text;
mod tokenizer;
mod vae;

/// Gate of one forward pass.
const FORWARD: f64 = 3e-6;
/// Gate of scalar losses, relative.
const LOSS: f64 = 1e-5;

#[test]
fn parity_says_what_it_skips() {
    let Some(root) = common::shared("parity") else { return };
    let covered = ["01_", "02_", "03_distill", "03_sampler", "04_evaluator", "05_", "06_", "07_", "08_pcm", "11_"];
    let skipped: Vec<String> = std::fs::read_dir(root)
        .expect("fixtures can be listed")
        .map(|entry| entry.expect("fixtures can be listed").path())
        .filter(|path| path.is_dir())
        .map(|path| common::name(&path))
        .filter(|name| !covered.iter().any(|prefix| name.starts_with(prefix)))
        .collect();
    fixtures::skip(&format!("networks that are not here: {}", skipped.join(" ")));
    for group in ["02_", "03_", "04_", "05_", "06_", "07_", "11_"] {
        assert!(!skipped.iter().any(|name| name.starts_with(group)), "every {group}* fixture has a test");
    }
}
