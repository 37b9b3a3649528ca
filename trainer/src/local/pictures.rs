//! Copies the pictures of stages to the store's folder for users: `pictures/RUN/STAGE-NAME`.

use std::path::{Path, PathBuf};

use protocol::message::RunView;
use protocol::{Digest, Manifest};
use registry::Store;

/// Ending of pictures among a stage's files.
const ENDING: &str = ".png";
/// A picture above this many bytes is not copied; sheets have a few hundred thousand.
const LARGEST: u64 = 64 << 20;

/// Copies the pictures of a run's stages. Returns the copies by stage.
///
/// # Errors
/// The reason why one cannot be copied; the earlier copies remain.
pub(crate) async fn save(store: &Store, run: &RunView) -> Result<Vec<(String, PathBuf)>, String> {
    let folder = store.dir().join("pictures").join(run.run.as_str());
    let blobs = store.blobs().clone();
    let outputs: Vec<(String, Digest)> = run
        .stages
        .iter()
        .filter(|stage| stage.of.is_none())
        .flat_map(|stage| stage.outputs.values().map(|output| (stage.name.to_string(), *output)))
        .collect();
    let copied = tokio::task::spawn_blocking(move || -> Result<Vec<(String, PathBuf)>, String> {
        let mut copies = Vec::new();
        for (stage, output) in outputs {
            let manifest = blobs.manifest(output).map_err(|e| e.to_string())?;
            for (name, file) in pictures(&manifest) {
                let bytes = blobs.get(file).map_err(|e| e.to_string())?;
                let path = folder.join(format!("{stage}-{name}"));
                write(&path, &bytes).map_err(|e| format!("{}: {e}", path.display()))?;
                copies.push((stage.clone(), path));
            }
        }
        Ok(copies)
    });
    copied.await.map_err(|e| e.to_string())?
}

/// Pictures among the files of an artifact.
fn pictures(manifest: &Manifest) -> impl Iterator<Item = (&str, Digest)> {
    let files = manifest.files.iter();
    let drawn = files.filter(|(name, file)| name.ends_with(ENDING) && !name.contains('/') && file.bytes <= LARGEST);
    drawn.map(|(name, file)| (name.as_str(), file.digest))
}

/// Writes a temporary file and renames it, so that no reader sees half a picture.
fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    let beside = path.with_extension("part");
    std::fs::write(&beside, bytes)?;
    std::fs::rename(&beside, path)
}
