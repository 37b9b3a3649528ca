//! A model's files in a folder of this machine, under the names that its manifest gives them, from wherever the blobs are.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Component, Path};

use protocol::message::ApiError;
use protocol::{Digest, Manifest};
use sha2::{Digest as _, Sha256};

use super::error;
use crate::Version;

/// Where blobs come from.
pub(super) trait Source {
    /// Gives the bytes of a blob to `into`, part by part.
    async fn fetch(&self, digest: Digest, into: &mut impl FnMut(&[u8]) -> io::Result<()>) -> Result<(), ApiError>;
}

/// Writes `manifest.json` and every file; returns their names. The folder must be empty or missing. What is there afterwards
/// has the digests that the manifest says, wherever it came from.
pub(super) async fn export(source: &impl Source, version: &Version, dir: &Path) -> Result<Vec<String>, ApiError> {
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
    let mut bytes = Vec::new();
    whole(source, version.artifact, &mut |part| bytes.write_all(part)).await?;
    let manifest = serde_json::from_slice::<Manifest>(&bytes).map_err(|e| damaged(&e))?;
    let mut names = Vec::new();
    for (name, entry) in &manifest.files {
        let relative = Path::new(name);
        if !relative.components().all(|part| matches!(part, Component::Normal(_))) {
            return Err(damaged(&format!("manifest {} names a file `{name}` outside of its folder", version.artifact)));
        }
        let path = dir.join(relative);
        let parent = path.parent().unwrap_or(dir);
        let file = fs::create_dir_all(parent).and_then(|()| File::create_new(&path));
        let mut file = file.map_err(|e| failed(&path, &e))?;
        whole(source, entry.digest, &mut |part| file.write_all(part)).await?;
        names.push(name.clone());
    }
    let path = dir.join("manifest.json");
    fs::write(&path, bytes).map_err(|e| failed(&path, &e))?;
    names.push("manifest.json".into());
    Ok(names)
}

/// A blob's bytes, and that they are those.
pub(super) async fn whole(
    source: &impl Source,
    digest: Digest,
    write: &mut impl FnMut(&[u8]) -> io::Result<()>,
) -> Result<(), ApiError> {
    let mut hash = Sha256::new();
    let mut into = |part: &[u8]| {
        hash.update(part);
        write(part)
    };
    source.fetch(digest, &mut into).await?;
    let found = Digest::from_bytes(hash.finalize().into());
    if found == digest {
        return Ok(());
    }
    Err(error(
        "damaged",
        format!("blob {digest} is corrupt: its bytes hash to {found}"),
        Some("`registry fsck` checks the store"),
    ))
}
