//! Copies of stages.

use std::collections::BTreeMap;

use protocol::StageName;
use protocol::stage::{DataFold, DistillPcm, EvaluateLatentFid, Register};

use crate::{Pipeline, read};

const THREE: &str = "name: p
dataset: {format: synthetic}
stages:
  vae: {kind: train.vae, seeds: 3}
  latents: {kind: encode.latents}
  mld: {kind: train.mld}
  pcm: {kind: distill.pcm}
  fid: {kind: evaluate.latent_fid, model: pcm, sampler: {steps: 1}}
  out: {kind: register, model: m, from: pcm}
";

fn pipeline(text: &str) -> Pipeline {
    read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"))
}

fn names(pipeline: &Pipeline) -> Vec<&str> {
    pipeline.stages.iter().map(|stage| stage.name.as_str()).collect()
}

#[test]
fn what_reads_a_copied_stage_is_copied_with_it() {
    let read = pipeline(THREE);
    let of = |number: usize| ["vae", "latents", "mld", "pcm", "fid"].map(|name| format!("{name}_{number}"));
    let copies = (1..=3).flat_map(of);
    let expected: Vec<String> =
        ["dataset", "text"].map(str::to_owned).into_iter().chain(copies).chain(["out".to_owned()]).collect();
    assert_eq!(names(&read), expected);

    let stage = |name: &str| read.stage(&StageName::new(name)).unwrap_or_else(|| panic!("{name}"));
    let pcm = stage("pcm_2");
    assert_eq!(pcm.settings.get::<DistillPcm>().unwrap().distillation.teacher, "mld_2");
    assert!(pcm.inputs.iter().any(|input| input.stage.as_str() == "latents_2"), "{:?}", pcm.inputs);
    assert!(pcm.inputs.iter().all(|input| !input.stage.as_str().ends_with("_1")), "{:?}", pcm.inputs);
    assert_eq!(stage("fid_3").settings.get::<EvaluateLatentFid>().unwrap().model, "pcm_3");
    // All copies are candidates, each with its own evaluation.
    let out = stage("out");
    assert_eq!(out.settings.get::<Register>().unwrap().from, ["pcm_1", "pcm_2", "pcm_3"]);
    for evaluation in ["fid_1", "fid_2", "fid_3"] {
        assert!(out.inputs.iter().any(|input| input.stage.as_str() == evaluation), "{:?}", out.inputs);
    }
    read.check().unwrap();
}

#[test]
fn a_stage_may_read_one_copy() {
    let text = format!(
        "{THREE}  first: {{kind: evaluate.latent_fid, model: mld_1, latents: latents_1, sampler: {{steps: 50}}}}\n"
    );
    let read = pipeline(&text);
    assert_eq!(read.named(&StageName::new("first")).count(), 1);
    let first = read.stage(&StageName::new("first")).unwrap().settings.get::<EvaluateLatentFid>().unwrap();
    assert_eq!((&*first.model, &*first.latents), ("mld_1", "latents_1"));
    read.check().unwrap();
}

#[test]
fn copies_differ_in_their_draws_and_in_nothing_else() {
    let read = pipeline(THREE);
    let stage = |name: &str| read.stage(&StageName::new(name)).unwrap();
    let of = |name: &str| read.identity(stage(name), &BTreeMap::new());
    let (first, second) = (of("vae_1"), of("vae_2"));
    assert_ne!(first.name, second.name);
    assert_eq!(protocol::stage::StageIdentity { name: second.name.clone(), ..first }, second);
    // Written out by hand, it is the same stage.
    let by_hand = "name: p
dataset: {format: synthetic}
stages: {vae_2: {kind: train.vae}}
";
    let by_hand = pipeline(by_hand);
    let same = by_hand.stage(&StageName::new("vae_2")).unwrap();
    assert_eq!(by_hand.identity(same, &BTreeMap::new()), second);
}

#[test]
fn one_copy_is_no_copy() {
    let one = pipeline(&THREE.replace("seeds: 3", "seeds: 1"));
    assert_eq!(one, pipeline(&THREE.replace(", seeds: 3", "")));
}

#[test]
fn a_name_of_the_file_means_all_copies() {
    let read = pipeline(THREE);
    let meant = |name: &str| read.named(&StageName::new(name)).map(|stage| stage.name.to_string()).collect::<Vec<_>>();
    assert_eq!(meant("mld"), ["mld_1", "mld_2", "mld_3"]);
    assert_eq!(meant("mld_2"), ["mld_2"]);
    assert_eq!(meant("out"), ["out"]);
    assert!(meant("mld_4").is_empty());
}

#[test]
fn overrides_are_of_all_copies() {
    let set = ["vae.lr=1e-5".to_owned()];
    let read = read("p.yaml", THREE, &set).unwrap();
    for stage in read.named(&StageName::new("vae")) {
        assert!((stage.settings.training().unwrap().lr - 1e-5).abs() < 1e-12);
    }
}

#[test]
fn a_swept_stage_can_be_copied() {
    let text = "name: p
dataset: {format: synthetic}
stages:
  vae: {kind: train.vae, seeds: 2}
  latents: {kind: encode.latents}
  mld: {kind: train.mld}
  pcm:
    kind: distill.pcm
    sweep:
      metric: latent_fid
      trials: 2
      search: random
      space: {lr: {log_uniform: [1e-4, 1e-3]}}
      evaluate: {kind: evaluate.latent_fid, sampler: {steps: 1}}
  fid: {kind: evaluate.latent_fid, model: pcm@best, sampler: {steps: 1}}
";
    let read = pipeline(text);
    let second = read.stage(&StageName::new("pcm_2")).unwrap();
    let inputs: Vec<&str> = second.inputs.iter().map(|input| input.stage.as_str()).collect();
    assert!(inputs.contains(&"latents_2") && !inputs.contains(&"latents"), "{inputs:?}");
    let fid = read.stage(&StageName::new("fid_2")).unwrap();
    assert_eq!(fid.settings.get::<EvaluateLatentFid>().unwrap().model, "pcm_2");
    read.check().unwrap();
}

#[test]
fn mistakes_are_reported_at_their_place() {
    // The text replaced, the replacement, the place, a part of the message.
    let cases = [
        ("seeds: 3", "seeds: 0", "4:33", "`seeds` of stage `vae` is the number `0`; expected a whole number, 1 to 100"),
        ("seeds: 3", "seeds: three", "4:33", "expected a whole number"),
        (
            "{kind: train.mld}",
            "{kind: train.mld, seeds: 2}",
            "6:33",
            "`seeds` is 2, but `latents`, which it reads, exists 3 times",
        ),
        ("  mld:", "  vae_2: {kind: train.vae}\n  mld:", "4:3", "another stage is called `vae_2`"),
        ("from: pcm}", "from: pcm, seeds: 2}", "9:53", "a stage that registers exists once"),
        (
            "from: pcm}",
            "from: pcm, metric: fid.latent_fid}",
            "9:54",
            "`metric` names a value of `fid`, which exists 3 times",
        ),
    ];
    let more =
        |fields: &str| format!("{THREE}  one: {{kind: evaluate.latent_fid, {fields}, sampler: {{steps: 50}}}}\n");
    for (fields, place, part) in [
        ("model: mld_4, latents: latents_1", "10:43", "`model` is `mld_4`, but `mld` exists 3 times"),
        ("model: mld_1, latents: latents_2", "", "latents"),
    ] {
        let mistakes = read("p.yaml", &more(fields), &[]).unwrap_err().to_string();
        assert!(mistakes.contains(&format!("p.yaml:{place}")) && mistakes.contains(part), "{fields}: {mistakes}");
    }
    let extra = "  more: {kind: evaluate.latent_fid, model: pcm, sampler: {steps: 1}}\n";
    for (old, new, place, part) in cases {
        let mut text = THREE.replacen(old, new, 1);
        // With a second evaluation, a metric may name its stage.
        text.push_str(extra);
        let mistakes = read("p.yaml", &text, &[]).unwrap_err().to_string();
        assert!(mistakes.contains(&format!("p.yaml:{place}")) && mistakes.contains(part), "{new}: {mistakes}");
    }
}

#[test]
fn each_fold_has_its_own_stages() {
    let text = "name: p
stages:
  recordings: {kind: data.synthetic}
  dataset: {kind: data.fold, dataset: recordings, folds: 3}
  evaluator: {kind: train.evaluator, dataset: recordings}
  vae: {kind: train.vae}
";
    let read = pipeline(text);
    assert_eq!(
        names(&read),
        ["recordings", "evaluator", "dataset_1", "vae_1", "dataset_2", "vae_2", "dataset_3", "vae_3"]
    );
    for (i, stage) in read.named(&StageName::new("dataset")).enumerate() {
        assert_eq!(
            stage.settings.get::<DataFold>().unwrap(),
            &DataFold { dataset: "recordings".into(), folds: 3, fold: i + 1 }
        );
    }
    read.check().unwrap();
    // A stage may read the copy of one fold.
    let first =
        pipeline(&format!("{text}  error: {{kind: evaluate.reconstruction, vae: vae_1, dataset: dataset_1}}\n"));
    assert_eq!(first.named(&StageName::new("error")).count(), 1);
    // One fold alone is one stage.
    let one = pipeline(&text.replace("folds: 3", "folds: 3, fold: 2"));
    assert_eq!(names(&one), ["recordings", "dataset", "evaluator", "vae"]);
}

#[test]
fn the_number_of_copies_is_bounded() {
    let stages: String = (0..20).map(|i| format!("  v{i}: {{kind: train.vae, seeds: 100}}\n")).collect();
    let text = format!("name: p\ndataset: {{format: synthetic}}\nstages:\n{stages}");
    let mistakes = read("p.yaml", &text, &[]).unwrap_err().to_string();
    assert!(mistakes.contains("more than 1000 stages"), "{mistakes}");
}
