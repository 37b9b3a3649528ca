//! The reader, tested with files that have one mistake each, files with many, and the shipped ones.

use std::collections::BTreeMap;
use std::path::PathBuf;

use cluster_tests::{Bench, book, documented};
use protocol::stage::{Keep, Mode};
use protocol::{Digest, Seed};

use crate::*;

/// A valid pipeline; cases replace a part of it.
const GOOD: &str = "name: p
seed: 7
dataset: {format: synthetic, clips: 10}
stages:
  vae:
    kind: train.vae
    latent: {tokens: 16, dim: 32}
    steps: 10
    lr: 1e-3
    batch: {global: 8, slices: 4}
  latents: {kind: encode.latents, vae: vae}
  mld: {kind: train.mld, steps: 2k}
  lcm: {kind: distill.lcm, guidance: [1, 5]}
  pcm: {kind: distill.pcm, phases: 2}
  recon: {kind: evaluate.reconstruction, vae: vae}
  fid: {kind: evaluate.latent_fid, model: pcm, teacher: mld, sampler: {steps: 2, guidance: 2}}
  out: {kind: register, model: m, from: pcm, promote: {to: staging, require: [\"latent_fid <= 1\"]}}
";

/// Cases: the text replaced, the replacement, the place of the mistake, and parts of its message.
const CASES: &[(&str, &str, &str, &[&str])] = &[
    // Mistakes in the text.
    ("name: p\n", "name: [p\n", "", &["invalid YAML"]),
    ("    lr: 1e-3\n", "\tlr: 1e-3\n", "8:", &["invalid YAML", "indent with spaces"]),
    ("seed: 7", "seed: 7\nseed: 8", "3:1", &["duplicate key `seed`", "line 2"]),
    ("    steps: 10\n", "    steps: 10\n    steps: 11\n", "9:5", &["duplicate key `steps`"]),
    ("name: p", "? [a]\n: b\nname: p", "1:", &["a key must be a string"]),
    ("name: p", "--- a\n--- b\nname: p", "", &["second YAML document"]),
    // Mistakes in top-level keys.
    ("name: p\n", "", "1:1", &["no `name`"]),
    ("name: p", "name: p/q", "1:7", &["`p/q` is not a valid pipeline name"]),
    ("name: p", "name: 12", "1:7", &["the number `12`; expected a string", "quote it"]),
    ("seed: 7", "sede: 7", "2:1", &["unknown key `sede` in the pipeline; did you mean `seed`?"]),
    ("seed: 7", "seed: -7", "2:7", &["`seed`", "of 0 or more"]),
    ("seed: 7", "seed: 7.5", "2:7", &["whole number"]),
    ("seed: 7", "seed: .nan", "2:7", &["`.nan`; expected a finite number"]),
    ("seed: 7", "seed: {a: 1}", "2:7", &["a mapping; expected a whole number"]),
    ("seed: 7", "backend: cudda", "2:10", &["one of `flex`, `ndarray`, `wgpu`, `cuda`", "did you mean `cuda`?"]),
    ("seed: 7", "zebra: 7", "2:1", &["unknown key `zebra` in the pipeline", "known keys: `"]),
    ("dataset: {format: synthetic, clips: 10}\n", "", "1:1", &["no `dataset`"]),
    ("format: synthetic", "fromat: synthetic", "3:1", &["`dataset` has no `format`"]),
    ("format: synthetic", "format: humanml", "3:19", &["the string `humanml`", "`humanml3d`", "did you mean"]),
    (
        "format: synthetic",
        "format: humanml3d",
        "3:30",
        &["unknown key `clips` in `dataset`", "known keys: `format`, `path`"],
    ),
    ("{format: synthetic, clips: 10}", "{format: kit}", "3:1", &["`path` is missing"]),
    ("{format: synthetic, clips: 10}", "data/HumanML3D", "3:10", &["expected a mapping with `format`"]),
    ("clips: 10", "clips: 0", "3:37", &["`clips` is 0; expected 1 to 100000 clips"]),
    ("clips: 10", "clips: ten", "3:37", &["`clips` of `dataset` is the string `ten`; expected a whole number"]),
    ("clips: 10", "val: 0.6, test: 0.5", "", &["leave no training clips"]),
    (
        "seed: 7",
        "text: {encoder: sentence-t6}",
        "2:17",
        &["`hashed`, `clip`, `t5`, `sentence-t5`", "did you mean `sentence-t5`?"],
    ),
    (
        "seed: 7",
        "text: {encoder: t5}",
        "2:1",
        &["`path` is missing; set it to the folder with the encoder `t5`", "download T5"],
    ),
    (
        "seed: 7",
        "text: {encoder: t5, path: x, ids: openai}",
        "2:35",
        &["`ids` is set, but the encoder `t5` does not use it"],
    ),
    ("seed: 7", "text: {encoder: t5, path: x, output: pooled}", "2:38", &["`output` is set, but the encoder `t5`"]),
    (
        "seed: 7",
        "text: {encoder: clip, path: x, max_tokens: 2}",
        "2:44",
        &["`max_tokens` is 2; expected 0, or at least 3"],
    ),
    ("seed: 7", "text: {shards: 0}", "2:16", &["`shards` is 0; expected 1 to"]),
    ("seed: 7", "text: {dataset: vae}", "2:17", &["`vae` outputs a VAE, but `dataset` needs a dataset"]),
    // Mistakes in stages.
    (
        "kind: train.vae",
        "kind: train.vea",
        "6:11",
        &["unknown kind `train.vea` of stage `vae`; did you mean `train.vae`?", "kinds: "],
    ),
    ("    kind: train.vae\n", "", "5:3", &["stage `vae` has no `kind`"]),
    ("{kind: encode.latents, vae: vae}", "encode.latents", "", &["expected a mapping with `kind`"]),
    ("  recon:", "  Recon:", "", &["`Recon` is not a valid stage name"]),
    (
        "    lr: 1e-3",
        "    learning_rate: 1e-3",
        "9:5",
        &["unknown key `learning_rate` in stage `vae`; did you mean `lr`?"],
    ),
    ("    lr: 1e-3", "    warmpu: 1", "9:5", &["unknown key `warmpu` in stage `vae`; did you mean `warmup`?"]),
    ("dim: 32", "dmi: 32", "7:26", &["unknown key `dmi` in `latent` of stage `vae`; did you mean `dim`?"]),
    (
        "{tokens: 16, dim: 32}",
        "16x32",
        "7:13",
        &["`latent` of stage `vae` is the string `16x32`; expected a mapping", "`tokens`"],
    ),
    ("    lr: 1e-3", "    lr: fast", "9:9", &["`lr` of stage `vae` is the string `fast`; expected a number"]),
    ("    lr: 1e-3", "    lr: \"0.1\"", "9:9", &["expected a number", "remove the quotes"]),
    ("    lr: 1e-3", "    lr: .inf", "9:9", &["finite number"]),
    ("    lr: 1e-3", "    lr: 1e999", "9:9", &["finite number"]),
    ("    lr: 1e-3", "    lr: -1", "9:9", &["`lr` is -1.0; expected a number above 0"]),
    ("    lr: 1e-3", "    lr:", "9:", &["nothing; expected a number", "remove the key"]),
    ("steps: 10", "steps: 1.5k5", "8:12", &["whole number of steps"]),
    ("steps: 10", "steps: 0", "8:12", &["`steps` is 0"]),
    ("slices: 4", "slices: 3", "10:21", &["not a multiple of the 3 slices"]),
    ("slices: 4", "slices: 0", "10:32", &["`batch.slices` is 0"]),
    ("lr: 1e-3", "network: {layers: 4}", "9:23", &["expected an odd number"]),
    ("lr: 1e-3", "network: {heads: 3}", "9:22", &["does not divide `network.width`"]),
    ("lr: 1e-3", "network: {dropout: 1}", "9:24", &["below 1"]),
    ("lr: 1e-3", "windows: {until: 0.5, min: 64, max: 40}", "", &["`windows.max` is 40, which is less than"]),
    ("lr: 1e-3", "loss: {joint_from: 2}", "9:24", &["a number from 0 to 1"]),
    ("lr: 1e-3", "workers: {min: 4, max: 2}", "", &["`workers.max` is 2, which is less than `workers.min`"]),
    ("lr: 1e-3", "workers: 2", "9:14", &["expected a mapping", "`min`"]),
    ("lr: 1e-3", "checkpoint: {evry: 10}", "9:18", &["did you mean `every`?"]),
    ("lr: 1e-3", "<<: {lr: 1}", "9:5", &["merge keys"]),
    ("guidance: [1, 5]", "guidance: [5, 1]", "", &["the smaller number first"]),
    ("guidance: [1, 5]", "guidance: [5]", "", &["a list of 1; expected a list of two numbers"]),
    ("guidance: [1, 5]", "guidance: 5", "", &["expected a list of two numbers"]),
    ("guidance: [1, 5]", "skip: 30", "", &["divisor of the 1000 timesteps"]),
    ("guidance: [1, 5]", "guidance_dim: 7", "", &["even number"]),
    ("phases: 2", "phases: 11", "", &["the grid of `skip` 100 has only 10 points"]),
    ("sampler: {steps: 2,", "sampler: {steps: 1,", "", &["`pcm` has 2 phases", "write `steps: 2`"]),
    ("{steps: 2, guidance: 2}", "{steps: 2, timesteps: [9, 99]}", "", &["expected the noisiest first"]),
    ("teacher: mld", "components: 600", "", &["a latent has only 512 numbers"]),
    // Mistakes in references.
    (
        "kind: encode.latents, vae: vae",
        "kind: encode.latents, vae: vea",
        "11:40",
        &["the stage `vea`, which does not exist; did you mean `vae`?"],
    ),
    (
        "{kind: distill.pcm,",
        "{kind: distill.pcm, teacher: latents,",
        "14:",
        &["`latents` outputs latents, but `teacher` needs a model", "`mld`"],
    ),
    ("{kind: distill.pcm,", "{kind: distill.pcm, teacher: lcm,", "14:", &["is a student", "needs a `train.mld` stage"]),
    (
        "{kind: train.mld,",
        "{kind: train.mld, vae: '',",
        "12:",
        &["`vae` is empty; expected a stage that outputs a VAE"],
    ),
    (
        "  latents:",
        "  posteriors:",
        "12:3",
        &["`latents` names the stage `latents`, which does not exist", "`posteriors`"],
    ),
    ("from: pcm", "from: [pcm, lcm]", "17:", &["no `evaluate.*` stage evaluates `lcm`"]),
    ("from: pcm", "from: [pcm, pcm]", "17:", &["lists `pcm` twice"]),
    ("from: pcm, ", "", "17:3", &["`from` is missing"]),
    ("model: m,", "model: 'a b',", "17:", &["is not a valid model name"]),
    (
        "  out: ",
        "  t2m: {kind: evaluate.t2m, model: pcm, sampler: {steps: 2, guidance: 4}, evaluator: judge}\n  judge: {kind: train.evaluator}\n  out: ",
        "19:",
        &["the evaluations of `pcm`", "guidance 2 in `fid`; 2 steps, guidance 4 in `t2m`", "`sampler: {steps: 1"],
    ),
    ("from: pcm,", "from: pcm, sampler: {steps: 4},", "17:", &["`sampler.steps` is 4, but `pcm` has 2 phases"]),
    ("from: pcm,", "from: pcm, sampler: {stps: 4},", "17:", &["unknown field `stps`", "`timesteps`"]),
    (
        "  recon: ",
        "  after: {kind: evaluate.latent_fid, model: out, sampler: {steps: 3}}\n  recon: ",
        "15:",
        &["`out` has 2 phases"],
    ),
    ("from: pcm,", "from: pcm, sampler: 4,", "17:", &["expected a mapping"]),
    ("from: pcm,", "from: pcm, length: vae,", "17:", &["`vae` outputs a VAE, but `length` needs a length estimator"]),
    ("{kind: train.mld,", "{kind: train.mld, text_relu: true,", "12:", &["half of the words of `hashed`", "remove it"]),
    (
        "  fid: {kind: evaluate.latent_fid,",
        "  more: {kind: data.synthetic}\n  fid: {kind: evaluate.latent_fid, dataset: more,",
        "17:",
        &["`latents` encodes the clips of `dataset`", "write `dataset: dataset`"],
    ),
    (
        "  recon: ",
        "  kit: {kind: data.open, format: kit, path: k}\n  judge: {kind: import.evaluator, format: kit, path: t2m}\n  t2m: {kind: evaluate.t2m, dataset: kit, evaluator: judge, model: mld}\n  recon: ",
        "17:",
        &["`mld` generates motions of 22 joints (humanml3d)", "`kit` have 21"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, vae: vae, real: true, evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["`real` measures clips", "use one stage for each"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, vae: vae, length: mld, evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["no model is measured"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, model: mld, length: vae, evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["`vae` outputs a VAE, but `length` needs a length estimator"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, real: true, pools: [], evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["`pools` is empty", "for example [32]"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, real: true, pools: [16, 32, 16], evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["`pools` has 16 twice"],
    ),
    (
        "  recon: ",
        "  t2m: {kind: evaluate.t2m, real: true, pools: [2], evaluator: judge}\n  judge: {kind: train.evaluator}\n  recon: ",
        "15:",
        &["expected 4 to 4096 motions"],
    ),
    ("latent_fid <= 1", "latent_fid = 1", "17:", &["is not a gate"]),
    (
        "    steps: 10\n",
        "    steps: 10\n    checkpoint: {keep: {metrc: joint}}\n",
        "",
        &["unknown key `metrc`", "`metric`"],
    ),
    (
        "    steps: 10\n",
        "    steps: 10\n    checkpoint: {keep: {mode: least}}\n",
        "",
        &["the string `least`", "`min`, `max`"],
    ),
    (
        "    steps: 10\n",
        "    steps: 10\n    checkpoint: {keep: {metric: joint}}\n",
        "",
        &["`checkpoint.keep.best` is 0", "keep.best"],
    ),
    ("to: staging, ", "", "17:", &["`promote.to` is missing"]),
    // Two stages that are valid separately.
    (
        "  recon: ",
        "  judge: {kind: import.evaluator, format: kit, path: t2m}\n  real: {kind: evaluate.t2m, real: true, evaluator: judge}\n  recon: ",
        "16:",
        &["`judge` is an evaluator for skeletons of 21 joints (kit)", "`dataset` have 22", "train.evaluator"],
    ),
    (
        "  mld: {kind: train.mld,",
        "  v1: {kind: train.vae, latent: {tokens: 1, dim: 256}}\n  mld: {kind: train.mld, vae: v1,",
        "13:",
        &["`vae` is `v1` (1x256), but `latents` was encoded with `vae` (16x32)"],
    ),
    (
        "  mld: {kind: train.mld,",
        "  other: {kind: data.synthetic}\n  words: {kind: text.embed, dataset: other}\n  mld: {kind: train.mld, text: words,",
        "14:",
        &["`words` embeds the captions of `other`"],
    ),
    (
        "{kind: train.mld, steps: 2k}",
        "{kind: distill.lcm, teacher: lcm}",
        "12:3",
        &["stages form a cycle: `mld` -> `lcm` -> `mld`"],
    ),
];

#[test]
fn a_good_file_is_read() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap_or_else(|e| panic!("{e}"));
    let names: Vec<&str> = pipeline.stages.iter().map(|stage| stage.name.as_str()).collect();
    assert_eq!(names, ["dataset", "text", "vae", "latents", "mld", "lcm", "pcm", "recon", "fid", "out"]);
    let out = pipeline.stages.last().unwrap();
    assert_eq!(
        out.inputs.iter().map(|i| (i.field.as_str(), i.stage.as_str())).collect::<Vec<_>>(),
        [("from[0]", "pcm"), ("evaluations.fid", "fid")]
    );
    pipeline.check().unwrap();
    let json = serde_json::to_string(&pipeline).unwrap();
    assert_eq!(serde_json::from_str::<Pipeline>(&json).unwrap(), pipeline);
}

#[test]
fn each_mistake_is_named_with_its_place() {
    let mut wrong = Vec::new();
    for (from, to, place, parts) in CASES {
        assert!(GOOD.contains(from), "{from:?}");
        let text = GOOD.replacen(from, to, 1);
        let Err(error) = read("p.yaml", &text, &[]) else {
            wrong.push(format!("{to:?} was accepted"));
            continue;
        };
        let shown = error.to_string();
        for part in *parts {
            if !shown.contains(part) {
                wrong.push(format!("{to:?}: {part:?} is not in\n{shown}"));
            }
        }
        if !shown.contains(&format!("p.yaml:{place}")) {
            wrong.push(format!("{to:?}: expected place {place} in\n{shown}"));
        }
        // All readers of a missing `latents` stage report it; every other mistake has one or two places.
        let allowed = if to.contains("posteriors") { 4 } else { 2 };
        if error.0.len() > allowed {
            wrong.push(format!("{to:?}: {} messages for one mistake\n{shown}", error.0.len()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n----\n"));
    assert!(CASES.len() >= 60, "{}", CASES.len());
}

#[test]
fn all_mistakes_come_at_once() {
    let text = GOOD
        .replace("seed: 7", "sede: 7")
        .replace("    lr: 1e-3", "    warmpu: 3\n    lr: 0")
        .replace("kind: distill.lcm", "kind: distil.lcm")
        .replace("vae: vae}\n  mld", "vae: veo}\n  mld");
    let error = read("p.yaml", &text, &[]).unwrap_err();
    let lines: Vec<usize> = error.0.iter().map(|d| d.line).collect();
    assert_eq!(lines, [2, 9, 12, 14], "{error}");
    assert_eq!(error.0[1].path, "stages.vae.warmpu");
}

#[test]
fn a_diagnostic_shows_the_line_and_a_caret() {
    let text = GOOD.replace("    lr: 1e-3", "    warmpu: 3");
    let shown = read("configs/x.yaml", &text, &[]).unwrap_err().to_string();
    let head: Vec<&str> = shown.lines().take(3).collect();
    assert_eq!(
        head,
        [
            "configs/x.yaml:9:5: unknown key `warmpu` in stage `vae`; did you mean `warmup`?",
            "  9 |     warmpu: 3",
            "    |     ^",
        ]
    );
}

#[test]
fn overrides_are_checked_like_the_file() {
    let set = |sets: &[&str]| read("p.yaml", GOOD, &sets.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>());
    let pipeline = set(&["stages.vae.steps=300k", "vae.network.width=64", "seed=9", "dataset.mirror=true"]).unwrap();
    assert_eq!(pipeline.seed, Seed(9));
    let vae = pipeline.stage(&"vae".into()).unwrap();
    assert_eq!(vae.settings.steps().unwrap().0, 300_000);
    for (bad, part) in [
        ("stages.vae.stps=1", "--set stages.vae.stps=1: unknown key `stps` in stage `vae`; did you mean `steps`?"),
        ("vea.lr=1", "did you mean `vae`?"),
        ("lr", "expected `key.path=value`"),
        ("stages.vae.lr=[", "cannot parse"),
        ("stages.vae.lr.x=1", "has no keys"),
        ("stages.vae.lr=abc", "--set stages.vae.lr=abc: `lr` of stage `vae` is the string `abc`; expected a number"),
        ("stages.vae.batch.global=9", "not a multiple of the 4 slices"),
        ("stages..lr=1", "is not a path of keys"),
        ("stages.lcm.guidance.7=1", "not an index of a list of 2"),
        ("dataset.path=/x", "unknown key `path` in `dataset`"),
        ("stages.vae.lr=", "nothing; expected a number"),
    ] {
        let shown = set(&[bad]).unwrap_err().to_string();
        assert!(shown.contains(part), "{bad}: {shown}");
    }
}

#[test]
fn bombs_are_refused() {
    let mut bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n".to_owned();
    for (name, before) in ["b", "c", "d", "e", "f", "g", "h", "i"].iter().zip(["a", "b", "c", "d", "e", "f", "g", "h"])
    {
        bomb += &format!("{name}: &{name} [{}]\n", vec![format!("*{before}"); 9].join(", "));
    }
    let shown = read("p.yaml", &bomb, &[]).unwrap_err().to_string();
    assert!(shown.contains("after aliases are expanded"), "{shown}");
    let deep = "[".repeat(5000);
    assert!(read("p.yaml", &deep, &[]).is_err());
    assert!(read("p.yaml", &format!("name: {}", "x".repeat(2 << 20)), &[]).unwrap_err().to_string().contains("bytes"));
    let shared = GOOD.replace("    batch: {global: 8, slices: 4}", "    batch: &b {global: 8, slices: 4}");
    let shared = shared.replace("steps: 2k}", "steps: 2k, batch: *b}");
    assert!(read("p.yaml", &shared, &[]).is_ok());
}

/// The memory for a small text is limited too, in the file and in overrides. Each of these took gigabytes, or a stack.
#[test]
fn a_small_text_does_not_become_a_large_one() {
    let refused = |text: &str, part: &str| {
        let error = read("p.yaml", text, &[]).expect_err(part);
        let shown = error.to_string();
        assert!(shown.contains(part), "{part}: {}", &shown[..shown.len().min(500)]);
        assert!(shown.len() < 1 << 20, "{} bytes of messages", shown.len());
    };
    // One long text, repeated often.
    let long = "x".repeat(7_000);
    refused(&format!("a: &a \"{long}\"\nb: [{}]\n", vec!["*a"; 10_000].join(",")), "bytes of text");
    refused(&format!("a: \"{}\"", "x".repeat(500 << 10)), "the string has 512000 bytes");
    refused(&format!("\"{}\": 1", "k".repeat(300)), "the key has 300 bytes");
    // Anchors within anchors are copies too.
    let nested = (0..60).map(|i| format!("&a{i} [")).collect::<String>() + &"x,".repeat(2_000) + &"]".repeat(60);
    refused(&format!("a: {nested}"), "values after aliases are expanded");
    // Every mistake shows its line; here the line is the file.
    let keys: Vec<String> = (0..9_000).map(|i| format!("unknown_{i}: 1")).collect();
    refused(&format!("{{{}}}", keys.join(", ")), "unknown key `unknown_0`");
    let many = read("p.yaml", &format!("{{{}}}", keys.join(", ")), &[]).unwrap_err();
    assert_eq!(many.0.len(), protocol::limits::MISTAKES);
    let twice = format!("{{{}}}", vec!["a: 1"; 9_000].join(", "));
    refused(&twice, "duplicate key");
    let stages: String = (0..1_001).map(|i| format!("  s{i}: {{kind: train.vae}}\n")).collect();
    refused(&format!("name: p\ndataset: {{format: synthetic}}\nstages:\n{stages}"), "`stages` has 1001");

    let set = |sets: Vec<String>| read("p.yaml", GOOD, &sets).unwrap_err().to_string();
    assert!(set(vec![format!("vae.{}=1", vec!["a"; 30_000].join("."))]).contains("its path has 30001 keys"));
    assert!(set(vec![format!("vae.{}=1", "a".repeat(300))]).contains("a key of 300 bytes"));
    let bomb = format!("vae.lr=[&a {}, {}]", "x".repeat(1_000), vec!["*a"; 500].join(","));
    assert!(set(vec![bomb; 40]).contains("after aliases are expanded"), "overrides share one budget");
    assert!(set(vec!["seed=1".into(); 1_001]).contains("1001 overrides"));
}

/// Cut, doubled, swapped and overwritten bytes must not cause a panic.
#[test]
fn nothing_makes_the_reader_panic() {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut next = move |bound: usize| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state % bound.max(1) as u64) as usize
    };
    let spice = b":{}[]&*!|>'\"%@`,#-? \n\t\\0~.eE+9xk\xc3\xa9\xff";
    for round in 0..3000 {
        let mut bytes = [GOOD, sweep_tests::GOOD][round % 2].as_bytes().to_vec();
        for _ in 0..=next(4) {
            let at = next(bytes.len());
            match next(5) {
                0 => bytes.truncate(at),
                1 => bytes.insert(at, spice[next(spice.len())]),
                2 => {
                    let to = (at + next(30)).min(bytes.len());
                    bytes.drain(at..to);
                }
                3 => {
                    let to = (at + next(60)).min(bytes.len());
                    let part = bytes[at..to].to_vec();
                    let place = next(bytes.len());
                    bytes.splice(place..place, part);
                }
                _ if !bytes.is_empty() => {
                    let place = at.min(bytes.len() - 1);
                    bytes[place] = spice[next(spice.len())];
                }
                _ => {}
            }
            if bytes.is_empty() {
                break;
            }
        }
        let text = String::from_utf8_lossy(&bytes);
        if let Err(error) = read("f.yaml", &text, &[]) {
            assert!(!error.0.is_empty() && !error.to_string().is_empty(), "round {round}");
        }
    }
    for bytes in [
        &b""[..],
        b"\xef\xbb\xbf",
        b"null",
        b"[]",
        b"&a *a",
        b"*a",
        b"a: *b",
        b"? ",
        b"- - - -",
        b"!!int x",
        b"%YAML 9.9",
    ] {
        assert!(read("f.yaml", &String::from_utf8_lossy(bytes), &[]).is_err());
    }
}

#[test]
fn a_key_ignores_names_of_others_and_places() {
    let pipeline = read("p.yaml", GOOD, &[]).unwrap();
    let renamed = GOOD
        .replace("  latents:", "  posteriors:")
        .replace("kind: train.mld,", "kind: train.mld, latents: posteriors, workers: {max: 3},")
        .replace("kind: distill.lcm,", "kind: distill.lcm, latents: posteriors,")
        .replace("kind: distill.pcm,", "kind: distill.pcm, latents: posteriors,")
        .replace("kind: evaluate.latent_fid,", "kind: evaluate.latent_fid, latents: posteriors,");
    let renamed = read("p.yaml", &renamed, &[]).unwrap_or_else(|e| panic!("{e}"));
    let inputs = BTreeMap::from([("vae".to_owned(), Digest::of(b"v")), ("latents".to_owned(), Digest::of(b"l"))]);
    let key =
        |pipeline: &Pipeline, stage: &str| pipeline.identity(pipeline.stage(&stage.into()).unwrap(), &inputs).key();
    assert_eq!(key(&pipeline, "mld"), key(&renamed, "mld"));
    assert_ne!(key(&pipeline, "mld"), key(&pipeline, "lcm"));
    let other_seed = read("p.yaml", GOOD, &["seed=8".to_owned()]).unwrap();
    assert_ne!(key(&pipeline, "mld"), key(&other_seed, "mld"));
}

#[test]
fn a_folder_counts_by_its_content() {
    let at = |path: &str, content: &[u8]| {
        let text = GOOD.replace("{format: synthetic, clips: 10}", &format!("{{format: kit, path: {path}}}"));
        let mut pipeline = read("p.yaml", &text, &[]).unwrap();
        pipeline.fill_external(|_, _| Ok::<_, ()>(Digest::of(content))).unwrap();
        let key = pipeline.identity(&pipeline.stages[0], &BTreeMap::new()).key();
        (key, pipeline.digest())
    };
    assert_eq!(at("a", b"x"), at("b", b"x"));
    assert_ne!(at("a", b"x"), at("a", b"y"));
}

#[test]
fn a_hand_made_pipeline_is_checked() {
    let mut pipeline = read("p.yaml", GOOD, &[]).unwrap();
    pipeline.stages.swap(2, 3);
    assert!(pipeline.check().unwrap_err().contains("which is not an earlier stage"));
    pipeline.stages.swap(2, 3);
    pipeline.stages[3].inputs.clear();
    assert!(pipeline.check().unwrap_err().contains("do not match its settings"));
}

#[test]
fn every_shipped_pipeline_is_valid() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut seen = 0;
    let folders = ["configs", "docs/results"].map(|folder| std::fs::read_dir(root.join(folder)).unwrap());
    for entry in folders.into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "yaml") {
            let text = std::fs::read_to_string(&path).unwrap();
            let pipeline = read(&path.display().to_string(), &text, &[]).unwrap_or_else(|e| panic!("{e}"));
            pipeline.check().unwrap();
            seen += 1;
        }
    }
    assert!(seen >= 7, "{seen}");
}

/// The commands of the chapter on the papers' rows are not run: training one row takes days of a GPU.
#[test]
fn every_row_of_the_papers_is_valid() {
    let root = Bench::repository();
    let mut rows = 0;
    for line in documented::shell_lines(&book::source(&root).join("papers.md"), None) {
        let words = documented::words(&line);
        if words[..2] != ["trainer", "run"] {
            continue;
        }
        let values = |option: &str| {
            let pairs = words.windows(2).filter(|pair| pair[0] == option);
            pairs.map(|pair| pair[1].clone()).collect::<Vec<_>>()
        };
        let text = std::fs::read_to_string(root.join(&words[2])).unwrap_or_else(|e| panic!("{line}: {e}"));
        let pipeline = read(&words[2], &text, &values("--set")).unwrap_or_else(|e| panic!("{line}: {e}"));
        pipeline.check().unwrap();
        for until in values("--until") {
            assert!(pipeline.stage(&until.as_str().into()).is_some(), "{line}: there is no stage `{until}`");
        }
        rows += 1;
    }
    assert!(rows >= 80, "{rows}");
}

#[test]
fn how_checkpoints_are_kept_is_no_part_of_a_stage_s_key() {
    let kept = GOOD.replace(
        "    steps: 10\n",
        "    steps: 10\n    checkpoint: {every: 5, keep: {best: 2, metric: joint, mode: max}}\n",
    );
    let plain = read("p.yaml", GOOD, &[]).unwrap();
    let kept = read("p.yaml", &kept, &[]).unwrap();
    let vae = |pipeline: &Pipeline| pipeline.stage(&"vae".into()).unwrap().clone();
    let expected = Keep { latest: 2, ended: 0, best: 2, metric: "joint".into(), mode: Mode::Max };
    assert_eq!(vae(&kept).placement.checkpoint.keep, expected);
    let inputs = BTreeMap::from([("dataset".to_owned(), Digest::of(b"d"))]);
    assert_eq!(plain.identity(&vae(&plain), &inputs), kept.identity(&vae(&kept), &inputs));
}

#[test]
fn a_priority_is_part_of_no_digest_and_of_no_key() {
    let plain = read("p.yaml", GOOD, &[]).unwrap();
    let urgent = read("p.yaml", GOOD, &["priority=-7".to_owned()]).unwrap();
    assert_eq!((plain.priority, urgent.priority), (0, -7));
    assert_eq!(plain.digest(), urgent.digest());
    let vae = |pipeline: &Pipeline| pipeline.identity(pipeline.stage(&"vae".into()).unwrap(), &BTreeMap::new());
    assert_eq!(vae(&plain), vae(&urgent));
    let again: Pipeline = serde_json::from_value(serde_json::to_value(&urgent).unwrap()).unwrap();
    assert_eq!(again, urgent);
    for priority in [101, -101] {
        let expected = format!("`priority` is {priority}; expected -100 to 100");
        let mistakes = read("p.yaml", GOOD, &[format!("priority={priority}")]).unwrap_err();
        assert!(mistakes.to_string().contains(&expected), "{mistakes}");
        assert_eq!(Pipeline { priority, ..plain.clone() }.check(), Err(expected));
    }
}

#[test]
fn a_pipeline_keeps_the_code_versions_that_it_was_read_with() {
    let now = read("p.yaml", GOOD, &[]).unwrap();
    let recon = now.stage(&"recon".into()).unwrap();
    let version = |pipeline: &Pipeline| pipeline.identity(recon, &BTreeMap::new()).code_version;
    assert_eq!(version(&now), recon.settings.code_version());
    assert!(version(&now) > 1, "the kind has changed since");
    let mut before = serde_json::to_value(&now).unwrap();
    before["code_versions"][recon.settings.kind()] = 1.into();
    let read: Pipeline = serde_json::from_value(before).unwrap();
    read.check().unwrap();
    assert_eq!(version(&read), 1, "a run that goes on keeps the keys that it has");
    let newer = Pipeline { code_versions: BTreeMap::from([("train.vae".to_owned(), 99)]), ..now };
    assert!(newer.check().unwrap_err().contains("`train.vae` at code version 99"));
}
