//! The program `tables` as `docs/results/regenerate.sh` calls it.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn tables(folder: &Path, arguments: &[&str]) -> Output {
    let mut program = Command::new(env!("CARGO_BIN_EXE_tables"));
    program.current_dir(folder).args(arguments).output().expect("the program runs")
}

#[test]
fn a_template_is_filled_and_a_wrong_one_writes_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).expect("written");
    write("run.json", r#"{"stages": [{"name": "a", "metrics": {"fid": 0.25}}]}"#);
    write("pipeline.json", r#"{"stages": []}"#);
    write("good.in.md", "FID {{a fid :2}}\n");
    write("bad.in.md", "FID {{b fid}}\n");
    let filled = tables(folder.path(), &["good.in.md", "run.json", "pipeline.json", "out.md"]);
    assert!(filled.status.success(), "{}", String::from_utf8_lossy(&filled.stderr));
    assert_eq!(fs::read_to_string(folder.path().join("out.md")).expect("the text"), "FID 0.25\n");
    let refused = tables(folder.path(), &["bad.in.md", "run.json", "pipeline.json", "other.md"]);
    assert!(!refused.status.success() && !folder.path().join("other.md").exists());
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.starts_with("error: bad.in.md: line 1") && said.contains("no stage `b`"), "{said}");
    assert!(!tables(folder.path(), &["good.in.md"]).status.success());
}
