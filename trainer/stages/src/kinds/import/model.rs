//! `import.model`: converts published weights to the output of our training stages. Sources: MLD, MotionLCM, T2M-GPT,
//! MoMask, MMM, MDM, DisCoRD.
//!
//! Facts that the weights lack come from the publication: the noise schedule of a latent diffusion, MDM's cosine,
//! DisCoRD's frequencies. Facts that the publication leaves to the user are settings. Tables of positions and other
//! constants of a published file are kept beside the weights, for a later export.

mod statistics;
mod tokens;

use std::collections::{BTreeMap, BTreeSet};

use burn::module::Module;
use burn::tensor::Device;
use checkpoint::model::{self, Model, Parts};
use models::flat::{Entry, layout};
use models::names::{Weights, from_bytes};
use models::networks::{Denoiser, Init, Vae};
use motion::Skeleton;
use protocol::artifact::Role;
use protocol::stage::{
    DataFormat, Diffusion, ImportModel, ImportedPart, NoiseSchedule, Prediction, StageSpec, TextActivation,
};
use protocol::{ArtifactKind, Digest, Manifest};
use serde::Serialize;

use crate::artifacts::{self, DenoiserMeta, Draft, EmbeddingsMeta, MODEL_FILE, VaeMeta, to_meta, word};
use crate::context::{AttemptContext, ContextError, Outcome, StageError};
use crate::external::{self, Given};
use crate::generate::generator::{FEATURE_DIFFUSION, LATENT_DIFFUSION};
use crate::kinds::shape::Plain;
use crate::parts::control::{CONTROLNET_PREFIX, ControlMeta, TRAJECTORY_PREFIX};
use crate::parts::latent_networks::TIME_DIM;
use crate::parts::motion_networks::{Architecture, MotionDenoiserMeta};
use crate::parts::{self, model_error, weights};
use crate::published::{Checkpoint, Found, Taken, sizes};
use crate::train::data::latents;
use statistics::{FEATURES, JOINTS, statistics};

impl Plain for ImportModel {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        external::read(cx, |cx, given| import(self, cx, given))
    }
}

fn import(settings: &ImportModel, cx: &mut dyn AttemptContext, given: &Given) -> Result<Outcome, StageError> {
    let file = Checkpoint::open(given.path("path")?)?;
    let heads = if settings.heads == 0 { settings.part.heads() } else { settings.heads };
    let device = cx.device().inner();
    let mut import = Import { settings, given, file: &file, heads, device, read: BTreeSet::new(), parameters: 0 };
    let output = match settings.part {
        ImportedPart::Vae => import.vae(cx)?,
        ImportedPart::Mld | ImportedPart::Lcm => import.denoiser(cx)?,
        ImportedPart::Control => import.control(cx)?,
        ImportedPart::Tokenizer => import.tokenizer(cx)?,
        ImportedPart::T2mgpt => import.gpt(cx)?,
        ImportedPart::Momask => import.momask(cx)?,
        ImportedPart::Mmm => import.mmm(cx)?,
        ImportedPart::Mdm => import.mdm(cx)?,
        ImportedPart::Discord => import.discord(cx)?,
    };
    if let Some(left_out) = file.left_out(&import.read) {
        cx.log(&format!("{}: tensors that were not read, by prefix: {left_out}", settings.path));
    }
    let metrics = BTreeMap::from([("parameters".to_owned(), import.parameters as f64)]);
    Ok(Outcome::Finished { output, metrics })
}

struct Import<'a> {
    settings: &'a ImportModel,
    given: &'a Given,
    file: &'a Checkpoint,
    heads: usize,
    device: Device,
    /// Names of the tensors that were read from the file.
    read: BTreeSet<String>,
    parameters: usize,
}

/// A network under the names of our artifacts.
struct Network {
    entries: Vec<Entry>,
    taken: Taken,
}

impl Network {
    /// Adds `prefix` to all names.
    fn under(mut self, prefix: &str) -> Self {
        let rename = |entry: &mut Entry| entry.name.insert_str(0, prefix);
        self.entries.iter_mut().for_each(rename);
        self.taken.constants.iter_mut().for_each(|(entry, _)| rename(entry));
        self
    }

    fn pair(&self) -> (&[Entry], &[f32]) {
        (&self.entries, &self.taken.values)
    }
}

/// Uploads networks as the files of an artifact, and returns its manifest.
fn part(
    cx: &dyn AttemptContext,
    kind: ArtifactKind,
    meta: &impl Serialize,
    networks: &[Network],
) -> Result<Manifest, StageError> {
    let mut draft = Draft::new(cx, kind, to_meta(meta));
    weights::add_all(&mut draft, &networks.iter().map(Network::pair).collect::<Vec<_>>())?;
    let constants = networks.iter().flat_map(|network| &network.taken.constants);
    let constants: Vec<_> = constants.map(|(entry, values)| (std::slice::from_ref(entry), &values[..])).collect();
    if !constants.is_empty() {
        draft.add_pieces(weights::CONSTANTS_FILE, &Weights::of(&constants).pieces())?;
    }
    Ok(draft.into_manifest())
}

/// The setting's value if it departs from the rule, else `None`.
fn departing(found: bool, rule: bool) -> Option<bool> {
    (found != rule).then_some(found)
}

impl Import<'_> {
    /// Reads the tensors of a network, which is created from shapes alone.
    fn network<M: Module>(
        &mut self,
        found: &Found<'_>,
        make: impl FnOnce(&mut Init<'_>) -> M,
    ) -> Result<Network, StageError> {
        let entries = layout(&make(&mut Init::shapes(&self.device)));
        let taken = found.take(&entries, &str::to_owned)?;
        Ok(self.taken(entries, taken))
    }

    fn taken(&mut self, entries: Vec<Entry>, taken: Taken) -> Network {
        self.read.extend(taken.read.iter().cloned());
        self.parameters += taken.values.len();
        Network { entries, taken }
    }

    /// The training data: its format, and the mean and deviation of its features.
    fn statistics(
        &self,
        cx: &dyn AttemptContext,
        features: usize,
        found: &Found<'_>,
    ) -> Result<(DataFormat, Vec<f32>, Vec<f32>), StageError> {
        let dataset = match self.settings.dataset.is_empty() {
            true => None,
            false => {
                let (_, manifest) = artifacts::input(cx, "dataset", ArtifactKind::Dataset)?;
                Some(artifacts::dataset(&*cx.blobs(), &manifest)?)
            }
        };
        let format = dataset.as_ref().map_or(self.settings.format, |dataset| dataset.format);
        let expected = Skeleton::of(format).features;
        if features != expected {
            return Err(found.refuse(format!(
                "its motions have {features} features, but the format `{}` has {expected}; set `format` to the format \
                 that it was trained on",
                word(&format)
            )));
        }
        if let Some(dataset) = dataset {
            return Ok((format, dataset.mean, dataset.std));
        }
        let (mean, std) = statistics(self.given.path("statistics")?, FEATURES, features)?;
        Ok((format, mean, std))
    }

    /// Opens the text encoder `text`, and checks that its captions have `dim` numbers.
    fn text(&self, cx: &dyn AttemptContext, found: &Found<'_>, dim: usize) -> Result<Manifest, StageError> {
        let (_, manifest) = artifacts::input(cx, "text", ArtifactKind::Embeddings)?;
        let meta: EmbeddingsMeta = artifacts::meta(&manifest, "the caption embeddings")?;
        if meta.dim != dim {
            return Err(found.refuse(format!(
                "it expects {dim} numbers per caption, but `text` has {}; embed with the encoder that it was trained \
                 with",
                meta.dim
            )));
        }
        parts::manifest(&*cx.blobs(), meta.text, "the text encoder")
    }

    /// Checks that a network in the file equals that of a part with the entries `entries`.
    fn expect_same(
        &mut self,
        cx: &dyn AttemptContext,
        found: Option<Found<'_>>,
        (entries, part): (&[Entry], &Manifest),
        (what, field): (&str, &str),
    ) -> Result<(), StageError> {
        let Some(found) = found else { return Ok(()) };
        let other = |why: &str| {
            let place = found.prefix();
            found.refuse(format!(
                "its {what}, `{place}`, differs from that of `{field}`{why}; import the {what} from this file too, or \
                 leave it out if it is not used"
            ))
        };
        let taken = found.take(entries, &str::to_owned).map_err(|error| other(&format!(" ({error})")))?;
        let bytes = artifacts::file(&*cx.blobs(), part, MODEL_FILE)?;
        let corrupt = |e| StageError::Context(ContextError::Corrupt(format!("the {what} of `{field}`: {e}")));
        let ours = from_bytes(entries, &bytes, "").map_err(corrupt)?;
        if ours.iter().zip(&taken.values).any(|(ours, theirs)| ours.to_bits() != theirs.to_bits()) {
            return Err(other(": the values differ"));
        }
        self.read.extend(taken.read);
        Ok(())
    }

    fn vae(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let found = self.file.network(&sizes::VAE)?;
        let config = sizes::of_vae(&found, self.heads)?;
        let (format, mean, std) = self.statistics(cx, config.features, &found)?;
        let meta = VaeMeta {
            format,
            features: config.features,
            latent: config.latent,
            projection: departing(config.projection, config.latent.dim != config.network.width),
            network: config.network,
            mean,
            std,
        };
        let network = self.network(&found, |init| Vae::new(&meta.config(), init))?;
        Ok(cx.put_manifest(&part(cx, ArtifactKind::Vae, &meta, &[network])?)?)
    }

    fn denoiser(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let (vae_digest, vae_part) = artifacts::input(cx, "vae", ArtifactKind::Vae)?;
        let vae: VaeMeta = artifacts::meta(&vae_part, "the VAE")?;
        let found = self.file.network(&sizes::DENOISER)?;
        let config = sizes::of_denoiser(&found, vae.latent.tokens, self.heads)?;
        let family = self.settings.family().ok_or_else(|| StageError::Fault("the denoiser has no family".into()))?;
        match (config.guidance_dim, family.is_student()) {
            (Some(_), false) => {
                return Err(found.refuse("it embeds a guidance scale, so it is a student; write `part: lcm`"));
            }
            (None, true) => {
                return Err(found.refuse("it embeds no guidance scale, so it is a teacher; write `part: mld`"));
            }
            _ => {}
        }
        if config.latent != vae.latent {
            let ours = config.latent.dim;
            let theirs = vae.latent;
            return Err(found.refuse(format!(
                "its latent tokens are {ours} wide, but the latents of `vae` are {}x{}; use the VAE that it was \
                 trained with",
                theirs.tokens, theirs.dim
            )));
        }
        let text = self.text(cx, &found, config.text_dim)?;
        let vae_entries = layout(&Vae::new(&vae.config(), &mut Init::shapes(&self.device)));
        self.expect_same(cx, self.file.beside(&sizes::VAE), (&vae_entries, &vae_part), ("VAE", "vae"))?;
        let meta = DenoiserMeta {
            family,
            latent: vae.latent,
            projection: departing(config.projection, config.latent.dim != config.network.width),
            network: config.network,
            diffusion: Diffusion::default(),
            text_relu: match self.settings.text_activation {
                TextActivation::Published => config.text_relu,
                TextActivation::Relu => true,
                TextActivation::None => false,
            },
            guidance_dim: config.guidance_dim.unwrap_or_default(),
            text_dim: config.text_dim,
            fits: Parts::from([(Role::VAE, vae_digest), (Role::TEXT, text.digest())]),
            time_dim: (config.time_dim != TIME_DIM).then_some(config.time_dim),
        };
        let network = self.network(&found, |init| Denoiser::new(&meta.config(), init))?;
        let parts = BTreeMap::from([(Role::VAE, vae_part), (Role::TEXT, text)]);
        latents::publish(cx, vae.format, &meta, network.pair(), parts)
    }

    fn control(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let model = Model::read(&manifest).map_err(model_error)?;
        if model.parts.contains_key(&Role::CONTROL) || model.generator != LATENT_DIFFUSION {
            return Err(StageError::Input(
                "`model` already has a control part, or is not a latent diffusion model; use the model that the part \
                 controls"
                    .into(),
            ));
        }
        let part = parts::part(&*cx.blobs(), &model, &Role::DENOISER, ArtifactKind::Denoiser)?;
        let base: DenoiserMeta = artifacts::meta(&part, "the denoiser of `model`")?;
        let entries = layout(&Denoiser::new(&base.config(), &mut Init::shapes(&self.device)));
        let same = ("denoiser", "model");
        self.expect_same(cx, self.file.beside(&sizes::DENOISER), (&entries, &part), same)?;
        if let Some(vae) = self.file.beside(&sizes::VAE) {
            let part = parts::part(&*cx.blobs(), &model, &Role::VAE, ArtifactKind::Vae)?;
            let meta: VaeMeta = artifacts::meta(&part, "the VAE of `model`")?;
            let entries = layout(&Vae::new(&meta.config(), &mut Init::shapes(&self.device)));
            self.expect_same(cx, Some(vae), (&entries, &part), ("VAE", "model"))?;
        }
        let (control, trajectory) =
            (self.file.network(&sizes::CONTROLNET)?, self.file.network(&sizes::TRAJECTORY_ENCODER)?);
        let config = sizes::of_trajectory(&trajectory, self.heads)?;
        let joints = Skeleton::of(model.format).joints;
        if config.joints != joints {
            let found = config.joints;
            let format = word(&model.format);
            return Err(trajectory.refuse(format!("it expects {found} joints, but `{format}` has {joints}")));
        }
        if config.latent != base.latent {
            return Err(trajectory.refuse(format!(
                "its tokens are {}x{}, but the latents of `model` are {}x{}; use the model that it was trained with",
                config.latent.tokens, config.latent.dim, base.latent.tokens, base.latent.dim
            )));
        }
        let (mean, std) = statistics(self.given.path("hint_statistics")?, JOINTS, 3 * joints)?;
        let meta = ControlMeta {
            format: model.format,
            hints: self.settings.hints.clone(),
            embedding: control.dim("controlnet_cond_embedding.0.weight", 0)?,
            projection: departing(config.projection, config.latent.dim != config.network.width),
            network: config.network,
            mean,
            std,
            fits: Parts::from([(Role::DENOISER, part.digest())]),
            feedback: 0,
        };
        let control = self.network(&control, |init| meta.controlnet(&base, init))?.under(CONTROLNET_PREFIX);
        let trajectory = self.network(&trajectory, |init| meta.trajectory(&base, init))?.under(TRAJECTORY_PREFIX);
        let part = self::part(cx, ArtifactKind::Control, &meta, &[control, trajectory])?;
        cx.put_manifest(&part)?;
        let model = model::extend(&manifest, None, &BTreeMap::from([(Role::CONTROL, part)])).map_err(model_error)?;
        Ok(cx.put_manifest(&model)?)
    }

    fn mdm(&mut self, cx: &mut dyn AttemptContext) -> Result<Digest, StageError> {
        let found = self.file.network(&sizes::MDM)?;
        let config = sizes::of_mdm(&found, self.heads)?;
        let (format, mean, std) = self.statistics(cx, config.features, &found)?;
        let text = self.text(cx, &found, config.text_dim)?;
        let family =
            self.settings.family().ok_or_else(|| StageError::Fault("the MDM denoiser has no family".into()))?;
        let diffusion =
            Diffusion { schedule: NoiseSchedule::Cosine, prediction: Prediction::Sample, ..Diffusion::default() };
        let meta = MotionDenoiserMeta {
            family,
            architecture: Architecture::Mdm(config.network.clone()),
            format,
            diffusion,
            mask_frames: self.settings.mask_frames,
            max_frames: self.settings.max_frames,
            mean,
            std,
            text_dim: config.text_dim,
            fits: Parts::from([(Role::TEXT, text.digest())]),
        };
        let network = self.network(&found, |init| meta.mdm(&config.network, init))?;
        let denoiser = part(cx, ArtifactKind::Denoiser, &meta, &[network])?;
        let parts = BTreeMap::from([(Role::DENOISER, denoiser), (Role::TEXT, text)]);
        parts::publish_model(cx, FEATURE_DIFFUSION, meta.format, &parts)
    }
}
