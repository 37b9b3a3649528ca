//! Registry versions as inputs of stages: distinguished from stages, and refused where none is allowed.

use std::collections::BTreeMap;

use protocol::Digest;

use crate::read;

const GOOD: &str = "name: p
dataset: {format: synthetic, clips: 10}
stages:
  vae: {kind: train.vae, init: motionlcm@prod}
  latents: {kind: encode.latents, vae: motionlcm@prod}
  mld: {kind: train.mld, vae: motionlcm@prod, init: motionlcm@best}
  lcm: {kind: distill.lcm, teacher: teachers:3, init: 'motionlcm@2'}
  fid: {kind: evaluate.latent_fid, model: motionlcm@prod}
  words: {kind: train.evaluator}
  tokens: {kind: train.tokenizer, init: momask@prod}
  length: {kind: train.length, init: motionlcm@prod}
  out: {kind: register, model: m, from: lcm}
";

#[test]
fn versions_are_no_edges_and_their_digests_are_inputs() {
    let mut pipeline = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    pipeline.check().unwrap();
    let versions = |name: &str| -> Vec<(String, String)> {
        let stage = pipeline.stage(&name.into()).unwrap();
        stage.versions().into_iter().map(|input| (input.field, input.version)).collect()
    };
    let pair = |field: &str, version: &str| (field.to_owned(), version.to_owned());
    assert_eq!(versions("vae"), [pair("init", "motionlcm@prod")]);
    assert_eq!(versions("mld"), [pair("vae", "motionlcm@prod"), pair("init", "motionlcm@best")]);
    assert_eq!(versions("lcm"), [pair("teacher", "teachers:3"), pair("init", "motionlcm@2")]);
    assert_eq!(versions("words"), []);
    let edges: Vec<&str> = pipeline.stage(&"lcm".into()).unwrap().inputs.iter().map(|i| i.field.as_str()).collect();
    assert_eq!(edges, ["latents", "text"]);

    // The key contains the digest, not the name that was resolved to it.
    let key = |pipeline: &crate::Pipeline| {
        let stage = pipeline.stage(&"vae".into()).unwrap();
        pipeline.identity(stage, &BTreeMap::from([("dataset".to_owned(), Digest::of(b"d"))])).key()
    };
    let without = key(&pipeline);
    let fill = |pipeline: &mut crate::Pipeline, digest: Digest| {
        let stage = pipeline.stages.iter_mut().find(|stage| stage.name.as_str() == "vae").unwrap();
        stage.external.insert("init".into(), digest);
    };
    fill(&mut pipeline, Digest::of(b"one"));
    pipeline.check().unwrap();
    let one = key(&pipeline);
    let mut other = read("p.yaml", &GOOD.replace("init: motionlcm@prod}", "init: another:7}"), &[]).unwrap();
    fill(&mut other, Digest::of(b"one"));
    assert_eq!(key(&other), one);
    fill(&mut other, Digest::of(b"two"));
    assert_ne!(key(&other), one);
    assert_ne!(without, one);
    // An input that is not a reference is refused.
    fill(&mut pipeline, Digest::of(b"one"));
    pipeline.stages[0].external.insert("init".into(), Digest::of(b"x"));
    assert!(pipeline.check().unwrap_err().contains("but it does not read"));
}

#[test]
fn keys_are_those_from_before_there_was_an_init() {
    for settings in protocol::stage::StageSettings::all() {
        let json = serde_json::to_value(&settings).unwrap();
        let had = matches!(settings.kind(), "train.mld" | "train.mdm" | "train.stablemofusion");
        assert_eq!(json.get("init").is_some(), had, "{}", settings.kind());
    }
}

#[test]
fn versions_are_refused_where_none_can_be() {
    for (from, to, line, words) in [
        ("vae: motionlcm@prod}", "vae: 'motionlcm@'}", 5, "is not a model version"),
        ("teacher: teachers:3", "teacher: 'teachers:x'", 7, "`x` is not a number"),
        ("teacher: teachers:3,", "teacher: teachers:3, latents: motionlcm@prod,", 7, "do not contain latents"),
        ("from: lcm", "from: motionlcm@prod", 12, "expected a stage that outputs a model"),
        ("from: lcm", "from: motionlcm@best", 12, "expected a stage that outputs a model"),
        ("model: motionlcm@prod", "model: lcm@best", 8, "`lcm` has no `sweep`"),
        ("{kind: train.tokenizer", "{kind: train.tokenizer, dataset: d@1", 10, "do not contain a dataset"),
        ("vae: motionlcm@prod, init", "vae: motionlcm@best, init", 6, "was encoded with `motionlcm@prod`"),
    ] {
        assert!(GOOD.contains(from), "{from}");
        let shown = read("p.yaml", &GOOD.replacen(from, to, 1), &[]).expect_err(to).to_string();
        let found = shown.lines().any(|said| said.starts_with(&format!("p.yaml:{line}:")));
        assert!(found && shown.contains(words), "{to}: {shown}");
    }
}
