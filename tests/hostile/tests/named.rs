//! Hostile files are refused, and files that would run a command run none. `tests/fuzz.rs` starts with the same files
//! and checks the limits of memory and time.

use std::path::Path;

use hostile::targets::TARGETS;
use hostile::{named, scratch};
use mocap::bvh::Bvh;
use motion::npy;
use text_models::{ReadAt, WeightsFile};

#[test]
fn every_one_is_refused() {
    let mut tried = 0;
    for target in TARGETS {
        for (what, bytes) in (target.named)() {
            assert!(!(target.run)(&bytes), "{}: {what}: it was accepted", target.name);
            tried += 1;
        }
    }
    assert!(tried > 30, "{tried} files");
    assert!(!scratch::folder().join("ran").exists(), "a pickle was run");
}

#[derive(Debug)]
struct Bytes(Vec<u8>);

impl ReadAt for Bytes {
    fn bytes(&self) -> u64 {
        self.0.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        self.0[..].read_at(offset, out)
    }
}

/// Errors name the file or the position, the value found and the value expected.
#[test]
fn what_is_wrong_is_said() {
    protocol::show_excerpts();
    let file =
        |all: Vec<named::Named>, what: &str| all.into_iter().find(|(name, _)| *name == what).expect("a named file").1;
    let bvh = |what: &str| Bvh::parse(Path::new("x.bvh"), &file(named::bvh(), what)).expect_err(what).to_string();
    assert_eq!(bvh("a million channels"), "x.bvh:4: `r` has 1000000 channels; expected at most 6");
    assert!(
        bvh("joints nested 100,000 deep").ends_with("more than 512 levels deep, the largest supported depth"),
        "{}",
        bvh("joints nested 100,000 deep")
    );
    let npy = npy::parse(Path::new("x.npy"), &file(named::npy(), "2^60 numbers"), true).expect_err("huge").to_string();
    assert!(npy.contains("x.npy: has 0 bytes of data for shape [1152921504606846976]"), "{npy}");
    let header = WeightsFile::open(Bytes(file(named::safetensors(), "a header of 2^60 bytes"))).expect_err("huge");
    assert_eq!(header, "declares a header of 1152921504606846976 bytes, but has 10 bytes; expected a safetensors file");
    let rules =
        text_models::Rules { repair: false, strip: false, lower: false, first: Some(4), end: 5, pad: 5, most: 6 };
    let tokens =
        text_models::Tokenizer::new("t.json", &file(named::tokenizer(), "six hundred thousand tokens"), &rules, 7);
    let said = tokens.expect_err("huge").to_string();
    assert!(
        said.starts_with("t.json: ") && said.contains("`model.vocab` has 600000 entries; expected at most 500000"),
        "{said}"
    );
}
