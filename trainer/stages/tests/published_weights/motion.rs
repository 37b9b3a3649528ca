//! Diffusion of motion itself (`07_mdm*`).

use checkpoint::published::Layout;
use models::kernels::Dropout;
use models::networks::Mdm;
use motion::DataPath;
use protocol::artifact::Role;
use protocol::stage::{DataFormat, ImportModel, ImportedPart};
use stages::published::{Checkpoint, sizes};

use crate::exports::{expect_file, exported};
use crate::fixtures::{self, Array, Arrays, Gates, device, json, name};
use crate::world::{FORWARD, World, blank, format_of, part, size, text_of, with_file};

#[test]
fn mdm_gives_what_it_was_published_with() {
    let device = device();
    for folder in with_file("07_mdm", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let constructor = &config["constructor"];
        let (file, heads) = (folder.join("weights.ckpt"), size(constructor, "num_heads"));
        let features = size(constructor, "njoints");
        let opened = Checkpoint::open(&DataPath::local(&file)).expect("a checkpoint");
        let found = opened.network(&sizes::MDM).expect("an MDM");
        let sizes = sizes::of_mdm(&found, heads).expect("its sizes");
        let text = world.text(size(constructor, "clip_dim"));
        let settings = ImportModel {
            heads,
            timesteps: size(&config["diffusion"], "steps"),
            mask_frames: constructor["mask_frames"].as_bool().expect("a flag"),
            format: format_of(features).unwrap_or(DataFormat::Humanml3d),
            statistics: world.statistics(features),
            ..part(ImportedPart::Mdm, &file)
        };
        let network = if format_of(features).is_some() {
            let model = world.imported("MDM", &settings, &[("text", text)]).output();
            let written = exported(&world, model, Layout::Mdm)["model.pt"].clone();
            expect_file(&written, &file, &[]);
            for file in [written, exported(&world, model, Layout::Safetensors)["model.safetensors"].clone()] {
                let again = ImportModel { path: text_of(&file), ..settings.clone() };
                assert_eq!(world.imported("again", &again, &[("text", text)]).output(), model, "out and in");
            }
            let denoiser = world.part(model, &Role::DENOISER);
            world.expect_bits(&denoiser, &folder.join("weights.safetensors"), &str::to_owned);
            world.load(Mdm::new(&sizes, &mut blank(&device)), &denoiser, "")
        } else {
            // No data set has features of this width, so no stage can make a model of it.
            let refused = world.import(&settings, &[("text", text)]).unwrap_err();
            assert!(refused.contains("set `format`"), "{refused}");
            let network = Mdm::new(&sizes, &mut blank(&device));
            let taken = found.take(&models::flat::layout(&network), &str::to_owned).expect("a whole network");
            models::flat::write(network, &taken.values)
        };
        let masked = settings.mask_frames;
        for case in ["full", "ragged", "single"] {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            // Converts [B, F, 1, T] to [B, T, F].
            let turned = |array: &Array| {
                let (batch, features, frames) = (array.shape[0], array.shape[1], array.shape[3]);
                let at = |b: usize, t: usize, f: usize| array.values[(b * features + f) * frames + t];
                let row = move |b: usize| (0..frames).flat_map(move |t| (0..features).map(move |f| (b, t, f)));
                let values = (0..batch).flat_map(row).map(|(b, t, f)| at(b, t, f)).collect();
                Array { shape: vec![batch, frames, features], values }
            };
            let frames = stored("mask").shape[3];
            let live = |row: &[f64]| row.iter().filter(|v| **v != 0.0).count();
            let lengths: Vec<usize> = stored("mask").values.chunks_exact(frames).map(live).collect();
            let text = stored("text_embed");
            let text = Array { shape: text.shape[1..].to_vec(), values: text.values.clone() }.tensor::<2>(&device);
            let out = network.forward(
                turned(stored("x_t")).tensor(&device),
                &stored("t").usizes(),
                text,
                masked.then_some(&lengths[..]),
                &mut Dropout::off(),
            );
            let wanted = turned(stored("output"));
            // With masked frames nothing past a motion's end can be compared.
            let width = wanted.shape[2];
            let found = fixtures::values(out);
            for (b, length) in lengths.iter().enumerate() {
                let cut = b * frames * width..(b * frames + if masked { *length } else { frames }) * width;
                gates.check("output", case, fixtures::error(&found[cut.clone()], &wanted.values[cut]), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}
