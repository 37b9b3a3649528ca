//! A registered model from a denoiser and the VAE whose latents it makes: everything that drawing a motion needs.
//!
//! Only manifests are read and written. The weights stay the blobs they were, so a VAE that ten students share is stored once.
//!
//! Files: `denoiser.safetensors`, `vae.safetensors`. Meta: `denoiser` and `vae`, the metas of the two parts as their stages
//! wrote them; `sources`, the digests of their manifests; `sampler`, how to draw when nobody says.

use protocol::artifact::FileEntry;
use protocol::stage::Sampler;
use protocol::{ArtifactKind, Digest, Manifest};
use serde_json::{Value, json};

/// Where the denoiser's weights are.
pub const DENOISER_FILE: &str = "denoiser.safetensors";
/// Where the VAE's weights are.
pub const VAE_FILE: &str = "vae.safetensors";
/// The name of the weights in the artifacts that a model is made of.
const WEIGHTS: &str = "model.safetensors";

/// The model made of `denoiser` and `vae`, drawn from as its family is by default.
pub fn bundle(denoiser: &Manifest, vae: &Manifest) -> Result<Manifest, String> {
    assemble(denoiser, vae, None)
}

/// The model made of `denoiser` and `vae`, drawn from with `sampler` when nobody says otherwise.
pub fn bundle_with(denoiser: &Manifest, vae: &Manifest, sampler: &Sampler) -> Result<Manifest, String> {
    assemble(denoiser, vae, Some(sampler))
}

fn assemble(denoiser: &Manifest, vae: &Manifest, sampler: Option<&Sampler>) -> Result<Manifest, String> {
    let weights = |manifest: &Manifest, kind: ArtifactKind, what: &str| -> Result<FileEntry, String> {
        if manifest.kind != kind {
            return Err(format!("the {what} is an artifact of kind {:?}, expected {kind:?}", manifest.kind));
        }
        manifest.files.get(WEIGHTS).cloned().ok_or_else(|| format!("the {what} has no file `{WEIGHTS}`"))
    };
    let denoiser_weights = weights(denoiser, ArtifactKind::Denoiser, "denoiser")?;
    let vae_weights = weights(vae, ArtifactKind::Vae, "VAE")?;

    let wanted = vae_of(denoiser)?;
    let (denoiser_digest, vae_digest) = (denoiser.digest(), vae.digest());
    if wanted != vae_digest {
        return Err(format!(
            "the denoiser makes latents of the VAE {}, not of the VAE {}",
            wanted.short(),
            vae_digest.short()
        ));
    }
    let (theirs, ours) = (field(&denoiser.meta, "latent")?, field(&vae.meta, "latent")?);
    if theirs != ours {
        return Err(format!("the denoiser's latent is {theirs}, the VAE's is {ours}"));
    }

    let sampler = sampler.cloned().map_or_else(|| default_sampler(&denoiser.meta), Ok)?;
    let mut model = Manifest::new(
        ArtifactKind::Model,
        json!({
            "denoiser": denoiser.meta,
            "vae": vae.meta,
            "sampler": sampler,
            "sources": {"denoiser": denoiser_digest, "vae": vae_digest},
        }),
    );
    model.files.insert(DENOISER_FILE.to_owned(), denoiser_weights);
    model.files.insert(VAE_FILE.to_owned(), vae_weights);
    Ok(model)
}

/// The digest of the VAE whose latents `denoiser` makes.
pub fn vae_of(denoiser: &Manifest) -> Result<Digest, String> {
    serde_json::from_value(field(&denoiser.meta, "vae")?.clone())
        .map_err(|e| format!("`vae` in the denoiser's manifest: {e}"))
}

/// How a family is drawn from when nobody says: a teacher with 50 steps at its published guidance, a student with as many
/// steps as it has phases (an LCM with one), at a third of the range of guidance scales that it was trained for. The published
/// range 5 to 15 gives w = 8.3, near MotionLCM's 7 to 12.5; 0.5 to 5 gives w = 2.
pub fn default_sampler(denoiser: &Value) -> Result<Sampler, String> {
    let student = |steps: usize| -> Result<Sampler, String> {
        let range = field(denoiser, "guidance")?;
        let (lo, hi): (f64, f64) =
            serde_json::from_value(range.clone()).map_err(|e| format!("`guidance` in the denoiser's manifest: {e}"))?;
        Ok(Sampler { steps, guidance: lo + (hi - lo) / 3.0, ..Sampler::default() })
    };
    match field(denoiser, "family")?.as_str() {
        Some("mld") => Ok(Sampler { steps: 50, guidance: 7.5, ..Sampler::default() }),
        Some("lcm") => student(1),
        Some("pcm") => {
            let phases = field(denoiser, "phases")?.as_u64().and_then(|n| usize::try_from(n).ok());
            student(phases.ok_or("`phases` in the denoiser's manifest is not a count")?)
        }
        other => Err(format!("`family` in the denoiser's manifest is {other:?}, expected mld, lcm or pcm")),
    }
}

/// The data format (`humanml3d`, `kit`) of the motion that a bundled model makes.
pub fn format(model: &Manifest) -> Option<&str> {
    model.meta["vae"]["format"].as_str()
}

fn field<'a>(meta: &'a Value, name: &str) -> Result<&'a Value, String> {
    meta.get(name).ok_or_else(|| format!("the manifest has no `{name}`"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(kind: ArtifactKind, meta: Value) -> Manifest {
        let mut manifest = Manifest::new(kind, meta);
        manifest
            .files
            .insert(WEIGHTS.into(), FileEntry { digest: Digest::of(format!("{kind:?}").as_bytes()), bytes: 3 });
        manifest
    }

    fn parts(latent: Value) -> (Manifest, Manifest) {
        let vae = part(ArtifactKind::Vae, json!({"latent": {"tokens": 16, "dim": 32}}));
        let meta = json!({"family": "pcm", "phases": 2, "guidance": [0.5, 5.0], "latent": latent, "vae": vae.digest()});
        (part(ArtifactKind::Denoiser, meta), vae)
    }

    #[test]
    fn a_model_lists_the_blobs_of_both_parts() {
        let (denoiser, vae) = parts(json!({"tokens": 16, "dim": 32}));
        let model = bundle(&denoiser, &vae).expect("they fit");
        assert_eq!(model.kind, ArtifactKind::Model);
        assert_eq!(model.files[DENOISER_FILE], denoiser.files[WEIGHTS]);
        assert_eq!(model.files[VAE_FILE], vae.files[WEIGHTS]);
        assert_eq!(model.meta["sampler"], json!({"steps": 2, "guidance": 2.0, "timesteps": []}));
        assert_eq!(model.digest(), bundle(&denoiser, &vae).expect("they fit").digest());
    }

    #[test]
    fn parts_that_do_not_fit_are_refused() {
        let (denoiser, vae) = parts(json!({"tokens": 1, "dim": 32}));
        assert!(bundle(&denoiser, &vae).expect_err("another shape").contains("latent"));
        let (denoiser, _) = parts(json!({"tokens": 16, "dim": 32}));
        let other = part(ArtifactKind::Vae, json!({"latent": {"tokens": 16, "dim": 32}, "mean": [1.0]}));
        assert!(bundle(&denoiser, &other).expect_err("another VAE").contains("VAE"));
        assert!(bundle(&other, &denoiser).expect_err("swapped").contains("kind"));
    }
}
