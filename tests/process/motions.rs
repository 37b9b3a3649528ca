//! Output of `generate`, `export` and `gallery`, on a store with the models of the smoke pipeline.

use std::fs::{self, File};

use cluster_tests::{Bench, Running, Said};
use serde_json::Value;

/// Parses lines of JSON.
fn lines(said: &Said) -> Vec<Value> {
    said.stdout.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line}: {e}"))).collect()
}

/// Returns one value of every line.
fn column<'a>(lines: &'a [Value], key: &str) -> Vec<&'a Value> {
    lines.iter().map(|line| &line[key]).collect()
}

pub(crate) fn are_written(bench: &Bench) {
    let at = |name: &str| bench.path().join(name);
    fs::write(at("lines.jsonl"), "{\"caption\": \"a person jumps\", \"frames\": 44}\n\"走路\"\n").expect("a file");
    let model = ["--model", "smoke@staging"];
    let several = ["generate", "a person walks", "--captions", "lines.jsonl", "-n", "2", "--seconds", "2.4"];
    let files = ["-o", "m.bvh", "-o", "m.glb", "-o", "m.html", "-o", "json"];
    let said = bench.run(&[&several[..], &model, &files].concat()).expect_code(0);
    assert!(said.stderr.contains("recognises no word of `走路`") && !said.stderr.contains("walks"), "{}", said.stderr);
    let rows = lines(&said);
    assert_eq!(column(&rows, "frames"), [48, 48, 44, 44, 48, 48], "a file's own length comes first");
    assert_eq!(column(&rows, "seed"), [0, 1, 0, 1, 0, 1]);
    assert_eq!(column(&rows, "known"), [true, true, true, true, false, false]);
    assert_eq!(rows[2]["files"], serde_json::json!(["m-03.bvh", "m-03.glb", "m.html"]));
    for file in rows.iter().flat_map(|row| row["files"].as_array().expect("files")) {
        assert!(fs::metadata(at(file.as_str().expect("a name"))).is_ok_and(|file| file.len() > 1000), "{file}");
    }
    let page = fs::read_to_string(at("m.html")).expect("the page");
    assert_eq!((page.matches("<figure>").count(), page.matches("走路").count()), (6, 1));

    // Through a pipe, with the report as text.
    let mut piped = bench.command(&["generate", "--captions", "-", "--model", "smoke@staging", "-o", "p.npy"]);
    piped.stdin(File::open(at("lines.jsonl")).expect("the file"));
    let said = Running::start(piped).wait().expect_code(0);
    assert!(said.stdout.contains("a person jumps") && said.stdout.contains("p-02.npy"), "{}", said.stdout);
    let empty = bench.run(&[&["generate", "", "-o", "e.npy"][..], &model].concat()).expect_code(0);
    assert!(empty.stderr.contains("the sentence is empty"), "{}", empty.stderr);

    // Words that the training data lacks.
    let unknown =
        bench.run(&["generate", "quantum flapdoodle", "--model", "smoke@staging", "-o", "u.npy", "-o", "json"]);
    let row = unknown.json();
    assert_eq!((&row["known"], &row["unknown_words"]), (&false.into(), &serde_json::json!(["quantum", "flapdoodle"])));
    for part in ["`quantum`, `flapdoodle` did not occur in the training of", "nearest known: \""] {
        assert!(unknown.stderr.contains(part), "{}", unknown.stderr);
    }
    assert_eq!(row["nearest_known"].as_array().map(Vec::len), Some(3), "{row}");
    for (sentence, known) in [("a flapdoodle", false), ("a person walks flapdoodle", true)] {
        let partly = bench.run(&["generate", sentence, "--stage", "mld", "-o", "u.npy", "-o", "json"]).json();
        assert_eq!((&partly["known"], &partly["unknown_words"]), (&known.into(), &serde_json::json!(["flapdoodle"])));
    }
    let known = bench.run(&["generate", "a person walks", "--stage", "mld", "-o", "u.npy", "-o", "json"]).json();
    assert_eq!((&known["unknown_words"], &known["nearest_known"]), (&serde_json::json!([]), &serde_json::json!([])));
    let far =
        bench.run(&["generate", "a", "--model", "smoke@staging", "--guidance", "40", "-o", "u.npy"]).expect_code(0);
    assert!(far.stderr.contains("was trained for guidance 0.5 to 5; at 40"), "{}", far.stderr);

    // Convert to other formats and back.
    let said = bench.run(&["export", "p-01.npy", "-o", "x.bvh", "-o", "x.glb", "-o", "json"]).expect_code(0);
    let off = lines(&said)[0]["skeleton_error_m"].as_f64().expect("how far off");
    assert!(off > 0.0 && off < 5.0, "{off}");
    // Unit and axis are given, because the legs of so small a model have no plausible length.
    let back = [
        "export",
        "x.bvh",
        "--unit",
        "0.01",
        "--up",
        "y",
        "--plant-feet",
        "-o",
        "y.npy",
        "-o",
        "y.html",
        "-o",
        "y.gif",
    ];
    let said = bench.run(&back).expect_code(0);
    assert!(said.stdout.contains("44 frames") && said.stdout.contains("joint map"), "{}", said.stdout);

    let gallery = ["gallery", "--prompt", "a person walks", "-n", "2", "-o", "g.html", "--report", "json"];
    let said = bench.run(&gallery).expect_code(0).json();
    let models = said["models"].as_array().expect("models").len();
    assert_eq!(models, 3, "a teacher and two students, of which one is registered: {said}");
    let page = fs::read_to_string(at("g.html")).expect("the page");
    assert_eq!(page.matches("<figure>").count(), 2 * models + 1, "two seeds of each model and a real clip");
    assert!(page.contains("real clip"), "the nearest clip of the training data is beside them");
    let said = bench.run(&[&gallery[..], &["--no-real"]].concat()).expect_code(0).json();
    assert_eq!(said["motions"], 2 * models);

    for (line, words) in [
        (&["generate", "x", "--model", "smoke@staging", "-o", "x.fbx"][..], "ends in .bvh, .glb"),
        (&["generate", "x", "--model", "smoke@staging", "-o", "none/x.glb"], "there is no folder `none`"),
        (
            &["generate", "x x", "y y", "--frames", "40,44,48", "--model", "smoke@staging", "-o", "x.npy"],
            "3 lengths for 2",
        ),
        (&["generate", "--captions", "none.txt", "--model", "smoke@staging", "-o", "x.npy"], "none.txt"),
        (&["export", "m.html", "-o", "x.npy"], "an array (.npy) or a recording (.bvh)"),
        (&["export", "lines.jsonl", "-o", "x.npy"], "an array (.npy)"),
        (&["export", "x.bvh", "--joint-map", "nobodys", "-o", "x.npy"], "`nobodys`"),
        (&["gallery", "-o", "g.glb"], "expected .html or .png"),
    ] {
        let said = bench.run(line).expect_code(2);
        assert!(said.stderr.contains(words), "{line:?}: {}", said.stderr);
    }
}
