//! Errors about a dataset's folder do not quote its files.

use std::fs;

use motion::folder_digest::folder_digest;
use motion::{DataPath, Dataset, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};

const CANARY: &str = "qzcanaryzq";

#[test]
fn a_broken_folder_is_named_and_not_quoted() {
    let dataset = synthetic::generate(&DataSynthetic { clips: 8, ..DataSynthetic::default() }, Seed(1));
    let id = dataset.clips[0].id.clone();
    let texts = [
        ("train.txt".to_owned(), format!("../{CANARY}\n")),
        (format!("texts/{id}.txt"), format!("{CANARY}\n")),
        (format!("texts/{id}.txt"), format!("a#{CANARY}#0#0\n")),
        (format!("texts/{id}.txt"), format!("a#a/DET#{CANARY}#0\n")),
        (format!("new_joint_vecs/{id}.npy"), CANARY.to_owned()),
        ("Mean.npy".to_owned(), format!("\u{93}NUMPY{CANARY}")),
        ("Std.npy".to_owned(), CANARY.to_owned()),
    ];
    let header = format!("{{'descr': '{CANARY}', 'fortran_order': False, 'shape': (263,), }}\n");
    let array = [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes()].concat();
    let files = texts.into_iter().map(|(name, text)| (name, text.into_bytes())).chain([("Mean.npy".to_owned(), array)]);
    for (name, bytes) in files {
        let folder = tempfile::tempdir().expect("a folder");
        synthetic::write_folder(&dataset, folder.path()).expect("written");
        fs::write(folder.path().join(&name), bytes).expect("written");
        let path = DataPath::local(folder.path());
        let said = Dataset::open(&path, DataFormat::Humanml3d).expect_err("a broken folder").to_string();
        assert!(said.contains(&name) && !said.contains(CANARY), "{name}: {said}");
        if let Err(error) = folder_digest(&path, DataFormat::Humanml3d) {
            assert!(!error.to_string().contains(CANARY), "{name}: {error}");
        }
    }
}
