//! Exports of imported weights, compared with the original files.

use motion::DataPath;
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use checkpoint::Blobs as _;
use checkpoint::published::Layout;
use protocol::Digest;
use text_models::{StoredTensor, Weights};

use crate::fixtures::name;
use crate::world::{World, text_of};

/// Writes the files of a layout below `folder`, and returns them by name.
pub(crate) fn exported(world: &World, digest: Digest, layout: Layout) -> BTreeMap<&'static str, PathBuf> {
    let (manifest, blobs) = (world.manifest(digest), world.bench.blobs());
    let folder = world.folder.path().join(format!("{}-{}", layout.name(), digest.short()));
    std::fs::create_dir_all(&folder).expect("a test's own files");
    let mut written = BTreeMap::new();
    for planned in layout.plan(&manifest).expect("a layout for it").files {
        let read = |name: &str| {
            let bytes = blobs.get(manifest.files[name].digest).expect("stored");
            (name.to_owned(), bytes.to_vec())
        };
        let bytes: BTreeMap<String, Vec<u8>> = planned.reads().map(read).collect();
        let path = folder.join(planned.name);
        if planned.write(|| std::fs::File::create(&path), &bytes).expect("it is written").tensors > 0 {
            written.insert(planned.name, path);
        }
    }
    written
}

/// Copies an exported file to the folder `STRIDE_EXPORTS`, if that is set, with a note of its origin;
/// `tests/torch_load.py` reads both.
fn keep(ours: &Path, theirs: &Path, without: &[&str]) {
    let Some(folder) = std::env::var_os("STRIDE_EXPORTS").map(PathBuf::from) else { return };
    // The name of a layout's folder contains the digest of the exported artifact.
    let layout = ours.parent().expect("a folder of a layout");
    let kept = format!("{}-{}", name(layout), name(ours));
    std::fs::create_dir_all(&folder).expect("a folder that was asked for");
    std::fs::copy(ours, folder.join(&kept)).expect("a folder that was asked for");
    let row =
        [&[kept, text_of(theirs)][..], &without.iter().map(|begin| (*begin).to_owned()).collect::<Vec<_>>()].concat();
    let mut pairs = std::fs::OpenOptions::new();
    let mut pairs =
        pairs.create(true).append(true).open(folder.join("pairs.tsv")).expect("a folder that was asked for");
    pairs.write_all(format!("{}\n", row.join("\t")).as_bytes()).expect("a folder that was asked for");
}

/// Checks an exported file against the imported one: the same names and bits, except for names with a prefix in
/// `without`.
pub(crate) fn expect_file(ours: &Path, theirs: &Path, without: &[&str]) {
    keep(ours, theirs, without);
    let open = |path: &Path| Weights::open_file(&DataPath::local(path)).unwrap_or_else(|e| panic!("{e}"));
    let (ours_open, theirs_open) = (open(ours), open(theirs));
    let kept = |name: &&String| !without.iter().any(|begin| name.starts_with(begin));
    let names: Vec<&String> = theirs_open.tensors().keys().filter(kept).collect();
    assert!(!names.is_empty());
    assert_eq!(ours_open.tensors().keys().collect::<Vec<_>>(), names, "{}", theirs.display());
    for (name, tensor) in ours_open.tensors() {
        let other = &theirs_open.tensors()[name];
        assert_eq!(tensor.shape, other.shape, "{name}");
        let bits = |tensor: &StoredTensor| -> Vec<u32> {
            tensor.values().expect("numbers").into_iter().map(f32::to_bits).collect()
        };
        assert_eq!(bits(tensor), bits(other), "{}: {name}", theirs.display());
    }
}
