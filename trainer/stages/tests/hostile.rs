//! The importers of evaluators and of published models on mutated files, for a limited time, and on crafted hostile
//! files. The rules, and the use of findings, are in `hostile::fuzz`.

use std::alloc::System;
use std::path::Path;

use cap::Cap;
use hostile::named::Named;
use hostile::targets::PICKLE_MEMORY;
use hostile::{Target, canary, fuzz, named, seeds};
use models::flat;
use models::flat::layout;
use models::names::to_bytes;
use models::networks::{Evaluator, EvaluatorConfig, Init};
use protocol::Seed;
use protocol::stage::Positions;
use stage_lab::hostile_models::{self, Form, PARTS};

#[global_allocator]
static MEMORY: Cap<System> = Cap::new(System, usize::MAX);

const NETWORKS: [&str; 3] = ["text_encoder", "motion_encoder", "movement_encoder"];

/// A file after the byte that selects its kind.
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
        marked(0, seeds::torch_archive(&NETWORKS)),
        marked(0, seeds::torch_legacy(&NETWORKS)),
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

/// For each part a file in each form, and the torch file also in the form before archives.
fn models() -> Vec<Vec<u8>> {
    let all = PARTS.into_iter().flat_map(|part| {
        let small = hostile_models::small(part);
        [Form::Torch, Form::Safetensors, Form::List].map(|form| hostile_models::marked(part, form, &small))
    });
    all.chain([at(0, Form::Torch, &seeds::torch_legacy(&["state_dict"]))]).collect()
}

/// A file after the bytes that select its part and form.
fn at(part: usize, form: Form, bytes: &[u8]) -> Vec<u8> {
    [&[part as u8, form as u8], bytes].concat()
}

/// A part's list with a changed line.
fn changed(part: usize, change: &dyn Fn(&mut Vec<String>)) -> Vec<u8> {
    let list = hostile_models::marked(PARTS[part], Form::List, &hostile_models::small(PARTS[part]));
    let mut lines: Vec<String> = String::from_utf8_lossy(&list[2..]).lines().map(str::to_owned).collect();
    change(&mut lines);
    at(part, Form::List, lines.join("\n").as_bytes())
}

/// Published weights that execute code, declare wrong sizes, or fit no network.
fn hostile_networks() -> Vec<Named> {
    let mut all = Vec::new();
    let torch = named::torch().into_iter().map(|(what, bytes)| (what, at(0, Form::Torch, &bytes)));
    all.extend(torch);
    all.extend(named::safetensors().into_iter().map(|(what, bytes)| (what, at(1, Form::Safetensors, &bytes))));
    // A frame after that many tokens has no position.
    all.push((
        "a latent of 249 tokens",
        changed(0, &|lines| {
            let token = lines.iter_mut().find(|line| line.contains("global_motion_token")).expect("it has tokens");
            *token = token.replace(" 2 ", " 498 ");
        }),
    ));
    for part in 0..PARTS.len() {
        let each = |change: &dyn Fn(&str) -> String| {
            changed(part, &|lines| lines.iter_mut().for_each(|line| *line = change(line)))
        };
        // The first line is a tensor that the network requires.
        let first = |element: &str, shape: &str| {
            changed(part, &|lines| {
                let name = lines[0].split(' ').nth(1).expect("a name").to_owned();
                lines[0] = format!("{element} {name} {shape}");
            })
        };
        all.extend([
            ("nothing at all", at(part, Form::List, b"")),
            ("a tensor that is missing", changed(part, &|lines| _ = lines.remove(0))),
            ("a tensor of no number", first("F32", "0")),
            ("a tensor of 2^60 numbers", first("F32", "1152921504606846976")),
            ("more numbers than can be counted", first("F32", "4294967295 4294967295 4294967295")),
            ("an axis of 2^60 beside one of 0", first("F32", "1152921504606846976 0")),
            ("ten thousand axes", first("F32", &"1 ".repeat(10_000))),
            ("a tensor of integers", first("I64", "4")),
            ("tensors of no floats", each(&|line| line.replace("F32", "BOOL"))),
            ("all tensors of one number", each(&|line| line.split(' ').take(2).collect::<Vec<_>>().join(" "))),
            (
                "all axes turned round",
                each(&|line| {
                    let words: Vec<&str> = line.split(' ').collect();
                    let shape: Vec<&str> = words[2..].iter().rev().copied().collect();
                    format!("F32 {} {}", words[1], shape.join(" "))
                }),
            ),
            (
                "sixty thousand tensors",
                changed(part, &|lines| {
                    lines.extend((0..60_000).map(|i| format!("F32 other.{i} 1")));
                }),
            ),
            (
                "blocks without end",
                changed(part, &|lines| {
                    let more: Vec<String> = lines
                        .iter()
                        .filter(|line| line.contains(".0."))
                        .flat_map(|line| (1..400).map(move |i| line.replacen(".0.", &format!(".{i}."), 1)))
                        .collect();
                    lines.extend(more);
                    lines.remove(0);
                }),
            ),
        ]);
    }
    all
}

const TARGETS: [Target; 3] = [
    Target::new("model", hostile_models::model, models)
        .named(hostile_networks)
        .within(PICKLE_MEMORY)
        .words("F32 ¦F64 ¦BF16 ¦I64 ¦BOOL ¦ 0 ¦ 1¦\nF32 ¦.weight¦.bias¦.0.¦.1.¦state_dict.¦vae.¦denoiser.¦trans.¦model.¦latent_pre.weight ¦latent_proj.weight ¦time_embedding.cond_proj.weight ¦output_proj_bias ¦net.mid_attn.fn.fn.to_qkv.weight ¦.attn.mask ¦h\0¦R¦."),
    Target::new("evaluator", stage_lab::hostile::evaluator, evaluators)
        .named(hostile_evaluators)
        .within(PICKLE_MEMORY)
        .words("text_encoder¦movement_encoder.main.0.weight¦\"shape\":[¦\"data_offsets\":[¦cposix\nsystem\n¦h\0¦2¦(¦t¦R¦}¦]¦b¦Q¦."),
    Target::new("vocabulary", stage_lab::hostile::vocabulary, vocabularies)
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
fn model() {
    run("model");
}

#[test]
fn vocabulary() {
    run("vocabulary");
}

#[test]
fn no_error_quotes_a_file() {
    assert_eq!(stage_lab::hostile::CANARY, canary::CANARY);
    TARGETS.iter().for_each(|target| canary::run(target, 30));
}

/// A part whose files are all refused would not be tested.
#[test]
fn every_part_is_imported_in_every_form() {
    for part in PARTS {
        for form in [Form::Torch, Form::Safetensors, Form::List] {
            let bytes = hostile_models::marked(part, form, &hostile_models::small(part));
            assert!(hostile_models::model(&bytes), "{}, {form:?}", part.name());
        }
    }
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
