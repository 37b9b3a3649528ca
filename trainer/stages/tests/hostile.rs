//! The importer of evaluators on changed files, for a time, and on files that were made to do harm; see `hostile::fuzz` for the rules and for what to do with what is found.

use std::alloc::System;
use std::path::Path;

use cap::Cap;
use hostile::named::Named;
use hostile::targets::PICKLE_MEMORY;
use hostile::{Target, fuzz, named, seeds};
use models::flat;
use models::flat::layout;
use models::names::to_bytes;
use models::networks::{Evaluator, EvaluatorConfig, Init};
use protocol::Seed;
use protocol::stage::Positions;

#[global_allocator]
static MEMORY: Cap<System> = Cap::new(System, usize::MAX);

const PARTS: [&str; 3] = ["text_encoder", "motion_encoder", "movement_encoder"];

/// A file behind the byte that says which of two it is.
fn marked(mark: u8, bytes: Vec<u8>) -> Vec<u8> {
    [vec![mark], bytes].concat()
}

fn evaluators() -> Vec<Vec<u8>> {
    let config = EvaluatorConfig {
        features: 259,
        movement_hidden: 2,
        movement: 3,
        motion_hidden: 2,
        word: 300,
        classes: 15,
        text_hidden: 2,
        embedding: 4,
    };
    let device = burn::tensor::Device::flex();
    let network = Evaluator::new(&config, &mut Init::new(Seed(0), "small", Positions::Uniform, &device));
    vec![
        marked(0, seeds::torch_archive(&PARTS)),
        marked(0, seeds::torch_legacy(&PARTS)),
        marked(1, to_bytes(&layout(&network), &flat::read(&network))),
    ]
}

fn hostile_evaluators() -> Vec<Named> {
    let torch = named::torch().into_iter().map(|(what, bytes)| (what, marked(0, bytes)));
    torch.chain(named::safetensors().into_iter().map(|(what, bytes)| (what, marked(1, bytes)))).collect()
}

fn vocabularies() -> Vec<Vec<u8>> {
    vec![seeds::pickled_rows(&[("sos", 0), ("eos", 1), ("unk", 2), ("walk", 3)])]
}

const TARGETS: [Target; 2] = [
    Target::new("evaluator", stages::testing::hostile::evaluator, evaluators)
        .named(hostile_evaluators)
        .within(PICKLE_MEMORY)
        .words("text_encoder¦movement_encoder.main.0.weight¦\"shape\":[¦\"data_offsets\":[¦cposix\nsystem\n¦h\0¦2¦(¦t¦R¦}¦]¦b¦Q¦."),
    Target::new("vocabulary", stages::testing::hostile::vocabulary, vocabularies)
        .named(named::torch)
        .within(PICKLE_MEMORY)
        .words("X\u{3}\0\0\0sos¦K\u{1}¦h\0¦q\0¦2¦(¦t¦}¦]¦s¦u¦.¦cposix\nsystem\n¦I-1\n¦L99999999999999999999L\n"),
];

fn run(name: &str) {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    fuzz::run(name, &TARGETS, &MEMORY, &corpus, Path::new(env!("CARGO_TARGET_TMPDIR")));
}

#[test]
fn evaluator() {
    run("evaluator");
}

#[test]
fn vocabulary() {
    run("vocabulary");
}

#[test]
fn what_was_made_to_do_harm_is_refused_and_not_run() {
    for target in TARGETS {
        for (what, bytes) in (target.named)() {
            assert!(!(target.run)(&bytes), "{}: {what}: it was accepted", target.name);
        }
        let accepted = (target.seeds)().iter().filter(|bytes| (target.run)(bytes)).count();
        assert!(accepted > 0, "{}: no seed is accepted", target.name);
    }
    assert!(!hostile::scratch::folder().join("ran").exists(), "a pickle was run");
}
