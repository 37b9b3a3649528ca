//! Every numeric setting of every kind, tested with numbers that no setting should accept.

use std::ops::RangeBounds as _;

use protocol::stage::*;
use protocol::{ArtifactKind, Digest, Steps};
use serde_json::{Value, json};

use crate::ranges::{Place, Range};
use crate::*;

/// Each of these replaces a setting. Sampled: every third one, a different third for each setting; all with
/// `STRIDE_LONG_TESTS=1`.
const NUMBERS: &[&str] = &[
    "0",
    "1",
    "2147483648",
    "9007199254740992",
    "9223372036854775808",
    "18446744073709551615",
    "-1",
    ".nan",
    ".inf",
    "1e308",
];

/// A stage of each kind, with a value for each numeric setting, such that all fit together.
fn stages() -> Vec<(String, StageSettings)> {
    let sampler = Sampler { steps: 1, guidance: 7.5, timesteps: vec![999], ..Sampler::default() };
    let mut stages = vec![
        ("folder", StageSettings::DataOpen(DataOpen { path: "data".into(), ..DataOpen::default() })),
        ("recorded", StageSettings::DataFeatures(DataFeatures { path: "mocap".into(), ..DataFeatures::default() })),
        ("made", StageSettings::DataSynthetic(DataSynthetic::default())),
        ("words", StageSettings::TextEmbed(TextEmbed::default())),
        ("vae", StageSettings::TrainVae(TrainVae::default())),
        ("latents", StageSettings::EncodeLatents(EncodeLatents::default())),
        ("mld", StageSettings::TrainMld(TrainMld::default())),
        ("lcm", StageSettings::DistillLcm(DistillLcm::default())),
        ("pcm", StageSettings::DistillPcm(DistillPcm::default())),
        ("recon", StageSettings::EvaluateReconstruction(EvaluateReconstruction::default())),
        (
            "fid",
            StageSettings::EvaluateLatentFid(EvaluateLatentFid {
                model: "lcm".into(),
                sampler: sampler.clone(),
                ..EvaluateLatentFid::default()
            }),
        ),
        ("tokenizer", StageSettings::TrainTokenizer(TrainTokenizer::default())),
        ("tokens", StageSettings::EncodeTokens(EncodeTokens::default())),
        (
            "generator",
            StageSettings::TrainTokens(TrainTokens { generator: TokenGenerator::Masked, ..TrainTokens::default() }),
        ),
        (
            "flow",
            StageSettings::ModelDecoder(ModelDecoder { model: "generator".into(), decoder: "train_discord".into() }),
        ),
        ("control", StageSettings::TrainControl(TrainControl::default())),
        (
            "jumps",
            StageSettings::DistillDiscord(DistillDiscord { teacher: "train_discord".into(), ..Default::default() }),
        ),
        ("one_fold", StageSettings::DataFold(DataFold { fold: 1, ..DataFold::default() })),
        ("evaluator", StageSettings::TrainEvaluator(TrainEvaluator::default())),
        ("imported", StageSettings::ImportEvaluator(ImportEvaluator { path: "t2m".into(), ..Default::default() })),
        (
            "released",
            StageSettings::ImportModel(ImportModel {
                path: "vae.ckpt".into(),
                statistics: "meta".into(),
                ..ImportModel::default()
            }),
        ),
        ("t2m", StageSettings::EvaluateT2m(EvaluateT2m { model: "lcm".into(), sampler, ..EvaluateT2m::default() })),
    ];
    let register = Register { model: "m".into(), from: vec!["lcm".into()], ..Register::default() };
    stages.push(("out", StageSettings::Register(register)));
    // A kind that is not listed here is tested with its defaults.
    let named: Vec<&str> = stages.iter().map(|(_, settings)| settings.kind()).collect();
    let others: Vec<StageSettings> =
        StageSettings::all().into_iter().filter(|settings| !named.contains(&settings.kind())).collect();
    let mut stages: Vec<(String, StageSettings)> =
        stages.into_iter().map(|(name, settings)| (name.to_owned(), settings)).collect();
    stages.extend(others.into_iter().map(|settings| (settings.kind().replace('.', "_"), settings)));
    stages
}

/// Pointers to the numbers in `value`.
fn numbers(value: &Value, at: &str, found: &mut Vec<String>) {
    match value {
        Value::Object(map) => map.iter().for_each(|(key, value)| numbers(value, &format!("{at}/{key}"), found)),
        Value::Array(items) => {
            items.iter().enumerate().for_each(|(i, value)| numbers(value, &format!("{at}/{i}"), found));
        }
        Value::Number(_) => found.push(at.to_owned()),
        _ => {}
    }
}

/// The settings of a stage as one line of YAML.
fn flow(value: &Value) -> String {
    match value {
        Value::Object(map) => {
            let entries: Vec<String> = map.iter().map(|(key, value)| format!("{key}: {}", flow(value))).collect();
            format!("{{{}}}", entries.join(", "))
        }
        Value::Array(items) => format!("[{}]", items.iter().map(flow).collect::<Vec<_>>().join(", ")),
        other => other.to_string(),
    }
}

fn file(stages: &[(String, Value)]) -> String {
    let mut text = "name: p\ndataset: {format: synthetic}\nstages:\n".to_owned();
    for (name, value) in stages {
        text += &format!("  {name}: {}\n", flow(value));
    }
    text
}

/// Settings that a stage must write because they differ from the default.
fn differing(stage: &Value) -> Value {
    let default = StageSettings::all().into_iter().map(|settings| serde_json::to_value(settings).unwrap());
    let default = default.into_iter().find(|default| default["kind"] == stage["kind"]).unwrap();
    let map = stage.as_object().unwrap().iter();
    map.filter(|(key, value)| *key == "kind" || default.get(*key).is_some_and(|default| default != *value))
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect()
}

/// The path without indices.
fn path(pointer: &str) -> String {
    let keys = pointer.trim_start_matches('/').split('/').filter(|key| key.parse::<usize>().is_err());
    keys.collect::<Vec<_>>().join(".")
}

/// The range beside the field at `pointer` of a stage. A number without one fails the test.
fn range(stage: &Value, pointer: &str) -> Range {
    let keys: Vec<&str> = pointer.trim_start_matches('/').split('/').collect();
    let kind = stage["kind"].as_str().unwrap();
    let top = if ["workers", "requires", "checkpoint"].contains(&keys[0]) {
        Place::of_placement()
    } else {
        Place::of_kind(kind)
    };
    let step =
        |place: Place<'static>, key: &&str| if key.parse::<usize>().is_ok() { place.entry() } else { place.key(key) };
    let place = keys.iter().fold(top, step);
    place
        .range
        .unwrap_or_else(|| panic!("`{}` of `{kind}` has no `schemars(range(..))` beside its field", path(pointer)))
}

/// Each stage as JSON as in the file, placement included.
fn written() -> Vec<(String, Value)> {
    let placement = Placement::example();
    let stages = stages().into_iter().map(|(name, settings)| {
        let mut value = serde_json::to_value(&settings).unwrap();
        for key in ["workers", "requires", "checkpoint"] {
            value[key] = placement[key].clone();
        }
        (name, value)
    });
    stages.collect()
}

#[test]
fn the_default_of_every_numeric_setting_lies_in_its_range() {
    for (name, value) in written() {
        let mut found = Vec::new();
        numbers(&value, "", &mut found);
        for pointer in found {
            let path = path(&pointer);
            let number = value.pointer(&pointer).unwrap();
            let range = range(&value, &pointer);
            assert!(range.holds(number), "`{path}` of `{name}` is {number}, outside of {range:?}");
        }
    }
}

#[test]
fn a_number_out_of_range_is_refused_where_it_stands_and_none_breaks_the_reader() {
    let whole = written();
    let brief: Vec<(String, Value)> = whole.iter().map(|(name, value)| (name.clone(), differing(value))).collect();
    let mut base = read("p.yaml", &file(&whole), &[]).unwrap_or_else(|e| panic!("{e}"));
    base.fill_external(|_, _| Ok::<_, ()>(Digest::of(b"x"))).unwrap();
    base.check().unwrap();
    let base = serde_json::to_value(&base).unwrap();
    let step = if fixtures::long("all numbers for every setting") { 1 } else { 3 };
    let mut settings = 0;
    let mut tried = 0;
    let mut refused = 0;
    for (i, (name, value)) in whole.iter().enumerate() {
        let mut found = Vec::new();
        numbers(value, "", &mut found);
        for pointer in &found {
            let range = range(value, pointer);
            settings += 1;
            for number in NUMBERS.iter().skip(settings % step).step_by(step) {
                let mut changed = brief.clone();
                changed[i].1 = value.clone();
                *changed[i].1.pointer_mut(pointer).unwrap() = json!("@@@");
                let text = file(&changed);
                let (line, column) = text
                    .lines()
                    .enumerate()
                    .find_map(|(line, text)| Some((line + 1, text.find("\"@@@\"")? + 1)))
                    .expect("it stands somewhere");
                let text = text.replace("\"@@@\"", number);
                let fits = match range {
                    Range::Whole(from, to) => number.parse::<u64>().is_ok_and(|n| (from..=to).contains(&n)),
                    Range::Real(from, to) => number.parse::<f64>().is_ok_and(|n| (from, to).contains(&n)),
                };
                tried += 1;
                match read("p.yaml", &text, &[]) {
                    Ok(_) => assert!(fits, "{name}{pointer}: {number} was taken"),
                    Err(mistakes) => {
                        refused += 1;
                        let at = |d: &Diagnostic| d.line == line && d.column <= column && column < d.column + 400;
                        assert!(
                            fits || mistakes.0.iter().any(at),
                            "{name}{pointer}: {number} is refused at\n{mistakes}"
                        );
                    }
                }
                // The same value as JSON.
                let Ok(json) = serde_json::from_str::<Value>(number) else { continue };
                let mut changed = base.clone();
                let stages = changed["stages"].as_array_mut().unwrap();
                let stage = stages.iter_mut().find(|stage| stage["name"] == *name).unwrap();
                let under = if pointer.starts_with("/workers") || pointer.starts_with("/checkpoint") {
                    "placement"
                } else {
                    "settings"
                };
                *stage[under].pointer_mut(pointer).unwrap() = json;
                let Ok(pipeline) = serde_json::from_value::<Pipeline>(changed) else { continue };
                let verdict = pipeline.check();
                assert!(fits || verdict.is_err(), "{name}{pointer}: {number} was taken as JSON");
            }
        }
    }
    println!("{tried} values tried, {refused} refused");
    assert!(tried > 1_000 / step && refused > tried / 3, "{tried} tried, {refused} refused");
}

#[test]
fn settings_that_are_each_in_range_are_bounded_together() {
    let refuse = |sets: &[&str], part: &str| {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let shown = read("p.yaml", &file(&written()), &sets).unwrap_err().to_string();
        assert!(shown.contains(part), "{sets:?}: {shown}");
    };
    refuse(&["vae.network={width: 16384, heads: 4, layers: 255, feed_forward: 65536}"], "parameters; expected at most");
    refuse(&["t2m.multimodality={captions: 1000, samples: 1000, pairs: 10}"], "is 20000000; expected at most 1000000");
    refuse(&["fid.repeats=100", "fid.samples=100"], "is 10000; expected at most 1000");
    let mut sharded = written();
    let (_, latents) = sharded.iter().find(|(name, _)| name == "latents").unwrap().clone();
    for i in 0..11 {
        let mut more = latents.clone();
        more["shards"] = json!(10_000);
        sharded.push((format!("more{i}"), more));
    }
    let shown = read("p.yaml", &file(&sharded), &[]).unwrap_err().to_string();
    assert!(shown.contains("stage `more9`: the pipeline has more than 100000 shards"), "{shown}");
}

/// Pipelines that no file can contain, but a client can send.
#[test]
fn a_pipeline_that_came_as_json_keeps_the_same_bounds() {
    let mut good = read("p.yaml", &file(&written()), &[]).unwrap();
    good.fill_external(|_, _| Ok::<_, ()>(Digest::of(b"x"))).unwrap();
    good.fill_external(|_, _| Ok::<_, ()>(Digest::of(b"y"))).unwrap();
    good.check().unwrap();
    let refuse = |part: &str, change: &dyn Fn(&mut Pipeline)| {
        let mut bad = good.clone();
        change(&mut bad);
        let said = bad.check().expect_err(part);
        assert!(said.contains(part) && !said.contains(|c: char| c.is_control() && c != '\n'), "{part}: {said:?}");
    };
    for name in ["../../a", "a/b", "a\u{1b}[31m", "A", "", ".", "vae.t00.r0", "a\nb", &"x".repeat(65)] {
        refuse("is not a valid stage name", &|p| p.stages[0].name = name.into());
    }
    for name in ["../p", "p\u{7}", "", "p q"] {
        refuse("is not a valid pipeline name", &|p| p.name = name.into());
    }
    refuse("0 stages", &|p| p.stages.clear());
    refuse("1001 stages", &|p| p.stages = vec![p.stages[0].clone(); 1001]);
    refuse("two stages are called", &|p| p.stages.insert(1, p.stages[0].clone()));
    refuse("has a control character", &|p| {
        let StageSettings::DataOpen(s) =
            &mut p.stages.iter_mut().find(|s| s.name.as_str() == "folder").unwrap().settings
        else {
            panic!("a folder")
        };
        s.path = "data\u{1b}]0;title\u{7}".into();
    });
    refuse("workers.max", &|p| p.stages[0].placement.workers.max = usize::MAX);
    refuse("checkpoint.keep.latest", &|p| p.stages[0].placement.checkpoint.keep.latest = usize::MAX);
    refuse("is marked as created by a sweep", &|p| {
        p.stages.iter_mut().find_map(|s| s.settings.training_mut()).unwrap().stop = Some(Steps(1));
    });
    refuse("but its settings have no such input", &|p| {
        let first = p.stages[0].name.clone();
        let input = StageInput { field: "evaluations.x\u{1b}".into(), stage: first, kind: ArtifactKind::Report };
        p.stages.last_mut().unwrap().inputs.push(input);
    });
    refuse("but it does not read", &|p| {
        p.stages[0].external.insert("vae\u{1b}".into(), Digest::of(b"z"));
    });
    refuse("unknown stage kind", &|p| {
        p.code_versions.insert("train.\u{1b}".into(), 1);
    });
}

#[test]
fn a_sweep_that_came_as_json_keeps_the_bounds_of_one_in_a_file() {
    let good = read("p.yaml", crate::sweep_tests::GOOD, &[]).unwrap();
    good.check().unwrap();
    let refuse = |part: &str, change: &dyn Fn(&mut protocol::sweep::Sweep)| {
        let mut bad = good.clone();
        change(bad.stages.iter_mut().find_map(|stage| stage.sweep.as_mut()).unwrap());
        let said = bad.check().expect_err(part);
        assert!(said.contains(part), "{part}: {said}");
    };
    use protocol::sweep::Domain::{Choice, LogUniform, Uniform};
    refuse("`trials` is 18446744073709551615", &|s| s.trials = usize::MAX);
    refuse("`parallel` is 18446744073709551615", &|s| s.parallel = usize::MAX);
    refuse("`rungs.factor` is 18446744073709551615", &|s| s.rungs.factor = u64::MAX);
    refuse("`rungs.first` is 18446744073709551615", &|s| s.rungs.first = Steps(u64::MAX));
    for path in ["kind", "steps", "teacher", "optimizer", "nothing", "a\u{1b}"] {
        refuse("cannot be searched", &|s| {
            s.space.insert(path.into(), Choice(vec![json!(1)]));
        });
    }
    for domain in [Choice(vec![]), Uniform(1.0, 0.0), Uniform(0.0, f64::INFINITY), LogUniform(0.0, 1.0)] {
        refuse("has no values to try", &|s| {
            s.space.insert("ema".into(), domain.clone());
        });
    }
    refuse("list more than 1000 values", &|s| {
        s.space.insert("ema".into(), Choice((0..1001).map(|i| json!(f64::from(i) / 2e3)).collect()));
    });
    refuse("`space` has 0 settings", &|s| s.space.clear());
    refuse("does not measure", &|s| *s.evaluate = StageSettings::TrainVae(TrainVae::default()));
    let mut untrained = good.clone();
    let sweep = untrained.stages.iter_mut().find_map(|stage| stage.sweep.take()).unwrap();
    untrained.stages[0].sweep = Some(sweep);
    assert!(untrained.check().unwrap_err().contains("only a training stage can have a sweep"));
}
