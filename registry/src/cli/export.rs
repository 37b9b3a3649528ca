//! A model's files in a folder, under the names that its manifest gives them.

use std::fs;
use std::io;
use std::path::{Component, Path};

use protocol::Digest;
use protocol::message::ApiError;

use super::error;
use crate::BlobStore;

/// Writes `manifest.json` and every file; returns their names. The folder must be empty or missing.
pub(super) fn export(blobs: &BlobStore, artifact: Digest, dir: &Path) -> Result<Vec<String>, ApiError> {
    let failed =
        |path: &Path, e: &io::Error| error("storage", format!("failed to write `{}`: {e}", path.display()), None);
    match fs::read_dir(dir) {
        Ok(mut entries) => {
            if entries.next().is_some() {
                let hint = "choose a folder that is empty or does not exist";
                return Err(error("invalid", format!("folder `{}` is not empty", dir.display()), Some(hint)));
            }
        }
        Err(e) if e.kind() == io::ErrorKind::NotFound => fs::create_dir_all(dir).map_err(|e| failed(dir, &e))?,
        Err(e) => return Err(failed(dir, &e)),
    }
    let damaged = |e: &dyn std::fmt::Display| error("damaged", e, Some("`registry fsck` checks the store"));
    let manifest = blobs.complete_manifest(artifact).map_err(|e| damaged(&e))?;
    let mut names = Vec::new();
    for (name, file) in &manifest.files {
        let relative = Path::new(name);
        if !relative.components().all(|part| matches!(part, Component::Normal(_))) {
            return Err(damaged(&format!("manifest {artifact} names a file `{name}` outside of its folder")));
        }
        let path = dir.join(relative);
        let bytes = blobs.get(file.digest).map_err(|e| damaged(&e))?;
        let parent = path.parent().unwrap_or(dir);
        fs::create_dir_all(parent).and_then(|()| fs::write(&path, bytes)).map_err(|e| failed(&path, &e))?;
        names.push(name.clone());
    }
    let path = dir.join("manifest.json");
    fs::write(&path, manifest.to_bytes()).map_err(|e| failed(&path, &e))?;
    names.push("manifest.json".into());
    Ok(names)
}
