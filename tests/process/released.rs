//! Import and export of weights on the command line: the book's commands, with a checkpoint of the fixtures in place of
//! the released one.

use std::fs;
use std::path::{Path, PathBuf};

use cluster_tests::documented::{run_by, words};
use cluster_tests::{Bench, digests};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// The recipe at toy size, with another checkpoint and synthetic clips.
fn pipeline(checkpoint: &Path) -> String {
    format!(
        "name: motionlcm-released
dataset: {{format: synthetic, clips: 32, val: 0.1, test: 0.2}}
text: {{encoder: hashed}}
stages:
  vae: {{kind: import.model, part: vae, path: {0}, dataset: dataset}}
  lcm: {{kind: import.model, part: lcm, path: {0}}}
  latents: {{kind: encode.latents, crops: 1}}
  fid: {{kind: evaluate.latent_fid, model: lcm, sampler: {{steps: 1, guidance: 7, timesteps: [799]}}, repeats: 1, components: 4}}
  release: {{kind: register, model: motionlcm-released, from: lcm, promote: {{to: staging}}}}
",
        checkpoint.display()
    )
}

/// The fixture; its sizes are those of the recipe except for widths.
fn checkpoint() -> Option<PathBuf> {
    fixtures::data("parity/02_control_v2_lcm/weights.ckpt")
}

/// Creates a folder with a mean and a deviation of HumanML3D's features.
fn statistics(dir: &Path) -> String {
    let folder = dir.join("meta");
    fs::create_dir_all(&folder).expect("a test's own files");
    for (name, value) in [("mean.npy", 0.0), ("std.npy", 1.0)] {
        motion::npy::write(&folder.join(name), &[263], &[value; 263]).expect("a test's own files");
    }
    folder.display().to_string()
}

#[test]
fn weights_go_in_and_out_as_the_book_says() {
    let Some(checkpoint) = checkpoint() else { return };
    let bench = Bench::new(TRAINER);
    let dir = bench.path();
    let file = dir.join("released.yaml");
    fs::write(&file, pipeline(&checkpoint)).expect("a test's own files");
    let mut reports = Vec::new();
    for line in run_by(&Bench::repository(), "tests/process/released.rs") {
        println!("$ {line}");
        let line = line.replace("configs/motionlcm-released.yaml", &file.display().to_string());
        let line = line
            .replace("deps/motionlcm/meta", &statistics(dir))
            .replace("sentence-t5=data/sentence-t5-large", "hashed");
        let words = words(&line);
        let mut words: Vec<&str> = words.iter().map(String::as_str).collect();
        // `trainer registry` is the same as `registry`.
        if words[0] == "trainer" {
            words.remove(0);
        }
        reports.push(bench.run(&[&words[..], &["-o", "json"]].concat()).expect_code(0).json());
    }
    assert_eq!(reports.len(), 4);
    let version = bench.run(&["registry", "show", "motionlcm:1", "-o", "json"]).expect_code(0).json();
    assert!(version["manifest"]["files"]["vae/model.safetensors"].is_object(), "{version}");
    // Exported weights are imported again and give the same bits.
    for (i, exported) in ["motionlcm.ckpt", "motionlcm.safetensors"].into_iter().enumerate() {
        let again = dir.join(format!("{i}.yaml"));
        fs::write(&again, pipeline(&dir.join(exported))).expect("a test's own files");
        let report = bench.run(&["run", &again.display().to_string(), "-o", "json"]).expect_code(0).json();
        assert_eq!(digests(&report), digests(&reports[0]), "{exported}");
    }
    // An existing file is not overwritten, and a layout of other models is refused.
    let export = |more: &[&str]| bench.run(&[&["registry", "export", "motionlcm-released@staging"], more].concat());
    let said = export(&["motionlcm.ckpt", "--layout", "motionlcm"]);
    assert!(said.code == Some(1) && said.stderr.contains("motionlcm.ckpt"), "{}", said.stderr);
    let said = export(&["momask", "--layout", "momask"]).expect_code(2);
    assert!(said.stderr.contains("does not support the model's parts"), "{}", said.stderr);
}
