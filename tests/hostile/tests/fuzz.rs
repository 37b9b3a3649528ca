//! Fuzzes every parser of untrusted files for a limited time; see [`hostile::fuzz`] for the rules and for reproducing a
//! failure.
//!
//! `STRIDE_FUZZ_SECONDS` sets the time per target, `STRIDE_FUZZ_SEED` draws other inputs, `STRIDE_FUZZ_INPUT` runs a
//! file.

use std::alloc::System;
use std::path::Path;

use cap::Cap;
use hostile::fuzz;
use hostile::targets::TARGETS;

#[global_allocator]
static MEMORY: Cap<System> = Cap::new(System, usize::MAX);

fn run(name: &str) {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    fuzz::run(name, &TARGETS, &MEMORY, &corpus, Path::new(env!("CARGO_TARGET_TMPDIR")));
}

macro_rules! targets {
    ($($name:ident)*) => {
        $(#[test]
        fn $name() {
            run(stringify!($name));
        })*

        #[test]
        fn every_target_is_tried() {
            assert_eq!(TARGETS.map(|target| target.name), [$(stringify!($name)),*]);
        }
    };
}

targets!(bvh joint_map npy npz captions texts sentences pipeline waypoints safetensors tokenizer encoder torch bvh_out glb html);
