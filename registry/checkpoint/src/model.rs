//! What a model is: a generator, and the parts that it draws with.
//!
//! A part is an artifact by itself, in a role: a denoiser, the VAE whose latents it makes, the text encoder that it was trained with. The
//! model's manifest lists the files of all its parts, each in a folder of its role, with the part's own manifest beside them:
//! `denoiser/manifest.json`, `denoiser/model.safetensors`, `vae/manifest.json`. So what keeps, checks, copies or removes artifacts needs
//! to know nothing of models, and weights that ten students share are stored once.
//!
//! Meta: `generator`, which names what draws; `format`, the skeleton of its motions; `parts`, role to the digest of the part's manifest;
//! `sampler`, how to draw when nobody says, if the model was measured. A part says in its own meta what it was made for, as
//! `fits: {role: digest}`; parts that do not fit each other make no model. Not its job: opening a part, which its generator does.

use std::collections::BTreeMap;

use protocol::artifact::{FileEntry, Role};
use protocol::stage::{DataFormat, Sampler};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::{Deserialize, Serialize};

/// The file of a part's folder that holds its manifest.
const MANIFEST: &str = "manifest.json";

/// Parts by role: the digests of their manifests.
pub type Parts = BTreeMap<Role, Digest>;

/// Why there is no such model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModelError {
    /// It is something else.
    #[error("an artifact of kind {0:?} is no model")]
    NotAModel(ArtifactKind),
    /// Its manifest does not read.
    #[error("the manifest of the {what} is not one that this build writes: {why}")]
    Malformed {
        /// Model, or part.
        what: String,
        /// What reading it said.
        why: String,
    },
    /// It has no such part.
    #[error("the model has no part `{missing}`; it has {}", have.join(", "))]
    Missing {
        /// What was looked for.
        missing: Role,
        /// What there is.
        have: Vec<String>,
    },
    /// It has no part of a kind, or several.
    #[error("the model has {} of kind `{}`; its parts: {}", if *several { "several parts" } else { "no part" }, word(*kind), have.join(", "))]
    OfKind {
        /// What was looked for.
        kind: ArtifactKind,
        /// Whether there are several.
        several: bool,
        /// What there is.
        have: Vec<String>,
    },
    /// A part was made for another one than the model has.
    #[error("the part `{role}` was made for the `{needs}` {wanted}, but the model has {found}")]
    Unfit {
        /// The part.
        role: Role,
        /// What it needs.
        needs: Role,
        /// Which one.
        wanted: String,
        /// What is in its place.
        found: String,
    },
}

/// The meta of an artifact of kind `model`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// What draws from it: a name in the table of generators.
    pub generator: String,
    /// The skeleton of its motions.
    pub format: DataFormat,
    /// What it draws with.
    pub parts: Parts,
    /// How it is drawn from when nobody says otherwise: as it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampler: Option<Sampler>,
}

impl Model {
    /// What a manifest says of its model.
    pub fn read(manifest: &Manifest) -> Result<Self, ModelError> {
        if manifest.kind != ArtifactKind::Model {
            return Err(ModelError::NotAModel(manifest.kind));
        }
        Self::deserialize(&manifest.meta).map_err(|e| malformed("model", &e))
    }

    /// The manifest's digest of a part that the model cannot do without.
    pub fn part(&self, role: &Role) -> Result<Digest, ModelError> {
        let have = || self.parts.keys().map(|role| format!("`{role}`")).collect();
        self.parts.get(role).copied().ok_or_else(|| ModelError::Missing { missing: role.clone(), have: have() })
    }
}

/// The one part of a kind that a model has, with its role and its digest. `read` gives a part's manifest by digest.
///
/// # Errors
/// What `read` says; inside, that there is none, or which of several is meant is not known.
pub fn part_of_kind<E>(
    model: &Model,
    kind: ArtifactKind,
    mut read: impl FnMut(Digest) -> Result<Manifest, E>,
) -> Result<Result<(Role, Digest, Manifest), ModelError>, E> {
    let (mut found, mut have, mut several) = (None, Vec::new(), false);
    for (role, digest) in &model.parts {
        let manifest = read(*digest)?;
        have.push(format!("`{role}` ({})", word(manifest.kind)));
        if manifest.kind == kind {
            several = found.replace((role.clone(), *digest, manifest)).is_some() || several;
        }
    }
    Ok(found.filter(|_| !several).ok_or(ModelError::OfKind { kind, several, have }))
}

/// A kind as it stands in a manifest.
fn word(kind: ArtifactKind) -> String {
    let word = serde_json::to_value(kind).expect("a kind is a word");
    word.as_str().unwrap_or_default().to_owned()
}

/// What an evaluation says in its report's meta, as `drawn`: which model it measured, and how it drew from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Drawn {
    /// The model's manifest.
    pub model: Digest,
    /// How it was drawn from.
    pub sampler: Sampler,
}

/// A model of these parts that nobody has measured yet.
pub fn assemble(generator: &str, format: DataFormat, parts: &BTreeMap<Role, Manifest>) -> Result<Manifest, ModelError> {
    let model = Model { generator: generator.to_owned(), format, parts: BTreeMap::new(), sampler: None };
    complete(Manifest::new(ArtifactKind::Model, serde_json::Value::Null), model, parts)
}

/// `model` with `sampler` as its own and `more` parts. A part takes the place of one in the same role.
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

/// Puts a part's files and its manifest into the folder `role` of `whole`; the digest of the part's manifest, which must be stored too.
pub fn add_part(whole: &mut Manifest, role: &Role, part: &Manifest) -> Digest {
    let bytes = part.to_bytes();
    let digest = Digest::of(&bytes);
    whole.files.insert(format!("{role}/{MANIFEST}"), FileEntry { digest, bytes: bytes.len() as u64 });
    whole.files.extend(part.files.iter().map(|(name, entry)| (format!("{role}/{name}"), entry.clone())));
    digest
}

/// The parts that `part` was made for, by role.
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
        manifest.files.insert("model.safetensors".into(), FileEntry { digest, bytes: 3 });
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
        // What is replaced leaves no file behind.
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
        assert!(refused.contains("`denoiser` was made for the `vae`") && refused.contains(&vae.digest().short()));
        other.remove(&Role::VAE);
        let refused = assemble("latent-diffusion", DataFormat::Kit, &other).unwrap_err().to_string();
        assert!(refused.ends_with("but the model has none"), "{refused}");

        let manifest = assemble("latent-diffusion", DataFormat::Kit, &parts()).unwrap();
        let length = part(ArtifactKind::Length, json!({"fits": {"text": Digest::of(b"another")}}));
        let refused = extend(&manifest, None, &BTreeMap::from([(Role::LENGTH, length)])).unwrap_err().to_string();
        assert!(refused.contains("`length` was made for the `text`"), "{refused}");
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
        assert!(refused.contains("not a part's role"), "{refused}");
    }
}
