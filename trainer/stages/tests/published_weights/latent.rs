//! VAEs, MotionLCM and its control part (`01_*`, `02_control_*`).

use std::path::{Path, PathBuf};

use checkpoint::published::Layout;
use models::kernels::Dropout;
use models::networks::{Control, Denoiser, Hints, TrajectoryEncoder};
use motion::npy;
use protocol::Digest;
use protocol::artifact::Role;
use protocol::stage::{DataSynthetic, EncodeLatents, ImportModel, ImportedPart, StageSettings};
use stage_lab::Ran;
use stages::artifacts::{self, DenoiserMeta};
use stages::generate::Generator;
use stages::parts::control::ControlMeta;
use stages::parts::latent_networks::Autoencoder;
use stages::parts::text;

use crate::exports::{expect_file, exported};
use crate::fixtures::{self, Array, Arrays, Gates, device, json, name};
use crate::world::{FORWARD, World, blank, part, size, text_of, vae, with_file};

#[test]
fn vaes_give_what_they_were_published_with() {
    protocol::show_excerpts();
    for folder in with_file("01_", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let config = json(&folder.join("config.json"));
        let constructor = &config["constructor"];
        let imported = vae(&mut world, &folder.join("weights.ckpt"), constructor).output();
        // The same weights under the same names in safetensors.
        assert_eq!(vae(&mut world, &folder.join("weights.safetensors"), constructor).output(), imported);
        let manifest = world.manifest(imported);
        world.expect_bits(&manifest, &folder.join("weights.safetensors"), &str::to_owned);
        for layout in [Layout::MotionLcm, Layout::Safetensors] {
            let files: Vec<PathBuf> = exported(&world, imported, layout).into_values().collect();
            assert_eq!(vae(&mut world, &files[0], constructor).output(), imported, "{}: out and in", layout.name());
            if layout == Layout::MotionLcm {
                expect_file(&files[0], &folder.join("weights.ckpt"), &[]);
            }
        }
        let trained = Autoencoder::read(&*world.bench.blobs(), &manifest, &device()).expect("a VAE");
        let io = Arrays::read(&folder.join("io.safetensors"));
        for case in io.cases().into_iter().filter(|case| case != "stats") {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            let lengths = stored("lengths").usizes();
            let (frames, width) = (stored("features").shape[1], stored("features").shape[2]);
            for (b, length) in lengths.iter().enumerate() {
                let cut = |array: &Array| array.values[b * frames * width..][..length * width].to_vec();
                let rows: Vec<f32> = cut(stored("features")).iter().map(|v| *v as f32).collect();
                let mu = trained.encode(rows, *length).mu;
                let own = fixtures::row(stored("mu"), b);
                gates.check("latent", format!("{case}/{b}"), fixtures::error(&mu, &own.values), FORWARD);
                let decoded = trained.decode(own.f32s(), *length);
                gates.check("decoded", &*case, fixtures::error(&decoded, &cut(stored("decoded_mu"))), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

/// Imports a student's file and its folder: the VAE, the model, and the model with its control part.
pub(crate) fn motion_lcm(world: &mut World, folder: &Path, file: &Path) -> (Digest, Digest, Ran) {
    let config = json(&folder.join("config.json"));
    let vae = vae(world, file, &config["vae"]).output();
    let text = world.text(size(&config["denoiser"], "text_dim"));
    let student = !config["denoiser"]["time_cond_proj_dim"].is_null();
    let kind = if student { ImportedPart::Lcm } else { ImportedPart::Mld };
    let heads = size(&config["denoiser"], "num_heads");
    let settings = ImportModel { heads, ..part(kind, file) };
    let lcm = world.imported("denoiser", &settings, &[("vae", vae), ("text", text)]).output();
    let io = Arrays::read(&folder.join("io.safetensors"));
    let hints = world.folder.path().join("hints");
    std::fs::create_dir_all(&hints).expect("a test's own files");
    for (name, key) in [("Mean_raw.npy", "stats/raw_mean"), ("Std_raw.npy", "stats/raw_std")] {
        let stored = io.get(key);
        npy::write(&hints.join(name), &stored.shape, &stored.f32s()).expect("a test's own files");
    }
    let heads = size(&config["traj_encoder"], "num_heads");
    let settings = ImportModel { heads, hint_statistics: text_of(&hints), ..part(ImportedPart::Control, file) };
    let controlled = world.imported("control", &settings, &[("model", lcm)]);
    (vae, lcm, controlled)
}

#[test]
fn motion_lcm_and_its_control_part_give_what_they_were_published_with() {
    protocol::show_excerpts();
    for folder in with_file("02_control", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let file = folder.join("weights.ckpt");
        let (vae, lcm, controlled) = motion_lcm(&mut world, &folder, &file);
        let said = controlled.told.log.join("\n");
        assert!(said.contains("t2m_motionencoder` (") && said.contains("t2m_textencoder` ("), "{said}");
        assert!(!said.contains("denoiser"), "what was held against the model was read: {said}");
        let controlled = controlled.output();
        for layout in [Layout::MotionLcm, Layout::Safetensors] {
            let files: Vec<PathBuf> = exported(&world, controlled, layout).into_values().collect();
            let again = motion_lcm(&mut world, &folder, &files[0]);
            assert_eq!((again.0, again.1, again.2.output()), (vae, lcm, controlled), "{}: out and in", layout.name());
            if layout == Layout::MotionLcm {
                expect_file(&files[0], &file, &["state_dict.t2m_"]);
            }
        }
        let weights = folder.join("weights.safetensors");
        let (denoiser, control) = (world.part(lcm, &Role::DENOISER), world.part(controlled, &Role::CONTROL));
        world.expect_bits(&world.manifest(vae), &weights, &|name| format!("vae.{name}"));
        world.expect_bits(&denoiser, &weights, &|name| format!("denoiser.{name}"));
        world.expect_bits(&control, &weights, &str::to_owned);

        let meta: DenoiserMeta = artifacts::meta(&denoiser, "the denoiser").expect("its meta");
        let own: ControlMeta = artifacts::meta(&control, "the control part").expect("its meta");
        let device = device();
        let base = world.load(Denoiser::new(&meta.config(), &mut blank(&device)), &denoiser, "");
        let net: Denoiser = world.load(own.controlnet(&meta, &mut blank(&device)), &control, "controlnet.");
        let fresh: TrajectoryEncoder = own.trajectory(&meta, &mut blank(&device));
        let trajectory = world.load(fresh, &control, "traj_encoder.");
        let io = Arrays::read(&folder.join("io.safetensors"));
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            if io.find(&format!("{case}/denoiser_output")).is_none() {
                continue;
            }
            let given: Vec<bool> = stored("hint_mask").values.iter().map(|m| *m != 0.0).collect();
            let [batch, frames, joints] = stored("hint").shape[..3] else { panic!("a hint has four axes") };
            let hints = Hints::new(&stored("hint").f32s(), &given, (batch, frames, joints), &device);
            let off = &mut Dropout::off();
            let tokens = trajectory.forward(&hints, off);
            let (noisy, times) = (stored("noisy").tensor::<3>(&device), stored("timesteps").usizes());
            let text = stored("text").tensor::<3>(&device);
            let guidance = io.find(&format!("{case}/w_embedding")).map(|w| w.tensor::<2>(&device));
            let residuals = net.residuals(noisy.clone(), &times, text.clone(), guidance.clone(), tokens.clone(), off);
            gates.tensor("trajectory", &*case, tokens, stored("traj_embedding"), FORWARD);
            let run = Control { residuals: &residuals, scale: 1.0 };
            let out = base.forward_controlled(noisy, &times, text, guidance, run, off);
            gates.tensor("prediction", &*case, out, stored("denoiser_output"), FORWARD);
        }
        gates.close(&name(&folder));
        works(&mut world, vae, controlled, &meta);
    }
}

/// The imported models encode and generate.
fn works(world: &mut World, vae: Digest, model: Digest, meta: &DenoiserMeta) {
    let clips = StageSettings::DataSynthetic(DataSynthetic { clips: 12, ..DataSynthetic::default() });
    let data = world.bench.run("dataset", &clips, &[]).expect("the stage runs").output();
    let latents = StageSettings::EncodeLatents(EncodeLatents::default());
    world.bench.run("latents", &latents, &[("dataset", data), ("vae", vae)]).expect("a VAE like any other");
    if meta.text_dim != text::open(&text::built_in(), &*world.bench.blobs(), &device()).expect("built in").dim() {
        return;
    }
    let model = world.manifest(model);
    let generator = Generator::load(&model, &*world.bench.blobs(), &device()).expect("a model like any other");
    let drawn = generator.generate("a person walks forward.", Some(24), None, protocol::Seed(3)).expect("it draws");
    assert!(drawn.features.iter().all(|v| v.is_finite()));
}
