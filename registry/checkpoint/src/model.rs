//! Models: a generator and the parts that it uses.
//!
//! A part is an artifact in a role: a denoiser, the VAE of its latents, the text encoder that it was trained with. The
//! model's manifest lists the files of all parts, each in a folder named after its role, with the part's own manifest:
//! `denoiser/manifest.json`, `denoiser/model.safetensors`, `vae/manifest.json`. Code that keeps, checks, copies or
//! removes artifacts therefore needs no knowledge of models, and weights that ten students share are stored once.
//!
//! Keys of the meta: `generator`, the generator's name; `format`, the skeleton of its motions; `parts`, role to the
//! digest of the part's manifest; `sampler`, the default settings if the model was measured. A part's own meta names
//! the parts it was made for as `fits: {role: digest}`; parts that do not fit form no model. The generator opens the
//! parts, not this module.

use std::collections::BTreeMap;

use protocol::artifact::{FileEntry, Role};
use protocol::stage::{DataFormat, Sampler};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::{Deserialize, Serialize};

/// File name of the manifest in a part's folder.
const MANIFEST: &str = "manifest.json";

/// Digests of the parts' manifests by role.
pub type Parts = BTreeMap<Role, Digest>;

/// Reason why an artifact is not a valid model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModelError {
    /// The artifact has another kind.
    #[error("the artifact has kind {0:?}; expected a model")]
    NotAModel(ArtifactKind),
    /// The manifest cannot be read.
    #[error("cannot parse the manifest of the {what}: {why}")]
    Malformed {
        /// The model or part.
        what: String,
        /// Error of the reader.
        why: String,
    },
    /// The model lacks a part.
    #[error("the model has no part `{missing}`; it has {}", have.join(", "))]
    Missing {
        /// The missing part.
        missing: Role,
        /// Roles of the model's parts.
        have: Vec<String>,
    },
    /// The model has no part of a kind, or several.
    #[error("the model has {} of kind `{}`; its parts: {}", if *several { "several parts" } else { "no part" }, word(*kind), have.join(", "))]
    OfKind {
        /// The requested kind.
        kind: ArtifactKind,
        /// True if there are several.
        several: bool,
        /// Roles of the model's parts.
        have: Vec<String>,
    },
    /// A part was made for another part than the model's.
    #[error("the part `{role}` was trained with the `{needs}` {wanted}, but the model has {found}")]
    Unfit {
        /// Role of the refused part.
        role: Role,
        /// Role of the part that it needs.
        needs: Role,
        /// Digest of the needed part.
        wanted: String,
        /// Description of the part in the model.
        found: String,
    },
}

/// The meta of an artifact of kind `model`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// Name of the generator in the table of generators.
    pub generator: String,
    /// The skeleton of its motions.
    pub format: DataFormat,
    /// The parts that the generator uses.
    pub parts: Parts,
    /// Default settings for sampling: those of the evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampler: Option<Sampler>,
}

impl Model {
    /// Reads a model from its manifest.
    pub fn read(manifest: &Manifest) -> Result<Self, ModelError> {
        if manifest.kind != ArtifactKind::Model {
            return Err(ModelError::NotAModel(manifest.kind));
        }
        Self::deserialize(&manifest.meta).map_err(|e| malformed("model", &e))
    }

    /// Returns the digest of a required part's manifest.
    pub fn part(&self, role: &Role) -> Result<Digest, ModelError> {
        let have = || self.parts.keys().map(|role| format!("`{role}`")).collect();
        self.parts.get(role).copied().ok_or_else(|| ModelError::Missing { missing: role.clone(), have: have() })
    }
}

/// Returns the only part of a kind, with its role and digest. `read` returns a part's manifest by digest.
///
/// # Errors
/// The outer error is one of `read`. The inner one means that the model has no such part or several.
pub fn part_of_kind<E>(
    model: &Model,
    kind: ArtifactKind,
    mut read: impl FnMut(Digest) -> Result<Manifest, E>,
) -> Result<Result<(Role, Digest, Manifest), ModelError>, E> {
    let mut found = None;
    let mut have = Vec::new();
    let mut several = false;
    for (role, digest) in &model.parts {
        let manifest = read(*digest)?;
        have.push(format!("`{role}` ({})", word(manifest.kind)));
        if manifest.kind == kind {
            several = found.replace((role.clone(), *digest, manifest)).is_some() || several;
        }
    }
    Ok(found.filter(|_| !several).ok_or(ModelError::OfKind { kind, several, have }))
}

/// Returns a kind's name in manifests.
fn word(kind: ArtifactKind) -> String {
    let word = serde_json::to_value(kind).expect("a kind is a word");
    word.as_str().unwrap_or_default().to_owned()
}

/// Entry `drawn` in the meta of an evaluation's report: the measured model and its sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Drawn {
    /// Digest of the model's manifest.
    pub model: Digest,
    /// Settings of the sampler.
    pub sampler: Sampler,
}

/// Makes a model of these parts that has no default sampler yet.
pub fn assemble(generator: &str, format: DataFormat, parts: &BTreeMap<Role, Manifest>) -> Result<Manifest, ModelError> {
    let model = Model { generator: generator.to_owned(), format, parts: BTreeMap::new(), sampler: None };
    complete(Manifest::new(ArtifactKind::Model, serde_json::Value::Null), model, parts)
}

/// Extends `model` by a default `sampler` and by `more` parts. A part replaces one with the same role.
pub fn extend(
    model: &Manifest,
    sampler: Option<&Sampler>,
    more: &BTreeMap<Role, Manifest>,
) -> Result<Manifest, ModelError> {
    let mut meta = Model::read(model)?;
    meta.sampler = sampler.cloned().or(meta.sampler);
    complete(model.clone(), meta, more)
}

fn complete(mut manifest: Manifest, mut model: Model, more: &BTreeMap<Role, Manifest>) -> Result<Manifest, ModelError> {
    for (role, part) in more {
        let folder = format!("{role}/");
        manifest.files.retain(|name, _| !name.starts_with(&folder));
        model.parts.insert(role.clone(), add_part(&mut manifest, role, part));
    }
    for (role, part) in more {
        for (needs, wanted) in fits(role, part)? {
            let found = model.parts.get(&needs);
            if found != Some(&wanted) {
                let found = found.map_or_else(|| "none".to_owned(), Digest::short);
                return Err(ModelError::Unfit { role: role.clone(), needs, wanted: wanted.short(), found });
            }
        }
    }
    manifest.meta = serde_json::to_value(&model).expect("a model is plain data with string keys");
    Ok(manifest)
}

/// Adds a part's files and manifest to the folder `role` of `whole`. Returns the digest of the part's manifest, which
/// must be stored too.
pub fn add_part(whole: &mut Manifest, role: &Role, part: &Manifest) -> Digest {
    let bytes = part.to_bytes();
    let digest = Digest::of(&bytes);
    let own = (MANIFEST.to_owned(), FileEntry::of_blob(digest, bytes.len() as u64));
    let files = part.files.iter().map(|(name, entry)| (name.clone(), entry.clone()));
    whole.list([own].into_iter().chain(files).map(|(name, entry)| (format!("{role}/{name}"), entry)));
    digest
}

/// Returns the parts that `part` was made for, by role.
pub fn fits(role: &Role, part: &Manifest) -> Result<Parts, ModelError> {
    let fits = part.meta.get("fits").map(Parts::deserialize).transpose();
    Ok(fits.map_err(|e| malformed(&format!("part `{role}`"), &e))?.unwrap_or_default())
}

fn malformed(what: &str, error: &serde_json::Error) -> ModelError {
    ModelError::Malformed { what: what.to_owned(), why: error.to_string() }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn part(kind: ArtifactKind, meta: Value) -> Manifest {
        let mut manifest = Manifest::new(kind, meta);
        let digest = Digest::of(format!("{kind:?}").as_bytes());
        manifest.files.insert("model.safetensors".into(), FileEntry::of_blob(digest, 3));
        manifest
    }

    fn parts() -> BTreeMap<Role, Manifest> {
        let vae = part(ArtifactKind::Vae, json!({"latent": 16}));
        let text = Manifest::new(ArtifactKind::TextEncoder, json!({"encoder": "hashed"}));
        let denoiser = part(ArtifactKind::Denoiser, json!({"fits": {"vae": vae.digest(), "text": text.digest()}}));
        BTreeMap::from([(Role::DENOISER, denoiser), (Role::VAE, vae), (Role::TEXT, text)])
    }

    #[test]
    fn a_model_lists_the_files_of_all_its_parts() {
        let parts = parts();
        let manifest = assemble("latent-diffusion", DataFormat::Kit, &parts).unwrap();
        let names: Vec<&str> = manifest.files.keys().map(String::as_str).collect();
        let all = [
            "denoiser/manifest.json",
            "denoiser/model.safetensors",
            "text/manifest.json",
            "vae/manifest.json",
            "vae/model.safetensors",
        ];
        assert_eq!(names, all);
        let model = Model::read(&manifest).unwrap();
        assert_eq!((model.generator.as_str(), model.format), ("latent-diffusion", DataFormat::Kit));
        for (role, part) in &parts {
            assert_eq!(model.part(role), Ok(part.digest()), "{role}");
            assert_eq!(manifest.files[&format!("{role}/manifest.json")].digest, part.digest(), "{role}");
        }
        let missing = model.part(&Role::LENGTH).unwrap_err().to_string();
        assert!(missing.contains("`length`") && missing.contains("`denoiser`, `text`, `vae`"), "{missing}");
        assert_eq!(assemble("latent-diffusion", DataFormat::Kit, &parts).unwrap(), manifest);
    }

    #[test]
    fn a_model_takes_a_sampler_and_parts_of_any_role() {
        let manifest = assemble("latent-diffusion", DataFormat::Kit, &parts()).unwrap();
        let text = Model::read(&manifest).unwrap().parts[&Role::TEXT];
        let sampler = Sampler { steps: 2, ..Sampler::default() };
        let control = Role::try_from("control-2".to_owned()).unwrap();
        let more = BTreeMap::from([
            (Role::LENGTH, part(ArtifactKind::Length, json!({"fits": {"text": text}}))),
            (control.clone(), part(ArtifactKind::Denoiser, json!({}))),
        ]);
        let extended = extend(&manifest, Some(&sampler), &more).unwrap();
        let model = Model::read(&extended).unwrap();
        assert_eq!(model.sampler.as_ref(), Some(&sampler));
        assert_eq!(model.parts.len(), 5);
        assert!(extended.files.contains_key("control-2/model.safetensors"));
        // A replaced part leaves no file.
        let other = BTreeMap::from([(control, Manifest::new(ArtifactKind::Denoiser, json!({})))]);
        let replaced = extend(&extended, None, &other).unwrap();
        assert!(!replaced.files.contains_key("control-2/model.safetensors"));
        assert_eq!(Model::read(&replaced).unwrap().sampler, Some(sampler), "it keeps its own");
    }

    #[test]
    fn parts_that_were_made_for_others_are_refused() {
        let mut other = parts();
        let vae = part(ArtifactKind::Vae, json!({"latent": 1}));
        other.insert(Role::VAE, vae.clone());
        let refused = assemble("latent-diffusion", DataFormat::Kit, &other).unwrap_err().to_string();
        assert!(refused.contains("`denoiser` was trained with the `vae`") && refused.contains(&vae.digest().short()));
        other.remove(&Role::VAE);
        let refused = assemble("latent-diffusion", DataFormat::Kit, &other).unwrap_err().to_string();
        assert!(refused.ends_with("but the model has none"), "{refused}");

        let manifest = assemble("latent-diffusion", DataFormat::Kit, &parts()).unwrap();
        let length = part(ArtifactKind::Length, json!({"fits": {"text": Digest::of(b"another")}}));
        let refused = extend(&manifest, None, &BTreeMap::from([(Role::LENGTH, length)])).unwrap_err().to_string();
        assert!(refused.contains("`length` was trained with the `text`"), "{refused}");
        assert_eq!(Model::read(&vae), Err(ModelError::NotAModel(ArtifactKind::Vae)));
    }

    #[test]
    fn a_part_is_found_by_its_kind() {
        let parts = parts();
        let manifest = assemble("latent-diffusion", DataFormat::Kit, &parts).unwrap();
        let find = |manifest: &Manifest, kind, parts: &BTreeMap<Role, Manifest>| {
            let read = |digest| parts.values().find(|part| part.digest() == digest).cloned().ok_or("gone");
            part_of_kind(&Model::read(manifest).unwrap(), kind, read).unwrap()
        };
        let (role, digest, vae) = find(&manifest, ArtifactKind::Vae, &parts).unwrap();
        assert_eq!((role, digest, &vae), (Role::VAE, parts[&Role::VAE].digest(), &parts[&Role::VAE]));
        let missing = find(&manifest, ArtifactKind::Tokenizer, &parts).unwrap_err().to_string();
        assert!(missing.contains("no part of kind `tokenizer`") && missing.contains("`vae` (vae)"), "{missing}");
        let second = Role::try_from("denoiser-2".to_owned()).unwrap();
        let mut more = parts.clone();
        more.insert(second, Manifest::new(ArtifactKind::Denoiser, json!({})));
        let manifest = assemble("latent-diffusion", DataFormat::Kit, &more).unwrap();
        let several = find(&manifest, ArtifactKind::Denoiser, &more).unwrap_err().to_string();
        assert!(several.contains("several parts of kind `denoiser`"), "{several}");
    }

    #[test]
    fn a_role_is_a_plain_word() {
        for bad in ["", "..", "a/b", "A", "a b", &"a".repeat(65)] {
            assert!(Role::try_from(bad.to_owned()).is_err(), "{bad}");
        }
        let meta = json!({"generator": "g", "format": "kit", "parts": {"../x": Digest::of(b"x")}});
        let refused = Model::read(&Manifest::new(ArtifactKind::Model, meta)).unwrap_err().to_string();
        assert!(refused.contains("not a valid role"), "{refused}");
    }
}
