//! The page's own reading of a dataset's clips, beside that of the library: tables of both skeletons, and joints of rows.

use std::collections::BTreeMap;

use browser::{Browser, Window};
use mocap::Body;
use mocap::body::Side;
use motion::{Skeleton, features, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};
use serde_json::{Value, json};

/// The module without its imports, which a page without a server cannot load.
fn module() -> String {
    let file = page::find(page::folder(), "features.js").expect("a file of the page");
    let text = String::from_utf8(file.bytes.clone()).expect("text");
    text.lines().filter(|line| !line.starts_with("import ")).collect::<Vec<_>>().join("\n")
}

fn table(body: &Body) -> Value {
    let letter = |side: &Side| match side {
        Side::Middle => 'm',
        Side::Left => 'l',
        Side::Right => 'r',
    };
    let sides: String = body.sides.iter().map(letter).collect();
    json!({
        "parents": body.parents, "sides": sides, "head": body.head, "fps": body.fps, "metres": body.metres_per_unit,
    })
}

#[test]
fn a_browser_reads_clips_as_the_library_does() {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let mut browser = Browser::start(&program, folder.path());
    browser.open("about:blank", Window { width: 400, height: 300, mobile: false });
    let import = format!("import(URL.createObjectURL(new Blob([{}], {{ type: 'text/javascript' }})))", json!(module()));

    let formats = browser.evaluate(&format!("{import}.then(({{ FORMATS }}) => FORMATS)"));
    let formats: BTreeMap<String, Value> = serde_json::from_value(formats).expect("tables");
    let known = [(DataFormat::Humanml3d, "humanml3d"), (DataFormat::Kit, "kit")];
    assert_eq!(formats.len(), known.len());
    for (format, name) in known {
        let ours = table(&Body::of(Skeleton::of(format)));
        for (key, value) in ours.as_object().expect("a table") {
            let theirs = &formats[name][key];
            let same = value == theirs || value.as_f64().is_some() && value.as_f64() == theirs.as_f64();
            assert!(same, "{name}: {key} is {theirs}, expected {value}");
        }
    }

    let dataset = synthetic::generate(&DataSynthetic { clips: 2, ..DataSynthetic::default() }, Seed(5));
    let rows = &dataset.clips[1].features;
    let expected = features::recover_joints(rows, dataset.skeleton());
    let rows: Vec<f32> = rows.iter().copied().collect();
    let call = format!(
        "{import}.then(({{ FORMATS, recover }}) => [...recover(Float32Array.from({}), FORMATS.humanml3d)])",
        json!(rows)
    );
    let found: Vec<f64> = serde_json::from_value(browser.evaluate(&call)).expect("numbers");
    assert_eq!(found.len(), expected.len());
    assert!(expected.iter().any(|value| value.abs() > 0.5), "it moves");
    for (at, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!((found - f64::from(*expected)).abs() < 1e-4, "coordinate {at}: {found}, expected {expected}");
    }
}
