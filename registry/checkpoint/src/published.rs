//! Export of a model's weights to files for the code of the papers: tensors and names of each file.
//!
//! Our parts already use the published names, with one file a part (`model.safetensors`). Other tensors of an imported
//! file (tables of positions, masks) are in `constants.safetensors`. A layout defines the number of files, the prefix
//! of the names, and the key in a torch file. The caller provides the bytes of the parts.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Seek, Write};

use protocol::{ArtifactKind, Manifest};
use safetensors::tensor::{Dtype, TensorView};
use safetensors::{SafeTensors, serialize};

use crate::model::Model;
use crate::torch;

/// Files of a part with tensors.
const FILES: [&str; 2] = ["model.safetensors", "constants.safetensors"];

/// Reason why an export is not possible.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The layout cannot hold such a model, or a part has another network.
    #[error("{0}")]
    Unfit(String),
    /// A part's file is damaged.
    #[error("`{file}`: {why}")]
    Damaged {
        /// The file's name in the manifest.
        file: String,
        /// Error of the reader.
        why: String,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] std::io::Error),
}

/// File layouts of exported weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// Layout of MLD and MotionLCM: one torch file,
    /// `{"state_dict": {vae.*, denoiser.*, controlnet.*, traj_encoder.*}}`.
    MotionLcm,
    /// Layout of MoMask: `rvq.tar`, `masked.tar` and `residual.tar`, each with its network under the key that the
    /// authors' code reads.
    Momask,
    /// Layout of T2M-GPT: `vqvae.pth` and `transformer.pth`.
    T2mGpt,
    /// Layout of MDM: one torch file with only the network.
    Mdm,
    /// One safetensors file of any model. The role precedes each part's names, which gives MotionLCM's names for a
    /// latent model.
    Safetensors,
}

/// Renaming of one network of a part.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Names {
    /// The part's role.
    role: &'static str,
    /// Prefix of the names in our file.
    from: &'static str,
    /// Prefix in the exported file.
    to: String,
    /// A name that identifies the network; a part without it is skipped.
    marker: &'static str,
    /// True if a part without it is refused instead.
    needed: bool,
}

/// One file of a layout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Planned {
    /// File name, used if a layout has several files.
    pub name: &'static str,
    /// Key of the tensors in a torch file's dict; `None` if they are the dict itself.
    key: Option<&'static str>,
    torch: bool,
    /// Our files, by their names in the manifest, with their renaming.
    files: Vec<(String, Names)>,
}

/// Planned files, and roles that the layout cannot hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    pub files: Vec<Planned>,
    /// Parts with weights that no file holds.
    pub left_out: Vec<String>,
}

/// Summary of a written file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    /// Number of tensors.
    pub tensors: usize,
    /// Networks of parts that the layout cannot hold, as `control/feedback`.
    pub left_out: BTreeSet<String>,
}

impl Layout {
    /// Returns the layout's name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::MotionLcm => "motionlcm",
            Self::Momask => "momask",
            Self::T2mGpt => "t2mgpt",
            Self::Mdm => "mdm",
            Self::Safetensors => "safetensors",
        }
    }

    /// Returns the layout's files: name, key and networks. A file without any of its networks is not written, unless
    /// one is required.
    fn files(self) -> Vec<(&'static str, Option<&'static str>, Vec<Names>)> {
        let names = |role, from, to: &str, marker, needed| Names { role, from, to: to.to_owned(), marker, needed };
        match self {
            Self::MotionLcm => vec![(
                "motionlcm.ckpt",
                Some("state_dict"),
                vec![
                    names("vae", "", "vae.", "query_pos_decoder.pe", true),
                    names("denoiser", "", "denoiser.", "time_embedding.linear_1.weight", true),
                    names("control", "controlnet.", "controlnet.", "controlnet_cond_embedding.0.weight", true),
                    names("control", "traj_encoder.", "traj_encoder.", "skel_embedding.weight", true),
                ],
            )],
            Self::Momask => vec![
                ("rvq.tar", Some("vq_model"), vec![names("tokenizer", "", "", "quantizer.layers.0.codebook", false)]),
                (
                    "masked.tar",
                    Some("t2m_transformer"),
                    vec![names("generator", "mask.", "", "token_emb.weight", true)],
                ),
                (
                    "residual.tar",
                    Some("res_transformer"),
                    vec![names("generator", "res.", "", "quant_emb.weight", false)],
                ),
                ("discord.pth", None, vec![names("decoder", "", "", "net.init_proj.weight", false)]),
            ],
            Self::T2mGpt => vec![
                (
                    "vqvae.pth",
                    Some("net"),
                    vec![names("tokenizer", "", "vqvae.", "quantizer.layers.0.codebook", false)],
                ),
                ("transformer.pth", Some("trans"), vec![names("generator", "", "", "trans_base.tok_emb.weight", true)]),
                ("discord.pth", None, vec![names("decoder", "", "", "net.init_proj.weight", false)]),
            ],
            Self::Mdm => {
                vec![("model.pt", None, vec![names("denoiser", "", "", "embed_timestep.time_embed.0.weight", true)])]
            }
            Self::Safetensors => Vec::new(),
        }
    }

    /// Plans the files of a model, or of a single part.
    ///
    /// # Errors
    /// Returns an error if the layout can hold no part of it.
    pub fn plan(self, manifest: &Manifest) -> Result<Plan, ExportError> {
        let places = places(manifest)?;
        let mut plan = Plan { files: Vec::new(), left_out: Vec::new() };
        if self == Self::Safetensors {
            let files = places.iter().flat_map(|(role, files)| {
                let to = match *role {
                    "control" => String::new(),
                    role => format!("{role}."),
                };
                let names = Names { role, from: "", to, marker: "", needed: false };
                files.iter().map(move |file| (file.clone(), names.clone()))
            });
            let files: Vec<_> = files.collect();
            plan.files.push(Planned { name: "model.safetensors", key: None, torch: false, files });
        } else {
            let mut seen = Vec::new();
            for (name, key, networks) in self.files() {
                let mut files = Vec::new();
                for names in networks {
                    let Some(found) = places.get(names.role) else { continue };
                    seen.push(names.role);
                    files.extend(found.iter().map(|file| (file.clone(), names.clone())));
                }
                if !files.is_empty() {
                    plan.files.push(Planned { name, key, torch: true, files });
                }
            }
            plan.left_out = places.keys().filter(|role| !seen.contains(*role)).map(|role| (*role).to_owned()).collect();
        }
        if plan.files.iter().all(|file| file.files.is_empty()) {
            let has: Vec<&str> = places.keys().copied().collect();
            return Err(ExportError::Unfit(format!(
                "the layout `{}` does not support the model's parts ({}); `safetensors` supports every model",
                self.name(),
                if has.is_empty() { "no layout has weights".to_owned() } else { has.join(", ") }
            )));
        }
        Ok(plan)
    }
}

/// Returns the roles with weights that belong to the model, and their files. Text encoders and evaluators are published
/// elsewhere and left out.
fn places(manifest: &Manifest) -> Result<BTreeMap<&'static str, Vec<String>>, ExportError> {
    const ROLES: [&str; 7] = ["control", "decoder", "denoiser", "generator", "length", "tokenizer", "vae"];
    let own = match manifest.kind {
        ArtifactKind::Model => {
            Model::read(manifest).map_err(|e| ExportError::Unfit(e.to_string()))?;
            None
        }
        ArtifactKind::Vae => Some("vae"),
        ArtifactKind::Tokenizer => Some("tokenizer"),
        ArtifactKind::FlowDecoder => Some("decoder"),
        other => return Err(ExportError::Unfit(format!("no layout supports {}", other.noun()))),
    };
    let mut places = BTreeMap::new();
    for role in ROLES {
        let file = |name: &str| match own {
            Some(own) => (own == role).then(|| name.to_owned()),
            None => Some(format!("{role}/{name}")),
        };
        let files: Vec<String> =
            FILES.iter().filter_map(|name| file(name)).filter(|name| manifest.files.contains_key(name)).collect();
        if !files.is_empty() {
            places.insert(role, files);
        }
    }
    Ok(places)
}

impl Planned {
    /// Returns the names of our files that it needs.
    pub fn reads(&self) -> impl Iterator<Item = &str> {
        let mut names: Vec<&str> = self.files.iter().map(|(file, _)| file.as_str()).collect();
        names.dedup();
        names.into_iter()
    }

    /// Writes the file to the writer of `open`; `bytes` holds every file of [`reads`](Self::reads). A file without
    /// tensors is not opened.
    ///
    /// # Errors
    /// Returns an error if an input is not a safetensors file, or has another network than the layout.
    pub fn write<W: Write + Seek>(
        &self,
        open: impl FnOnce() -> std::io::Result<W>,
        bytes: &BTreeMap<String, Vec<u8>>,
    ) -> Result<Written, ExportError> {
        let mut parsed = BTreeMap::new();
        for file in self.reads() {
            let damaged = |why: String| ExportError::Damaged { file: file.to_owned(), why };
            let bytes = bytes.get(file).ok_or_else(|| damaged("was not read".into()))?;
            let tensors = SafeTensors::deserialize(bytes).map_err(|e| damaged(e.to_string()))?;
            if let Some((name, view)) = tensors.iter().find(|(_, view)| view.dtype() != Dtype::F32) {
                return Err(damaged(format!("`{name}` is {:?}; expected F32", view.dtype())));
            }
            parsed.insert(file, tensors);
        }
        let mut all: BTreeMap<String, TensorView<'_>> = BTreeMap::new();
        let mut left_out = BTreeSet::new();
        for (file, names) in &self.files {
            let Some(tensors) = parsed.get(file.as_str()) else { continue };
            let marker = format!("{}{}", names.from, names.marker);
            let weights = self.files.iter().find(|(file, other)| other == names && file.ends_with(FILES[0]));
            let weights = weights.and_then(|(file, _)| parsed.get(file.as_str()));
            if !names.marker.is_empty() && weights.is_none_or(|weights| weights.tensor(&marker).is_err()) {
                if !names.needed {
                    continue;
                }
                let role = names.role;
                return Err(ExportError::Unfit(format!(
                    "the part `{role}` has no tensor `{marker}`, so its network does not match this layout"
                )));
            }
            for (name, view) in tensors.iter() {
                if !self.files.iter().any(|(other, names)| other == file && name.starts_with(names.from)) {
                    left_out.insert(format!("{}/{}", names.role, name.split('.').next().unwrap_or_default()));
                }
                if let Some(rest) = name.strip_prefix(names.from) {
                    all.insert(self.renamed(names, rest), view);
                }
            }
        }
        let count = all.len();
        if count == 0 {
            return Ok(Written { tensors: 0, left_out });
        }
        if self.torch {
            let tensor = |(name, view): (&String, &_)| (name.clone(), torch::Tensor::of(view));
            torch::write(open()?, self.key, &all.iter().map(tensor).collect())?;
        } else {
            let fault = |e: safetensors::SafeTensorError| ExportError::Unfit(e.to_string());
            let bytes = serialize(all, None).map_err(fault)?;
            open()?.write_all(&bytes)?;
        }
        Ok(Written { tensors: count, left_out })
    }

    /// Returns a tensor's name in the exported file.
    fn renamed(&self, names: &Names, rest: &str) -> String {
        // The single codebook of T2M-GPT has no number.
        if self.key == Some("net") && rest == "quantizer.layers.0.codebook" {
            return format!("{}quantizer.codebook", names.to);
        }
        format!("{}{rest}", names.to)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use protocol::artifact::FileEntry;
    use protocol::{Digest, Manifest};
    use serde_json::json;

    use super::*;

    /// Makes a safetensors file of tensors of shape [1] with these names.
    fn file(names: &[&str]) -> Vec<u8> {
        let number = 1.5_f32.to_le_bytes();
        let view = |name: &&str| ((*name).to_owned(), TensorView::new(Dtype::F32, vec![1], &number).unwrap());
        serialize(names.iter().map(view), None).unwrap()
    }

    /// Makes a model of parts with these tensors, and the bytes of its files.
    fn model(generator: &str, parts: &[(&str, &[&str])]) -> (Manifest, BTreeMap<String, Vec<u8>>) {
        let digests: BTreeMap<&str, Digest> =
            parts.iter().map(|(role, _)| (*role, Digest::of(role.as_bytes()))).collect();
        let meta = json!({"generator": generator, "format": "humanml3d", "parts": digests});
        let mut manifest = Manifest::new(ArtifactKind::Model, meta);
        let mut bytes = BTreeMap::new();
        for (role, names) in parts {
            let name = format!("{role}/model.safetensors");
            let own = file(names);
            let entry = FileEntry::of_blob(Digest::of(&own), own.len() as u64);
            manifest.files.insert(name.clone(), entry);
            bytes.insert(name, own);
        }
        (manifest, bytes)
    }

    fn written(planned: &Planned, bytes: &BTreeMap<String, Vec<u8>>) -> Result<(usize, Vec<u8>), ExportError> {
        let mut out = Cursor::new(Vec::new());
        let count = planned.write(|| Ok(&mut out), bytes)?.tensors;
        Ok((count, out.into_inner()))
    }

    #[test]
    fn a_latent_model_has_the_names_of_motion_lcm_in_either_layout() {
        let denoiser = ["time_embedding.linear_1.weight", "query_pos.pe"];
        let control = ["controlnet.controlnet_cond_embedding.0.weight", "traj_encoder.skel_embedding.weight"];
        let parts: [(&str, &[&str]); 4] =
            [("vae", &["query_pos_decoder.pe"]), ("denoiser", &denoiser), ("control", &control), ("text", &["x"])];
        let (manifest, bytes) = model("latent-diffusion", &parts);
        let plan = Layout::Safetensors.plan(&manifest).unwrap();
        let (count, out) = written(&plan.files[0], &bytes).unwrap();
        let tensors = SafeTensors::deserialize(&out).unwrap();
        let mut names = tensors.names();
        names.sort_unstable();
        let expected = [
            "controlnet.controlnet_cond_embedding.0.weight",
            "denoiser.query_pos.pe",
            "denoiser.time_embedding.linear_1.weight",
            "traj_encoder.skel_embedding.weight",
            "vae.query_pos_decoder.pe",
        ];
        assert_eq!((count, names), (5, expected.to_vec()));
        let plan = Layout::MotionLcm.plan(&manifest).unwrap();
        let (count, out) = written(&plan.files[0], &bytes).unwrap();
        let text = String::from_utf8_lossy(&out);
        assert!(count == 5 && text.contains("state_dict") && expected.iter().all(|name| text.contains(name)));
        assert!(plan.left_out.is_empty(), "a text encoder is somebody else's: {:?}", plan.left_out);

        // The network `feedback` is ours: the published layout cannot hold it, ours can.
        let control = [control[0], control[1], "feedback.change.weight"];
        let parts = [parts[0], parts[1], ("control", &control[..])];
        let (manifest, bytes) = model("latent-diffusion", &parts);
        for (layout, tensors, left_out) in
            [(Layout::MotionLcm, 5, vec!["control/feedback"]), (Layout::Safetensors, 6, Vec::new())]
        {
            let written =
                layout.plan(&manifest).unwrap().files[0].write(|| Ok(Cursor::new(Vec::new())), &bytes).unwrap();
            assert_eq!((written.tensors, written.left_out.iter().map(String::as_str).collect()), (tensors, left_out));
        }
    }

    #[test]
    fn a_layout_refuses_what_it_is_not_for_and_says_what_it_leaves_out() {
        let (manifest, bytes) = model("feature-diffusion", &[("denoiser", &["embed_timestep.time_embed.0.weight"])]);
        let plan = Layout::MotionLcm.plan(&manifest).unwrap();
        let said = written(&plan.files[0], &bytes).unwrap_err().to_string();
        assert!(
            said.contains("`time_embedding.linear_1.weight`") && said.contains("does not match this layout"),
            "{said}"
        );
        let said = Layout::Momask.plan(&manifest).unwrap_err().to_string();
        assert!(said.contains("`momask` does not support the model's parts (denoiser)"), "{said}");
        let plan = Layout::Mdm.plan(&manifest).unwrap();
        assert_eq!(written(&plan.files[0], &bytes).unwrap().0, 1);

        let book = ["quantizer.layers.0.codebook"];
        let parts: [(&str, &[&str]); 3] =
            [("tokenizer", &book), ("generator", &["trans_base.tok_emb.weight"]), ("length", &["output.0.weight"])];
        let (manifest, bytes) = model("tokens", &parts);
        let plan = Layout::T2mGpt.plan(&manifest).unwrap();
        assert_eq!(plan.left_out, ["length"]);
        let (_, out) = written(&plan.files[0], &bytes).unwrap();
        assert!(String::from_utf8_lossy(&out).contains("vqvae.quantizer.codebook"), "one codebook has no number there");
        // A masked generator with one codebook has no second network.
        let parts: [(&str, &[&str]); 2] = [("tokenizer", &book), ("generator", &["mask.token_emb.weight"])];
        let (manifest, bytes) = model("tokens", &parts);
        let plan = Layout::Momask.plan(&manifest).unwrap();
        let counts: Vec<usize> = plan.files.iter().map(|file| written(file, &bytes).unwrap().0).collect();
        assert_eq!(counts, [1, 1, 0]);
        let broken = BTreeMap::from([("denoiser/model.safetensors".to_owned(), vec![1, 2, 3])]);
        let (manifest, _) = model("latent-diffusion", &[("denoiser", &["x"])]);
        let said = written(&Layout::Safetensors.plan(&manifest).unwrap().files[0], &broken).unwrap_err().to_string();
        assert!(said.starts_with("`denoiser/model.safetensors`: "), "{said}");
    }
}
