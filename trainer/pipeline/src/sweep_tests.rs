//! `sweep:` as users write it, and mistakes in each part.

use std::collections::BTreeMap;

use protocol::sweep::{Domain, SearchKind, Values, rung_name};
use protocol::{Digest, Steps};

use crate::*;

pub(crate) const GOOD: &str = "name: p
dataset: {format: synthetic, clips: 10}
stages:
  vae: {kind: train.vae, latent: {tokens: 16, dim: 32}}
  latents: {kind: encode.latents}
  mld: {kind: train.mld, steps: 2k}
  pcm:
    kind: distill.pcm
    steps: 900
    sweep:
      search: asha
      metric: latent_fid
      trials: 24
      rungs: {first: 100, factor: 3}
      space:
        adversarial: {choice: [0, 0.1, 1]}
        skip: {choice: [50, 100]}
        ema: {uniform: [0.9, 0.99]}
        optimizer: {beta1: {uniform: [0.5, 0.95]}}
      evaluate: {kind: evaluate.latent_fid, teacher: mld, sampler: {steps: 1, guidance: 2}}
  lcm: {kind: distill.lcm}
  fid: {kind: evaluate.latent_fid, model: pcm}
  out: {kind: register, model: m, from: pcm@best}
";

/// Cases: the text replaced, the replacement, the place of the mistake, and parts of its message.
const CASES: &[(&str, &str, &str, &[&str])] = &[
    ("search: asha", "search: ahsa", "11:15", &["the string `ahsa`", "did you mean `asha`?"]),
    (
        "search: asha",
        "serach: asha",
        "11:7",
        &["unknown key `serach` in `sweep` of stage `pcm`; did you mean `search`?"],
    ),
    ("metric: latent_fid\n", "metric: ''\n", "12:15", &["`metric` is missing"]),
    ("metric: latent_fid\n", "mode: most\n", "12:13", &["the string `most`; expected one of `min`, `max`"]),
    ("trials: 24", "trials: 0", "13:15", &["`trials` is 0; expected 1 to 10000"]),
    ("trials: 24", "trials: few", "13:15", &["the string `few`; expected a whole number"]),
    ("trials: 24", "parallel: 0", "13:17", &["`parallel` is 0"]),
    ("first: 100,", "first: 900,", "14:22", &["fewer steps than the stage's 900"]),
    ("{first: 100, factor: 3}", "{factor: 3}", "14:14", &["`rungs.first` is 0"]),
    ("factor: 3", "factor: 1", "14:35", &["`rungs.factor` is 1; expected 2 to 1000"]),
    ("search: asha", "search: random", "14:14", &["only `asha` has `rungs`"]),
    ("        skip:", "        skp:", "17:9", &["unknown key `skp` in `space` of stage `pcm`; did you mean `skip`?"]),
    ("        skip: {choice: [50, 100]}", "        steps: {choice: [50]}", "17:9", &["`steps` cannot be searched"]),
    ("        skip: {choice: [50, 100]}", "        teacher: {choice: [mld]}", "17:9", &["names a stage"]),
    ("        skip: {choice: [50, 100]}", "        kind: {choice: [x]}", "17:9", &["unknown key `kind`"]),
    ("[50, 100]", "[50, many]", "17:29", &["`skip` of stage `pcm` is the string `many`; expected a whole number"]),
    ("[50, 100]", "[50, 30]", "17:29", &["with `skip` at 30", "expected a divisor of the 1000 timesteps"]),
    ("[50, 100]", "[50, 50]", "17:29", &["lists 50 twice"]),
    ("[50, 100]", "[]", "17:24", &["`choice` of `space.skip` is empty"]),
    ("{choice: [50, 100]}", "[50, 100]", "17:15", &["`space.skip` is a list of 2", "write `{choice: [a, b]}`"]),
    ("{choice: [50, 100]}", "{choices: [50, 100]}", "17:16", &["unknown key `choices`", "did you mean `choice`?"]),
    ("{uniform: [0.9, 0.99]}", "{uniform: [0.9, 1]}", "18:30", &["with `ema` at 1", "below 1"]),
    ("{uniform: [0.9, 0.99]}", "{uniform: [0.99, 0.9]}", "18:24", &["two numbers, the smaller one first"]),
    ("{uniform: [0.9, 0.99]}", "{log_uniform: [0, 0.9]}", "18:29", &["expected a number above 0"]),
    ("{uniform: [0.9, 0.99]}", "{uniform: 0.9}", "18:24", &["expected a list"]),
    (
        "{beta1: {uniform: [0.5, 0.95]}}",
        "{beta3: {uniform: [0.5, 0.95]}}",
        "19:21",
        &["unknown key `beta3` in `space.optimizer`", "`beta1`"],
    ),
    (
        "{beta1: {uniform: [0.5, 0.95]}}",
        "{uniform: [0.5, 0.95]}",
        "19:21",
        &["unknown key `uniform` in `space.optimizer`"],
    ),
    (
        "kind: evaluate.latent_fid, teacher: mld",
        "kind: evaluate.latent_fit",
        "20:24",
        &["did you mean `evaluate.latent_fid`?"],
    ),
    (
        "{kind: evaluate.latent_fid, teacher: mld, sampler: {steps: 1, guidance: 2}}",
        "{kind: evaluate.reconstruction}",
        "20:24",
        &["`evaluate.reconstruction` does not measure a model", "`evaluate.latent_fid`"],
    ),
    ("teacher: mld", "model: mld", "20:52", &["a sweep evaluates its own trials", "remove it"]),
    ("teacher: mld", "teacher: mdl", "20:54", &["the stage `mdl`, which does not exist; did you mean `mld`?"]),
    ("teacher: mld", "repeats: 0", "20:54", &["`repeats` is 0"]),
    ("{steps: 1, guidance: 2}", "{steps: 2, guidance: 2}", "20:76", &["`sampler.steps` is 2, but `pcm` has 1 phase"]),
    (
        "        skip: {choice: [50, 100]}",
        "        phases: {choice: [1, 2]}",
        "17:30",
        &["with `phases` at 2", "does not fit"],
    ),
    (
        "  lcm: {kind: distill.lcm}",
        "  lcm: {kind: distill.lcm, teacher: mld@best}",
        "21:37",
        &["`mld` has no `sweep`", "write `mld`"],
    ),
    (
        "  latents: {kind: encode.latents}",
        "  latents: {kind: encode.latents, sweep: {}}",
        "5:35",
        &["only a training stage can have a sweep"],
    ),
];

#[test]
fn a_sweep_is_read() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    pipeline.check().unwrap();
    let stage = pipeline.stage(&"pcm".into()).unwrap();
    let sweep = stage.sweep.as_ref().unwrap();
    assert_eq!((sweep.search, sweep.trials(), sweep.parallel), (SearchKind::Asha, 24, 4));
    assert_eq!(sweep.rungs(900), [100, 300, 900]);
    assert_eq!(sweep.rungs(800), [100, 300, 800]);
    // Written as in the settings: an integer for a real number would give another key.
    assert_eq!(sweep.space["adversarial"], Domain::Choice(vec![0.0.into(), 0.1.into(), 1.0.into()]));
    assert_eq!(sweep.space["optimizer.beta1"], Domain::Uniform(0.5, 0.95));
    let fields: Vec<&str> = stage.inputs.iter().map(|input| input.field.as_str()).collect();
    let own = ["teacher", "latents", "text"];
    assert_eq!(
        fields,
        [&own[..], &["sweep.evaluate.latents", "sweep.evaluate.dataset", "sweep.evaluate.teacher"]].concat()
    );
    let from = &pipeline.stage(&"out".into()).unwrap().inputs;
    assert!(from.iter().any(|input| input.field == "from[0]" && input.stage.as_str() == "pcm"), "{from:?}");
    assert!(from.iter().any(|input| input.field == "evaluations.fid"), "{from:?}");
    let json = serde_json::to_string(&pipeline).unwrap();
    assert_eq!(serde_json::from_str::<Pipeline>(&json).unwrap(), pipeline);
}

#[test]
fn each_mistake_in_a_sweep_is_named_with_its_place() {
    let mut wrong = Vec::new();
    for (from, to, place, parts) in CASES {
        assert!(GOOD.contains(from), "{from:?}");
        match read("p.yaml", &GOOD.replacen(from, to, 1), &[]) {
            Ok(_) => wrong.push(format!("{to:?} was accepted")),
            Err(error) => {
                let shown = error.to_string();
                let missing = parts.iter().any(|part| !shown.contains(part));
                if missing || !shown.contains(&format!("p.yaml:{place}")) || error.0.len() > 2 {
                    wrong.push(format!("{to:?}: expected {place} {parts:?} in\n{shown}"));
                }
            }
        }
    }
    for missing in ["space", "evaluate"] {
        let cut: String = GOOD
            .lines()
            .filter(|line| {
                !(line.trim_start().starts_with(missing) || missing == "space" && line.starts_with("        "))
            })
            .map(|line| format!("{line}\n"))
            .collect();
        let shown = read("p.yaml", &cut, &[]).unwrap_err().to_string();
        assert!(shown.contains(&format!("has no `{missing}`")) && shown.contains("p.yaml:10:5"), "{shown}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n----\n"));
}

#[test]
fn a_grid_has_points_and_no_ranges() {
    let grid = GOOD.replace("search: asha", "search: grid").replace("      rungs: {first: 100, factor: 3}\n", "");
    let shown = read("p.yaml", &grid, &[]).unwrap_err().to_string();
    assert!(shown.contains("`ema` is a range, but a grid needs a list of values"), "{shown}");
    let choices = grid.replace("{uniform: [0.9, 0.99]}", "{choice: [0.9, 0.95]}");
    let choices = choices.replace("beta1: {uniform: [0.5, 0.95]}", "beta1: {choice: [0.5, 0.8, 0.95]}");
    let shown = read("p.yaml", &choices, &[]).unwrap_err().to_string();
    assert!(shown.contains("`trials` is 24, but the grid has 36 points"), "{shown}");
    let pipeline = read("p.yaml", &choices.replace("      trials: 24\n", ""), &[]).unwrap_or_else(|e| panic!("{e}"));
    let sweep = pipeline.stage(&"pcm".into()).unwrap().sweep.clone().unwrap();
    assert_eq!((sweep.trials(), sweep.rungs(900)), (36, vec![900]));
}

#[test]
fn a_rung_is_the_stage_with_other_values_that_stops_early() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    let stage = pipeline.stage(&"pcm".into()).unwrap();
    let values = Values::from([("adversarial".to_owned(), 1.0.into()), ("skip".to_owned(), 50.into())]);
    let [first, eval] = stage.rung(3, 0, Some(Steps(100)), &values).unwrap();
    let [last, _] = stage.rung(3, 1, None, &values).unwrap();
    assert_eq!((first.name.as_str(), eval.name.as_str()), ("pcm.t03.r0", "pcm.t03.r0.eval"));
    assert_eq!(first.settings.training().unwrap().end(), Steps(100));
    assert_eq!(last.settings.training().unwrap().end(), Steps(900));
    let state = last.inputs.last().unwrap();
    assert_eq!((state.field.as_str(), &state.stage), ("state", &rung_name(&"pcm".into(), 3, 0)));
    assert!(eval.inputs.iter().any(|input| input.field == "model" && input.stage == first.name));
    // A trial with the whole budget has the key of the plain stage with its values, so only one of them runs.
    let sets = ["pcm.adversarial=1".to_owned(), "pcm.skip=50".to_owned()];
    let mut plain = read("p.yaml", GOOD, &sets).unwrap_or_else(|e| panic!("{e}"));
    let inputs = BTreeMap::from([("teacher".to_owned(), Digest::of(b"t"))]);
    let [whole, _] = stage.rung(9, 0, None, &values).unwrap();
    let at = plain.stages.iter().position(|stage| stage.name.as_str() == "pcm").unwrap();
    plain.stages[at].sweep = None;
    assert_eq!(plain.identity(&plain.stages[at], &inputs), pipeline.identity(&whole, &inputs));
    assert_ne!(pipeline.identity(&first, &inputs).key(), pipeline.identity(&whole, &inputs).key());
    let impossible = Values::from([("skip".to_owned(), 30.into())]);
    assert!(stage.rung(0, 0, None, &impossible).unwrap_err().contains("divisor"));
}

/// Settings of the evaluating stage are searched together with those of the stage, or alone.
#[test]
fn what_evaluates_can_be_searched() {
    let searched = "        evaluate: {samples: {choice: [1, 2]}, sampler: {guidance: {choice: [1, 2.5]}}}\n";
    let space = GOOD.find("        adversarial").unwrap()..GOOD.find("      evaluate:").unwrap();
    let mut text = GOOD.to_owned();
    text.replace_range(space, searched);
    let text = text.replace("search: asha", "search: grid").replace("      rungs: {first: 100, factor: 3}\n", "");
    let text = text.replace("      trials: 24\n", "");
    let pipeline = read("p.yaml", &text, &[]).unwrap_or_else(|e| panic!("{e}"));
    pipeline.check().unwrap();
    let stage = pipeline.stage(&"pcm".into()).unwrap();
    let sweep = stage.sweep.as_ref().unwrap();
    assert_eq!(sweep.space["evaluate.sampler.guidance"], Domain::Choice(vec![1.0.into(), 2.5.into()]));
    assert_eq!(sweep.trials(), 4);
    let values = |guidance: f64| Values::from([("evaluate.sampler.guidance".to_owned(), guidance.into())]);
    let [train, eval] = stage.rung(0, 0, None, &values(1.0)).unwrap();
    let [other, other_eval] = stage.rung(1, 0, None, &values(2.5)).unwrap();
    assert_eq!(
        (eval.settings.sampler().unwrap().guidance, other_eval.settings.sampler().unwrap().guidance),
        (1.0, 2.5)
    );
    // The trials share one training and differ in their evaluation.
    let inputs = BTreeMap::from([("teacher".to_owned(), Digest::of(b"t"))]);
    assert_eq!(pipeline.identity(&train, &inputs), pipeline.identity(&other, &inputs));
    assert_ne!(pipeline.identity(&eval, &inputs), pipeline.identity(&other_eval, &inputs));
    let json = serde_json::to_string(&pipeline).unwrap();
    assert_eq!(serde_json::from_str::<Pipeline>(&json).unwrap(), pipeline);

    for (from, to, words) in [
        ("samples:", "sampels:", "did you mean `samples`?"),
        ("samples: {choice: [1, 2]}", "samples: {choice: [0]}", "with `evaluate.samples` at 0"),
        ("samples: {choice: [1, 2]}", "model: {choice: [mld]}", "names a stage"),
        ("samples: {choice: [1, 2]}", "kind: {choice: [x]}", "unknown key `kind`"),
        ("guidance: {choice: [1, 2.5]}", "steps: {choice: [1, 2]}", "has 1 phase"),
        ("guidance: {choice: [1, 2.5]}", "guidance: {choice: [1, high]}", "expected a number"),
        ("evaluate: {samples: {choice: [1, 2]}, sampler: {guidance: {choice: [1, 2.5]}}}", "evaluate: {}", "is empty"),
    ] {
        assert_eq!(text.matches(from).count(), 1, "{from}");
        let shown = read("p.yaml", &text.replacen(from, to, 1), &[]).expect_err(to).to_string();
        assert!(shown.contains("p.yaml:14:") && shown.contains(words), "{to}: {shown}");
    }
}

#[test]
fn nothing_changes_for_stages_without_a_sweep() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap();
    let json = serde_json::to_value(&pipeline.stages[2]).unwrap();
    assert!(json.get("sweep").is_none() && json.get("derived").is_none(), "{json}");
    assert!(json["settings"].get("stop").is_none(), "{json}");
}
