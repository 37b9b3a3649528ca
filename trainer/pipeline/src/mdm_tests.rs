//! Pipelines with generators of features.

use crate::read;

const GOOD: &str = "name: p
seed: 7
dataset: {format: synthetic, clips: 40}
stages:
  vae: {kind: train.vae}
  latents: {kind: encode.latents}
  semantics: {kind: train.evaluator}
  evaluator: {kind: train.evaluator}
  mdm: {kind: train.mdm, timesteps: 50, losses: {low_frequency: {weight: 1}, semantic: {weight: 0.5}}}
  tuned: {kind: train.mdm, init: mdm, timesteps: 50}
  smf: {kind: train.stablemofusion, network: {width: 16, multipliers: [1, 2]}}
  t2m: {kind: evaluate.t2m, model: mdm, sampler: {steps: 50, guidance: 2.5}}
  ten: {kind: evaluate.t2m, model: smf, sampler: {steps: 10, guidance: 2.5, solver: ddim}}
";

#[test]
fn what_does_not_go_together_is_refused_where_it_stands() {
    let good = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    let inputs = |name: &str| -> Vec<(String, String)> {
        let stage = good.stage(&name.into()).expect("a stage");
        stage.inputs.iter().map(|i| (i.field.clone(), i.stage.to_string())).collect()
    };
    assert!(inputs("mdm").contains(&("losses.semantic.evaluator".into(), "semantics".into())));
    assert!(inputs("tuned").contains(&("init".into(), "mdm".into())));
    assert_eq!(inputs("smf").len(), 2, "no term, no evaluator");
    for (from, to, line, words) in [
        ("model: mdm, sampler", "model: mdm, evaluator: semantics, sampler", "12:", "would be biased"),
        ("steps: 50, guidance", "steps: 51, guidance", "12:", "1 to 50"),
        ("solver: ddim", "solver: euler", "13:", "expected one of `own`, `ddpm`"),
        ("weight: 0.5}}", "weight: 0.5, evaluator: smf}}", "9:", "an evaluator"),
        ("weight: 1}", "weight: 1, from: 0.9, to: 0.2}", "9:", "`from` to be the smaller"),
        ("weight: 1}", "weight: 1, keep: 0}", "9:", "keep"),
        ("weight: 0.5}}", "weight: 0.5, threshold: 2}}", "9:", "threshold"),
        ("init: mdm,", "init: evaluator,", "10:", "a model"),
        ("init: mdm,", "network: {width: 30},", "10:", "does not divide"),
        ("init: mdm,", "diffusion: {schedule: flow, prediction: sample},", "10:", "no sampler for the schedule"),
        ("init: mdm,", "network: {width: 16384, feed_forward: 65536},", "10:", "parameters"),
        ("[1, 2]", "[1, 2, 2, 2, 2]", "11:", "1 to 4 numbers"),
        ("{width: 16, ", "{width: 12, ", "11:", "heads and groups"),
        ("stages:\n", "stages:\n  lcm: {kind: distill.lcm, teacher: mdm}\n", "", "is not a latent diffusion model"),
        ("stages:\n", "stages:\n  fid: {kind: evaluate.latent_fid, model: mdm}\n", "", "has no latents"),
    ] {
        assert!(GOOD.contains(from), "{from}");
        let text = GOOD.replacen(from, to, 1);
        let shown = read("p.yaml", &text, &[]).expect_err(to).to_string();
        let found = shown.lines().any(|said| said.starts_with(&format!("p.yaml:{line}")));
        assert!(found && shown.contains(words), "{to}: {shown}");
    }
}
