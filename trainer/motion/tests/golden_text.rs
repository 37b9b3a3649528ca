//! Checks `golden/text`: every `*.json` there holds caption lines and their expected results.

mod shared;

use motion::text::{Caption, POS_CLASSES, padded_tokens, pos_class};
use serde_json::Value;

fn strings(value: &Value) -> Vec<String> {
    value.as_array().expect("an array").iter().map(|v| v.as_str().expect("a string").to_owned()).collect()
}

#[test]
fn golden_text() {
    let Some(folder) = shared::data("golden/text") else { return };
    let mut cases = 0;
    let mut files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|f| f.unwrap().path()).collect();
    files.sort();
    for file in files.iter().filter(|f| f.extension().is_some_and(|e| e == "json")) {
        let content = std::fs::read_to_string(file).unwrap();
        let expected: Value = serde_json::from_str(&content).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        if let Some(classes) = expected.get("pos_enumerator").and_then(Value::as_object) {
            for (name, number) in classes {
                assert_eq!(POS_CLASSES[number.as_u64().unwrap() as usize], name);
            }
        }
        for case in expected["cases"].as_array().unwrap_or_else(|| panic!("{}: no `cases`", file.display())) {
            let line = case["line"].as_str().expect("a line");
            let caption = Caption::parse(line).unwrap_or_else(|e| panic!("{line}: {e}"));
            assert_eq!(caption.text, case["caption"], "{line}");
            assert_eq!(caption.tokens, strings(&case["tokens"]), "{line}");
            assert_eq!((Some(caption.from_s), Some(caption.to_s)), (case["f_tag"].as_f64(), case["to_tag"].as_f64()));
            let (padded, sent_len) = padded_tokens(&caption.tokens);
            assert_eq!(padded, strings(&case["padded_tokens"]), "{line}");
            assert_eq!(Some(sent_len as u64), case["sent_len"].as_u64(), "{line}");
            let classes: Vec<u64> = padded.iter().map(|token| pos_class(token) as u64).collect();
            let wanted: Vec<u64> = case["pos_class"].as_array().unwrap().iter().map(|v| v.as_u64().unwrap()).collect();
            assert_eq!(classes, wanted, "{line}");
            assert_eq!(Some(caption.is_whole()), case["whole_clip"].as_bool(), "{line}");
            let (from, to) = caption.frames(20.0).unwrap_or((0, 0));
            let frames: Vec<u64> =
                case["crop_frames_20fps"].as_array().unwrap().iter().map(|v| v.as_u64().unwrap()).collect();
            assert_eq!(vec![from as u64, to as u64], frames, "{line}");
            println!("{}: exact", caption.text);
            cases += 1;
        }
    }
    assert!(cases > 0, "no case in {}", folder.display());
}
