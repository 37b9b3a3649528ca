//! The importer of evaluators on arbitrary bytes, for `tests/hostile.rs` and `fuzz/`.

use std::fs;
use std::path::PathBuf;

use burn::tensor::Device;
use motion::{DataPath, npy};
use protocol::stage::{DataFormat, ImportEvaluator, StageSettings};

use super::Bench;
use stages::context::StageError;
use stages::parts::word_vectors::{WORD_WIDTH, Words};

/// Runs the function `name`, and returns true if it accepted the bytes.
///
/// # Panics
/// If there is no such function, or it fails on the bytes in another way than refusing them.
pub fn run(name: &str, bytes: &[u8]) -> bool {
    match name {
        "evaluator" => evaluator(bytes),
        "vocabulary" => vocabulary(bytes),
        other => panic!("`{other}` is none of `evaluator` and `vocabulary`"),
    }
}

/// A word that no error may repeat.
pub const CANARY: &str = "qzcanaryzq";

thread_local! {
    static SCRATCH: tempfile::TempDir = tempfile::tempdir().expect("a folder for temporary files");
}

/// A folder of this thread. Tests run beside each other and write files of the same names.
pub(super) fn folder(name: &str) -> PathBuf {
    let folder = SCRATCH.with(|scratch| scratch.path().join(name));
    fs::create_dir_all(&folder).expect("a folder of ours");
    folder
}

/// True if the bytes were accepted, false if refused. A fault of ours panics.
pub(super) fn accepted<T>(result: Result<T, StageError>) -> bool {
    if let Err(error @ StageError::Fault(_)) = &result {
        panic!("{error}");
    }
    if let Err(error) = &result {
        assert!(!error.to_string().contains(CANARY), "an error quotes the file: {error}");
    }
    result.is_ok()
}

/// Runs `import.evaluator` on weights: a torch file if the first byte is even, safetensors if it is odd.
///
/// # Panics
/// If it fails in another way than refusing them.
pub fn evaluator(bytes: &[u8]) -> bool {
    let Some((which, bytes)) = bytes.split_first() else { return false };
    let root = folder("evaluator");
    let features = motion::Skeleton::of(DataFormat::Humanml3d).features;
    let meta = root.join("Comp_v6_KLD01/meta");
    if !meta.exists() {
        fs::create_dir_all(&meta).expect("a folder of ours");
        for name in ["mean.npy", "std.npy"] {
            npy::write(&meta.join(name), &[features], &vec![1.0; features]).expect("a file of ours");
        }
    }
    let names = ["finest.tar", "finest.safetensors"];
    let (here, other) = if which % 2 == 0 { (names[0], names[1]) } else { (names[1], names[0]) };
    // There is no such file the first time.
    let _ = fs::remove_file(root.join(other));
    fs::write(root.join(here), bytes).expect("a file of ours");
    let path = root.display().to_string();
    let settings = ImportEvaluator { path, format: DataFormat::Humanml3d, words: String::new() };
    let mut bench = Bench::new(Device::flex(), 1, 1);
    accepted(bench.run("evaluator", &StageSettings::ImportEvaluator(settings), &[]))
}

/// Reads the bytes as the pickled index of a vocabulary of four words.
///
/// # Panics
/// If the reader fails in another way than refusing them.
pub fn vocabulary(bytes: &[u8]) -> bool {
    let root = folder("words");
    let vectors = root.join("our_vab_data.npy");
    if !vectors.exists() {
        npy::write(&vectors, &[4, WORD_WIDTH], &vec![0.5; 4 * WORD_WIDTH]).expect("a file of ours");
    }
    fs::write(root.join("our_vab_idx.pkl"), bytes).expect("a file of ours");
    let words = Words::open(Some(&DataPath::local(root)));
    if let Ok(Words::Vocabulary { index, .. }) = &words {
        assert!(index.values().all(|row| *row < 4));
    }
    accepted(words)
}
