//! `trainer demo`: the models that come with the program load, draw, and are as good as their file says.

use std::fs;

use cluster_tests::Bench;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// Largest size of the models' file.
const LARGEST: u64 = 3_000_000;
/// Largest difference of the shares that are recognised: the file's is of the models before rounding, of 200 motions.
const NOISE: f64 = 0.04;

#[test]
fn a_demo_draws_from_an_empty_folder() {
    let size = fs::metadata(Bench::repository().join("trainer/demo/models.pack")).expect("the models").len();
    assert!(size <= LARGEST, "the models have {size} bytes");
    let bench = Bench::new(TRAINER);
    let said = bench.run(&["demo"]).expect_code(0);
    for part in ["stride-demo/demo.html", "stride-demo/demo.png", "stride-demo/demo.gif", "trainer demo --train"] {
        assert!(said.stdout.contains(part), "{}", said.stdout);
    }
    let page = fs::read_to_string(bench.path().join("stride-demo/demo.html")).expect("the page");
    for part in ["a person jumps up", "teacher", "student"] {
        assert!(page.contains(part), "`{part}` is missing on the page");
    }
    let sheet = fs::read(bench.path().join("stride-demo/demo.png")).expect("the sheet");
    assert!(sheet.starts_with(b"\x89PNG") && sheet.len() > 20_000, "{} bytes", sheet.len());

    let film = fs::read(bench.path().join("stride-demo/demo.gif")).expect("the moving picture");
    assert!(film.starts_with(b"GIF89a") && (50_000..600_000).contains(&film.len()), "{} bytes", film.len());

    // A second call adds no second version, and its sentences are drawn.
    let said = bench.run(&["demo", "a person claps", "-o", "json"]).expect_code(0).json();
    assert_eq!(said["models"], serde_json::json!(["demo-teacher:1", "demo-student:1"]));
    let store = ["--store", "stride-demo/store"];
    let models = bench.run(&[&["registry", "list", "-o", "json"], &store[..]].concat()).expect_code(0).json();
    let versions: Vec<_> =
        models["models"].as_array().expect("models").iter().map(|model| &model["versions"]).collect();
    assert_eq!(versions, [1, 1], "{models}");
    let draw = |prompt| {
        let command = ["generate", prompt, "--model", "demo-student:1", "-o", "clap.npy"];
        bench.run(&[&command, &store[..]].concat()).expect_code(0).stderr
    };
    let said = draw("a person claps");
    assert!(!said.contains("note:"), "the suggested sentence is known: {said}");
    let said = draw("a person claps gleefully");
    assert!(said.contains("`gleefully` did not occur") && said.contains("claps"), "{said}");
}

/// Measures the student as the quickstart did.
#[test]
fn the_models_of_the_demo_are_as_good_as_their_file_says() {
    let bench = Bench::new(TRAINER);
    bench.run(&["demo", "a person jumps up"]).expect_code(0);
    let quickstart = fs::read_to_string(Bench::config("quickstart.yaml")).expect("the quickstart");
    let (_, activities) = quickstart.split_once("    activities: &activities\n").expect("activities");
    let (activities, _) = activities.split_once("  activities: {").expect("the next stage");
    let pipeline = format!(
        "name: check\nseed: 1234\ndataset: {{format: synthetic, clips: 800}}\nstages:\n  check:\n    kind: \
         evaluate.recognition\n    model: demo-student:1\n    sampler: {{steps: 1, guidance: 2, footing: true}}\n    \
         activities:\n{activities}"
    );
    fs::write(bench.path().join("check.yaml"), pipeline).expect("written");
    let store = ["--store", "stride-demo/store"];
    let run = bench.run(&[&["run", "check.yaml", "--workers", "1", "-o", "json"], &store[..]].concat());
    let run = run.expect_code(0).json();
    let stage = run["stages"].as_array().expect("stages").iter().find(|stage| stage["name"] == "check");
    let found = stage.expect("the check")["metrics"]["accuracy"].as_f64().expect("a share");
    let show = bench.run(&[&["registry", "show", "demo-student:1", "-o", "json"], &store[..]].concat());
    let said = show.expect_code(0).json()["version"]["metrics"]["accuracy"].as_f64().expect("the file's");
    println!("recognised: {found} now, {said} in the file");
    assert!((found - said).abs() <= NOISE, "recognised: {found} now, {said} in the file");
    assert!(said >= 0.8, "a person must recognise the motions: {said}");
}
