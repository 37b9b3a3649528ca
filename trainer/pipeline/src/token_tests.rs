//! Token stages that do not fit each other are refused before anything runs, at the position of the mistake.

use crate::read;

/// A valid pipeline; cases replace a part of it.
const GOOD: &str = "name: p
dataset: {format: synthetic, clips: 10}
stages:
  kit: {kind: data.open, format: kit, path: kit}
  words: {kind: text.embed, dataset: kit}
  judge: {kind: train.evaluator}
  residual: {kind: train.tokenizer}
  plain: {kind: train.tokenizer, quantizers: 1, codes: 64}
  tokens: {kind: encode.tokens, tokenizer: residual, padded: 196}
  ids: {kind: encode.tokens, tokenizer: plain}
  momask: {kind: train.tokens, generator: masked, tokens: tokens, tokenizer: residual}
  mmm: {kind: train.tokens, generator: mmm, tokens: ids, tokenizer: plain}
  flow: {kind: train.discord, tokenizer: residual, window: 64}
  smooth: {kind: model.decoder, model: momask, decoder: flow}
  vae: {kind: train.vae}
  latents: {kind: encode.latents, vae: vae}
  mld: {kind: train.mld}
  latent_flow: {kind: train.discord, vae: vae}
  jumps: {kind: distill.discord, tokenizer: residual, teacher: flow}
  quick: {kind: model.decoder, model: mld, decoder: latent_flow}
  recon: {kind: evaluate.reconstruction, tokenizer: residual, decoder: flow, evaluator: judge}
  t2m: {kind: evaluate.t2m, model: mmm, evaluator: judge, sampler: {steps: 10, guidance: 0}}
  whole: {kind: train.discord, prediction: data, tokenizer: residual}
  again: {kind: train.discord, init: flow, tokenizer: residual}
  faster: {kind: distill.discord, init: jumps, teacher: flow, tokenizer: residual}
";

#[test]
fn what_fits_is_taken_and_only_what_is_read_is_an_input() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    let inputs = |name: &str| -> Vec<String> {
        let stage = pipeline.stages.iter().find(|stage| stage.name.as_str() == name).expect("a stage");
        stage.inputs.iter().map(|input| input.field.clone()).collect()
    };
    assert_eq!(inputs("latent_flow"), ["dataset", "vae"]);
    assert_eq!(inputs("jumps"), ["dataset", "tokenizer", "teacher"]);
    assert_eq!(inputs("momask"), ["tokens", "tokenizer", "text"]);
    assert_eq!(inputs("mmm"), ["tokens", "tokenizer", "text", "dataset"]);
    assert_eq!(inputs("recon"), ["tokenizer", "decoder", "evaluator", "dataset"]);
}

#[test]
fn what_does_not_fit_is_refused_where_it_stands() {
    for (from, to, line, words) in [
        // Tokens of another codebook.
        ("tokens: tokens, tokenizer: residual", "tokens: ids, tokenizer: residual", 11, "was encoded with `plain`"),
        ("tokens: ids, tokenizer: plain", "tokens: tokens, tokenizer: residual", 12, "has 6 codebooks; expected 1"),
        ("model: momask, decoder", "model: mmm, decoder", 14, "`flow` decodes the codes of `residual`"),
        ("tokenizer: residual, decoder: flow", "tokenizer: plain, decoder: flow", 21, "has the codes of `plain`"),
        ("decoder: latent_flow", "decoder: flow", 20, "`flow` decodes the codes of `residual`"),
        ("model: momask, decoder: flow", "model: momask, decoder: latent_flow", 14, "decodes the latents of `vae`"),
        ("tokenizer: residual, teacher: flow", "tokenizer: plain, teacher: flow", 19, "has the codes of `plain`"),
        ("teacher: flow}", "teacher: latent_flow}", 19, "decodes the latents of `vae`"),
        // Clips of another skeleton.
        (
            "{kind: train.discord, tokenizer",
            "{kind: train.discord, dataset: kit, tokenizer",
            13,
            "clips of `kit` have 21 joints",
        ),
        (
            "{kind: encode.tokens, tokenizer: plain",
            "{kind: encode.tokens, dataset: kit, tokenizer: plain",
            10,
            "21 joints",
        ),
        (
            "decoder: flow, evaluator",
            "decoder: flow, dataset: kit, evaluator",
            21,
            "`residual` has skeletons of 22 joints",
        ),
        ("{kind: train.evaluator}", "{kind: train.evaluator, dataset: kit}", 21, "`judge` has skeletons of 21 joints"),
        // Lengths that are not a multiple of the down-sampling.
        ("window: 64", "window: 63", 13, "expected a multiple of 4"),
        ("quantizers: 1, codes: 64", "quantizers: 1, window: 66", 8, "expected a multiple of 4"),
        ("padded: 196", "padded: 198", 9, "expected a multiple of 4"),
        // Mistakes in MMM's own settings.
        ("generator: mmm, ", "generator: mmm, text: words, ", 12, "embeds the captions of `kit`"),
        ("generator: mmm, ", "generator: mmm, dataset: kit, ", 12, "but `dataset` is `kit`"),
        ("generator: mmm, ", "generator: mmm, network: {word_blocks: 10}, ", 12, "`network.layers` is 9"),
        ("guidance: 0}", "guidance: 2}", 22, "`mmm` has no guidance"),
        // Kinds that need denoising, or latents.
        (
            "kind: evaluate.t2m, model: mmm, evaluator: judge",
            "kind: evaluate.spectrum, model: mmm",
            22,
            "no denoising steps",
        ),
        (
            "kind: model.decoder, model: mld, decoder: latent_flow",
            "kind: train.control, model: mmm",
            20,
            "not a latent diffusion model",
        ),
        ("model: momask, decoder: flow", "model: judge, decoder: flow", 14, "needs a model"),
        // Networks with another prediction.
        (
            "init: flow",
            "init: whole",
            24,
            "`init` is `whole`, whose network predicts the data, but this stage trains one that predicts the velocity",
        ),
        ("init: flow", "prediction: data, init: jumps", 24, "`init` is `jumps`, whose network predicts the velocity"),
        (
            "init: jumps, teacher: flow",
            "init: jumps, teacher: whole",
            25,
            "predicts the velocity, but this stage trains one that predicts the data",
        ),
    ] {
        assert_eq!(GOOD.matches(from).count(), 1, "{from}");
        let shown = read("p.yaml", &GOOD.replacen(from, to, 1), &[]).expect_err(to).to_string();
        let found = shown.lines().any(|said| said.starts_with(&format!("p.yaml:{line}:")) && said.contains(words));
        assert!(found, "{to}: {shown}");
    }
}
