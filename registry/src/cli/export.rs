//! Exports a model's files to a local folder, under the names in its manifest, from any source of blobs.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Component, Path};

use checkpoint::published::{ExportError, Layout, Planned, Written};
use protocol::digest::Hasher;
use protocol::message::ApiError;
use protocol::{Digest, FileEntry, Manifest};

use super::answer::error;
use crate::Version;

/// A source of blobs.
pub(super) trait Source {
    /// Passes the bytes of a blob to `into`, part by part.
    async fn fetch(&self, digest: Digest, into: &mut impl FnMut(&[u8]) -> io::Result<()>) -> Result<(), ApiError>;
}

/// Writes `manifest.json` and every file, and returns their names. The folder must be empty or missing. The written
/// files have the digests in the manifest, from any source.
pub(super) async fn export(source: &impl Source, version: &Version, dir: &Path) -> Result<Vec<String>, ApiError> {
    empty_folder(dir)?;
    let mut bytes = Vec::new();
    whole(source, version.artifact, &mut |part| bytes.write_all(part)).await?;
    let manifest = serde_json::from_slice::<Manifest>(&bytes).map_err(|e| damaged(&e))?;
    let mut names = Vec::new();
    for (name, entry) in &manifest.files {
        let relative = Path::new(name);
        if !relative.components().all(|part| matches!(part, Component::Normal(_))) {
            return Err(damaged(&format!("manifest {} lists a file `{name}` outside its folder", version.artifact)));
        }
        let path = dir.join(relative);
        let parent = path.parent().unwrap_or(dir);
        let file = fs::create_dir_all(parent).and_then(|()| File::create_new(&path));
        let mut file = file.map_err(|e| failed(&path, &e))?;
        whole_file(source, entry, &mut |part| file.write_all(part)).await?;
        names.push(name.clone());
    }
    let path = dir.join("manifest.json");
    fs::write(&path, bytes).map_err(|e| failed(&path, &e))?;
    names.push("manifest.json".into());
    Ok(names)
}

/// Writes only the weights, in the files of a layout. Returns their names and the parts that the layout cannot hold.
/// For a layout with one file `path` is that file, which must be missing; otherwise `path` is a folder, which must be
/// empty or missing.
pub(super) async fn weights(
    source: &impl Source,
    version: &Version,
    path: &Path,
    layout: Layout,
) -> Result<(Vec<String>, Vec<String>), ApiError> {
    let mut bytes = Vec::new();
    whole(source, version.artifact, &mut |part| bytes.write_all(part)).await?;
    let manifest = serde_json::from_slice::<Manifest>(&bytes).map_err(|e| damaged(&e))?;
    let plan = layout.plan(&manifest).map_err(|e| refused(&e))?;
    let single = plan.files.len() == 1;
    if !single {
        empty_folder(path)?;
    }
    let mut names = Vec::new();
    let mut left_out = plan.left_out;
    for planned in &plan.files {
        let to = if single { path.to_owned() } else { path.join(planned.name) };
        let written = written(source, &manifest, planned, &to).await?;
        left_out.extend(written.left_out);
        if written.tensors > 0 {
            names.push(if single { layout.name().to_owned() } else { planned.name.to_owned() });
        }
    }
    if names.is_empty() {
        let hint = Some("`--layout safetensors` supports every model");
        return Err(error("invalid", format!("`{}` has no weights for `{}`", version.model, layout.name()), hint));
    }
    Ok((names, left_out))
}

/// Writes one file of a layout, if the model has its content.
async fn written(source: &impl Source, manifest: &Manifest, planned: &Planned, to: &Path) -> Result<Written, ApiError> {
    let mut files = BTreeMap::new();
    for name in planned.reads() {
        let Some(entry) = manifest.files.get(name) else { continue };
        let mut bytes = Vec::new();
        whole_file(source, entry, &mut |part| bytes.write_all(part)).await?;
        files.insert(name.to_owned(), bytes);
    }
    planned.write(|| File::create_new(to).map(io::BufWriter::new), &files).map_err(|e| match e {
        ExportError::Write(e) => failed(to, &e),
        e => refused(&e),
    })
}

fn refused(e: &ExportError) -> ApiError {
    match e {
        ExportError::Damaged { .. } => damaged(e),
        _ => error("invalid", e, Some("`registry show` lists a version's parts")),
    }
}

fn failed(path: &Path, e: &io::Error) -> ApiError {
    error("storage", format!("failed to write `{}`: {e}", path.display()), None)
}

fn damaged(e: &dyn std::fmt::Display) -> ApiError {
    error("damaged", e, Some("`registry fsck` checks the store"))
}

/// Creates a folder, or checks that it is empty.
fn empty_folder(dir: &Path) -> Result<(), ApiError> {
    match fs::read_dir(dir) {
        Ok(mut entries) => match entries.next() {
            None => Ok(()),
            Some(_) => {
                let hint = "choose a folder that is empty or does not exist";
                Err(error("invalid", format!("folder `{}` is not empty", dir.display()), Some(hint)))
            }
        },
        Err(e) if e.kind() == io::ErrorKind::NotFound => fs::create_dir_all(dir).map_err(|e| failed(dir, &e)),
        Err(e) => Err(failed(dir, &e)),
    }
}

/// Passes a blob's bytes to `write` and verifies their digest.
pub(super) async fn whole(
    source: &impl Source,
    digest: Digest,
    write: &mut impl FnMut(&[u8]) -> io::Result<()>,
) -> Result<(), ApiError> {
    let mut hash = Hasher::default();
    let mut into = |part: &[u8]| {
        hash.update(part);
        write(part)
    };
    source.fetch(digest, &mut into).await?;
    expect("blob", digest, hash)
}

/// Passes a file's bytes to `write` and verifies its blobs and its digest.
pub(super) async fn whole_file(
    source: &impl Source,
    file: &FileEntry,
    write: &mut impl FnMut(&[u8]) -> io::Result<()>,
) -> Result<(), ApiError> {
    if file.chunks.is_empty() {
        return whole(source, file.digest, write).await;
    }
    let mut hash = Hasher::default();
    let mut into = |part: &[u8]| {
        hash.update(part);
        write(part)
    };
    for blob in file.blobs() {
        whole(source, blob.digest, &mut into).await?;
    }
    expect("file", file.digest, hash)
}

fn expect(what: &str, digest: Digest, hash: Hasher) -> Result<(), ApiError> {
    let found = hash.finish();
    if found == digest {
        return Ok(());
    }
    Err(error(
        "damaged",
        format!("{what} {digest} is corrupt: its bytes hash to {found}"),
        Some("`registry fsck` checks the store"),
    ))
}
