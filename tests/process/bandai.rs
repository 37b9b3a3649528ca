//! The public set as a newcomer meets it: the pipeline names the command, the command asks for the licence, and the
//! recipe trains on what it fetched. The network is a server on a loopback port, or a folder in place of it.

use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use cluster_tests::{Bench, states};
use serde_json::json;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Two updates at toy sizes. Fifteen validation clips span few directions.
const TOY: [&str; 22] = [
    "stages.dataset.mirror=false",
    "stages.vae.network={width: 16, layers: 1, heads: 2, feed_forward: 32, dropout: 0, positions: sinusoid}",
    "stages.vae.latent={tokens: 4, dim: 8}",
    "stages.vae.steps=2",
    "stages.vae.warmup=0",
    "stages.vae.windows.batch=4",
    "stages.vae.batch={global: 4, slices: 2}",
    "stages.latents.crops=2",
    "stages.mld.network={width: 16, layers: 1, heads: 2, feed_forward: 32, dropout: 0}",
    "stages.mld.steps=2",
    "stages.mld.warmup=0",
    "stages.mld.batch={global: 8, slices: 2}",
    "stages.pcm.steps=2",
    "stages.pcm.warmup=0",
    "stages.pcm.batch={global: 8, slices: 2}",
    "stages.fid_teacher_val.components=4",
    "stages.fid_teacher_val.sampler.steps=2",
    "stages.fid_val.components=4",
    "stages.fid_teacher.components=4",
    "stages.fid_teacher.sampler.steps=2",
    "stages.fid_test.components=4",
    "stages.activities_val.motions=10",
];

/// Unpacks the recordings of the first part of the set, if they are on this machine.
fn recordings(folder: &Path) -> Option<()> {
    let archive = fixtures::data("bandai/dataset-1.tar.xz")?;
    fs::create_dir_all(folder).expect("created");
    let mut tar = Command::new("tar");
    let status = tar.arg("-C").arg(folder).arg("-xf").arg(archive).status().expect("tar runs");
    assert!(status.success(), "tar unpacks the recordings");
    Some(())
}

#[test]
fn a_newcomer_is_led_from_the_recipe_to_the_data() {
    let bench = Bench::new(TRAINER);
    let recipe = Bench::config("bandai.yaml");
    let said = bench.run(&["run", &recipe]).expect_code(2);
    assert!(said.stderr.contains("`trainer data fetch bandai data/bandai` fetches it"), "{}", said.stderr);
    assert!(!bench.store().exists(), "nothing was started");

    let listed = bench.run(&["data", "list", "-o", "json"]).expect_code(0).json();
    assert_eq!((&listed[0]["name"], &listed[0]["fetched"]), (&json!("bandai"), &json!(true)));
    let said = bench.run(&["data", "fetch", "lafan1"]).expect_code(2);
    assert!(said.stderr.contains("this command does not fetch `lafan1`"), "{}", said.stderr);

    // No terminal can be asked.
    let said = bench.run(&["data", "fetch", "bandai"]).expect_code(2);
    for part in ["CC BY-NC 4.0", "the licence of `bandai` was not accepted; nothing was fetched", "--accept-licence"] {
        assert!(said.stderr.contains(part), "{part}: {}", said.stderr);
    }
    assert!(!bench.path().join("data").exists());

    let address = server("HTTP/1.1 200 OK\r\ncontent-length: 6\r\nconnection: close\r\n\r\n<html>");
    let fetch = ["data", "fetch", "bandai", "--accept-licence", "--url", &address];
    let said = bench.run(&fetch).expect_code(9);
    assert!(said.stderr.contains("not a complete .tar.gz archive"), "{}", said.stderr);
    assert!(!bench.path().join("data/bandai").exists(), "nothing looks complete");
    let away = server("HTTP/1.1 404 No\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
    // The licence was accepted for the unfinished set.
    let said = bench.run(&["data", "fetch", "bandai", "--url", &away]).expect_code(1);
    assert!(said.stderr.contains("the server answered 404"), "{}", said.stderr);
}

/// Answers every request with the same text. Returns the address.
fn server(answer: &'static str) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = format!("http://{}/set.tar.gz", listener.local_addr().expect("bound"));
    std::thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let lines = BufReader::new(stream.try_clone().expect("cloned")).lines();
            let _ = lines.map_while(Result::ok).take_while(|line| !line.is_empty()).count();
            // A client that has enough closes the connection.
            let _ = stream.write_all(answer.as_bytes());
        }
    });
    address
}

#[test]
fn the_recipe_trains_on_what_was_fetched() {
    let bench = Bench::new(TRAINER);
    let Some(()) = recordings(&bench.path().join("clone/data")) else { return };
    let fetch = ["data", "fetch", "bandai", "--accept-licence", "--from", "clone"];
    let said = bench.run(&fetch).expect_code(9);
    assert!(said.stderr.contains("clone: lacks 2491 of 2642 files"), "{}", said.stderr);
    let said = bench.run(&[&fetch[..], &["--partial", "-o", "json"]].concat()).expect_code(0).json();
    let left_out = json!({"not_listed": 435, "missing": 2491, "too_short_to_train": 5});
    assert_eq!((&said["files"], &said["left_out"]), (&json!(151), &left_out), "{said}");
    assert!(!bench.path().join("data/bandai.part").exists());

    let mut sets: Vec<String> = TOY.iter().map(|set| (*set).to_owned()).collect();
    // The first part of the set has neither raised hands nor turns, and few bows.
    let activities = "[{name: goodbye, words: [goodbye, bye bye]}, {name: show the way, words: [shows the way, showing \
                      the way, guides]}, {name: run, words: [runs, running, jogs, sprints, sprinting, dashes]}, {name: \
                      walk, words: [walks, walking, strolls, steps back], sheet: true}]";
    for stage in ["activities_val", "activities"] {
        sets.push(format!("stages.{stage}.activities={activities}"));
        sets.push(format!("stages.{stage}.motions=8"));
    }
    for stage in ["fid_teacher_val", "fid_val", "fid_teacher", "fid_test"] {
        sets.push(format!("stages.{stage}.repeats=1"));
    }
    // After a few updates no motion shows its sentence.
    sets.push("stages.release.promote.require=[]".to_owned());
    let arguments: Vec<&str> = sets.iter().flat_map(|set| ["--set", set.as_str()]).collect();
    let report = bench.pipeline("bandai.yaml", &arguments);
    let states = states(&report);
    assert!(states.values().all(|state| state == "ran"), "{states:?}");
    let shown = bench.run(&["registry", "show", "bandai@staging"]).expect_code(0).stdout;
    assert!(shown.contains("fid_val ") && shown.contains("fid_test ") && shown.contains(" 1 step,"), "{shown}");

    // Words that its captions lack are named, with captions that it knows.
    let generate = ["generate", "quantum flapdoodle", "--model", "bandai@staging", "-o", "u.npy", "-o", "json"];
    let said = bench.run(&generate).expect_code(0);
    let row = said.json();
    assert_eq!((&row["known"], &row["unknown_words"]), (&json!(false), &json!(["quantum", "flapdoodle"])));
    assert_eq!(row["nearest_known"].as_array().map(Vec::len), Some(3), "{row}");
    assert!(said.stderr.contains("`quantum`, `flapdoodle` did not occur in the training"), "{}", said.stderr);
    let said = bench.run(&["generate", "an angry person bows", "--model", "bandai@staging", "-o", "u.npy"]);
    assert!(!said.expect_code(0).stderr.contains("did not occur"));
}
