//! `registry export -o FILE.tar.zst` and `registry import`: a version as one file out of a store and into another.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use checkpoint::model::Model;
use protocol::artifact::Role;
use protocol::message::ApiError;
use protocol::{Manifest, ModelName, Owner};

use super::answer::error;
use super::export::{Source, whole, whole_file};
use super::{Answer, Data};
use crate::bundle::{self, BundleError, Head, ImportError, Writer};
use crate::{Store, Version};

/// Writes a version to `file`, which must not exist, and returns the names of the model's files. The file appears under
/// its name only when it is complete.
pub(super) async fn export(source: &impl Source, version: &Version, file: &Path) -> Result<Vec<String>, ApiError> {
    let refuse = |why: &str| {
        let hint = "name a new file in an existing folder";
        error("invalid", format!("`{}` {why}", file.display()), Some(hint))
    };
    if fs::symlink_metadata(file).is_ok() {
        return Err(refuse("exists already"));
    }
    let Some(name) = file.file_name() else { return Err(refuse("is not a file name")) };
    let part = file.with_file_name(format!(".{}.{}.part", name.to_string_lossy(), std::process::id()));
    let unwritten = |e: &io::Error| error("storage", format!("failed to write `{}`: {e}", part.display()), None);
    let part = Part(part.clone());
    let created = File::create_new(&part.0).map_err(|e| unwritten(&e))?;
    let names = write(source, version, created).await?;
    fs::rename(&part.0, file).map_err(|e| unwritten(&e))?;
    Ok(names)
}

/// An unfinished file. Dropping it deletes the file unless it was renamed before.
struct Part(PathBuf);

impl Drop for Part {
    fn drop(&mut self) {
        // Fails if the file was renamed; no caller can use the error.
        let _ = fs::remove_file(&self.0);
    }
}

async fn write(source: &impl Source, version: &Version, file: File) -> Result<Vec<String>, ApiError> {
    let damaged = |e: &dyn std::fmt::Display| error("damaged", e, Some("`registry fsck` checks the store"));
    let manifest: Manifest = read(source, version.artifact).await?;
    let model = Model::read(&manifest).map_err(|e| damaged(&e))?;
    let mut parts = BTreeMap::<Role, Manifest>::new();
    for (role, digest) in &model.parts {
        parts.insert(role.clone(), read(source, *digest).await?);
    }
    let head = Head {
        format: bundle::FORMAT,
        model: version.model.clone(),
        version: version.version,
        artifact: version.artifact,
        metrics: version
            .metrics
            .iter()
            .map(|(name, value)| (name.clone(), value.is_finite().then_some(*value)))
            .collect(),
        source: version.source.clone(),
    };
    let card = bundle::card(version, &manifest, &model, &parts);
    let failed = |e: bundle::WriteError| match e {
        bundle::WriteError::Io(e) => error("storage", e, None),
        bundle::WriteError::Content(why) => damaged(&why),
    };
    let mut writer = Writer::begin(BufWriter::new(file), &head, &manifest, &card).map_err(failed)?;
    for (name, entry) in &manifest.files {
        writer.file(name, entry.bytes).map_err(failed)?;
        let mut write = |piece: &[u8]| writer.write(piece).map_err(io::Error::other);
        whole_file(source, entry, &mut write).await?;
    }
    let file = writer.finish().map_err(failed)?.into_inner().map_err(|e| error("storage", e.error(), None))?;
    file.sync_all().map_err(|e| error("storage", e, None))?;
    Ok(manifest.files.into_keys().collect())
}

/// Reads a manifest and verifies its digest.
async fn read(source: &impl Source, digest: protocol::Digest) -> Result<Manifest, ApiError> {
    let mut bytes = Vec::new();
    let mut keep = |piece: &[u8]| {
        bytes.extend_from_slice(piece);
        if bytes.len() as u64 > bundle::MANIFESTS_BYTES {
            return Err(io::Error::other(format!("manifest {digest} has more than {} bytes", bundle::MANIFESTS_BYTES)));
        }
        Ok(())
    };
    whole(source, digest, &mut keep).await?;
    serde_json::from_slice(&bytes).map_err(|e| error("damaged", e, Some("`registry fsck` checks the store")))
}

/// The answer for a bundle's file that is missing.
pub(super) fn no_such_file(shown: &str) -> Answer {
    let hint = "`registry export MODEL@ALIAS -o FILE.tar.zst` writes a bundle";
    Answer::refused(error("invalid", format!("`{shown}`: there is no such file"), Some(hint)))
}

/// Registers the version in a bundle's file for `owner`, under `model` or its original name. This process holds the
/// store. Messages call the file `shown`.
pub async fn import(store: &Store, file: &Path, shown: &str, model: Option<&str>, owner: Owner) -> Answer {
    let model = match model.map(str::parse::<ModelName>).transpose() {
        Ok(model) => model,
        Err(e) => return Answer::refused(error("invalid", e, Some("`--model NAME` gives it another name"))),
    };
    match store.import_bundle_of(file, model, owner).await {
        Ok(version) => Answer::done(Data::Imported { version, file: shown.to_owned() }),
        Err(ImportError::Write(e)) => Answer::from(e),
        Err(ImportError::Query(e)) => Answer::from(e),
        Err(ImportError::File(e)) if e.kind() == io::ErrorKind::NotFound => no_such_file(shown),
        Err(ImportError::File(e)) => Answer::refused(error("invalid", format!("`{shown}`: {e}"), None)),
        Err(ImportError::Bundle(e)) => {
            let code = match &e {
                BundleError::NotABundle(_) | BundleError::Newer { .. } => "invalid",
                BundleError::Entry { .. } | BundleError::Damaged(_) => "damaged",
                BundleError::Blob(_) => "storage",
            };
            let hint = match code {
                "damaged" => Some("nothing was registered; export the version again, and compare the files' digests"),
                "invalid" => {
                    Some("nothing was registered; `registry export MODEL@ALIAS -o FILE.tar.zst` writes a bundle")
                }
                _ => None,
            };
            Answer::refused(error(code, format!("`{shown}`: {e}"), hint))
        }
    }
}
