//! Tokenizers, their generators and the flow decoder (`05_*`, `06_*`).

use motion::DataPath;
use std::path::Path;

use checkpoint::published::Layout;
use models::kernels::Dropout;
use models::networks::{FlowUnet, Gpt, MaskedTransformer, Mmm, ResidualTransformer};
use protocol::artifact::Role;
use protocol::stage::{ImportModel, ImportedPart};
use protocol::{Digest, Manifest};
use stages::parts::tokenizer::TrainedTokenizer;
use stages::published::{Checkpoint, sizes};

use crate::exports::{expect_file, exported};
use crate::fixtures::{self, Arrays, Gates, device, json, name};
use crate::world::{FORWARD, World, blank, format_of, part, size, stand_in, text_of, with_file};

/// A tokenizer of one of the fixtures, or one that fits a generator.
fn tokenizer(world: &mut World, file: &Path, features: usize) -> Digest {
    let settings = ImportModel {
        format: format_of(features).expect("a format with these features"),
        statistics: world.statistics(features),
        ..part(ImportedPart::Tokenizer, file)
    };
    world.imported(&text_of(file), &settings, &[]).output()
}

#[test]
fn tokenizers_give_what_they_were_published_with() {
    let all = [with_file("05_rvq", "weights.ckpt"), with_file("05_t2mgpt_vqvae", "weights.ckpt")].concat();
    for folder in all {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let io = Arrays::read(&folder.join("io.safetensors"));
        let features = io.get("full/motion").shape[2];
        let imported = tokenizer(&mut world, &folder.join("weights.ckpt"), features);
        assert_eq!(tokenizer(&mut world, &folder.join("weights.safetensors"), features), imported);
        let manifest = world.manifest(imported);
        let layout =
            if trained_single(&manifest) { (Layout::T2mGpt, "vqvae.pth") } else { (Layout::Momask, "rvq.tar") };
        let files = exported(&world, imported, layout.0);
        expect_file(&files[layout.1], &folder.join("weights.ckpt"), &[]);
        for file in
            [files[layout.1].clone(), exported(&world, imported, Layout::Safetensors)["model.safetensors"].clone()]
        {
            assert_eq!(tokenizer(&mut world, &file, features), imported, "out and in");
        }
        let trained = TrainedTokenizer::read(&*world.bench.blobs(), &manifest, &device()).expect("a tokenizer");
        let config = json(&folder.join("config.json"));
        assert_eq!(
            (trained.meta().codes, trained.meta().code_dim),
            (size(&config, "nb_code"), size(&config, "code_dim"))
        );
        assert_eq!(trained.meta().network.depth, size(&config, "depth"));
        for case in io.cases() {
            let Some(indices) = io.find(&format!("{case}/code_idx")) else { continue };
            let motion = io.get(&format!("{case}/motion"));
            let wanted = io.get(&format!("{case}/reconstruction"));
            for b in 0..motion.shape[0] {
                let ids = trained.encode(fixtures::row(motion, b).f32s());
                let stored: Vec<i64> = fixtures::row(indices, b).values.iter().map(|v| *v as i64).collect();
                assert_eq!(ids, stored, "{case}: ids");
                let decoded = trained.decode(&ids);
                let own = fixtures::row(wanted, b);
                gates.check("decoded", format!("{case}/{b}"), fixtures::error(&decoded, &own.values), FORWARD);
            }
        }
        gates.close(&name(&folder));
    }
}

/// Returns true if a tokenizer has one codebook.
fn trained_single(manifest: &Manifest) -> bool {
    manifest.meta["quantizers"] == 1
}

#[test]
fn token_generators_give_what_they_were_published_with() {
    let device = device();
    for folder in with_file("05_t2mgpt_transformer", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let (file, heads) = (folder.join("weights.ckpt"), size(&config, "heads"));
        let inputs = [
            ("tokenizer", stand_in(&world, size(&config, "num_vq"), 1, 8)),
            ("text", world.text(size(&config, "clip_dim"))),
        ];
        let settings = ImportModel { heads, ..part(ImportedPart::T2mgpt, &file) };
        let model = world.imported("transformer", &settings, &inputs).output();
        let files = exported(&world, model, Layout::T2mGpt);
        expect_file(&files["transformer.pth"], &file, &[]);
        for file in [&files["transformer.pth"], &exported(&world, model, Layout::Safetensors)["model.safetensors"]] {
            let again = ImportModel { path: text_of(file), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &inputs).output(), model, "out and in");
        }
        let generator = world.part(model, &Role::GENERATOR);
        assert_eq!(generator.meta["longest"], size(&config, "block_size") - 2);
        world.expect_bits(&generator, &folder.join("weights.safetensors"), &str::to_owned);
        let opened = Checkpoint::open(&DataPath::local(&file)).expect("a checkpoint");
        let sizes = sizes::of_gpt(&sizes::gpt(&opened).expect("it"), 1, heads).expect("its sizes");
        let network = world.load(Gpt::new(&sizes, &mut blank(&device)), &generator, "");
        for case in ["full", "short"] {
            let wanted = io.get(&format!("{case}/logits"));
            let all = io.get("full/cond").tensor::<2>(&device);
            let text = all.clone().slice([0..wanted.shape[0], 0..all.dims()[1]]);
            let logits = network.forward(&io.get(&format!("{case}/ids")).usizes(), text, &mut Dropout::off());
            gates.tensor("logits", case, logits, wanted, FORWARD);
        }
        gates.close(&name(&folder));
    }
    for folder in with_file("05_momask", "masked.tar") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let heads = size(&config, "heads");
        let (masked, residual) = (folder.join("masked.tar"), folder.join("residual.tar"));
        let tokenizer = stand_in(&world, size(&config, "num_tokens"), size(&config, "num_quantizers"), 8);
        let inputs = [("tokenizer", tokenizer), ("text", world.text(size(&config, "clip_dim")))];
        let settings = ImportModel { heads, residual: text_of(&residual), ..part(ImportedPart::Momask, &masked) };
        let model = world.imported("transformers", &settings, &inputs).output();
        let generator = world.part(model, &Role::GENERATOR);
        world.expect_bits(&generator, &folder.join("weights.safetensors"), &str::to_owned);
        assert!(generator.files.contains_key("constants.safetensors"), "the table of positions is kept");
        let files = exported(&world, model, Layout::Momask);
        expect_file(&files["masked.tar"], &masked, &[]);
        expect_file(&files["residual.tar"], &residual, &[]);
        let one = &exported(&world, model, Layout::Safetensors)["model.safetensors"];
        for (path, residual) in [(&files["masked.tar"], &files["residual.tar"]), (one, one)] {
            let again = ImportModel { path: text_of(path), residual: text_of(residual), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &inputs).output(), model, "out and in");
        }
        let alone = world.import(&ImportModel { residual: String::new(), ..settings }, &inputs).unwrap_err();
        assert!(alone.contains("set `residual`"), "{alone}");

        let opened = Checkpoint::open(&DataPath::local(&residual)).expect("a checkpoint");
        let sizes = sizes::of_residual(&sizes::residual(&opened).expect("it"), heads).expect("its sizes");
        let first = world.load(MaskedTransformer::new(&sizes, &mut blank(&device)), &generator, "mask.");
        let above = world.load(ResidualTransformer::new(&sizes, true, &mut blank(&device)), &generator, "res.");
        let (text, lengths) = (io.get("cond").tensor::<2>(&device), io.get("m_lens").usizes());
        let off = &mut Dropout::off();
        let logits = first.forward(&io.get("mask/ids").usizes(), text.clone(), &lengths, off);
        gates.tensor("logits", "masked", logits.swap_dims(1, 2), io.get("mask/logits_cond"), FORWARD);
        let sums = io.get("res/history_sum").tensor::<3>(&device);
        let logits = above.forward(sums, &io.get("res/qids").usizes(), text, &lengths, off);
        gates.tensor("logits", "residual", logits.swap_dims(1, 2), io.get("res/logits"), FORWARD);
        gates.close(&name(&folder));
    }
}

#[test]
fn mmm_is_read_without_the_tokenizer_in_its_file() {
    for folder in with_file("05_mmm", "weights.safetensors") {
        let mut world = World::new();
        let file = folder.join("weights.safetensors");
        let opened = Checkpoint::open(&DataPath::local(&file)).expect("a checkpoint");
        let found = sizes::mmm(&opened).expect("it");
        let sizes = sizes::of_mmm(&found, 1, 1).expect("its sizes");
        let inputs = [("tokenizer", stand_in(&world, sizes.codes, 1, sizes.dim)), ("text", world.text(sizes.text_dim))];
        let ran = world.imported("MMM", &ImportModel { heads: 1, ..part(ImportedPart::Mmm, &file) }, &inputs);
        let generator = world.part(ran.output(), &Role::GENERATOR);
        world.expect_bits(&generator, &file, &str::to_owned);
        let device = device();
        world.load(Mmm::new(&sizes, &mut blank(&device)), &generator, "");
    }
}

#[test]
fn discord_gives_what_it_was_published_with() {
    let device = device();
    for folder in with_file("06_discord_unet", "weights.ckpt") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let (config, io) = (json(&folder.join("config.json")), Arrays::read(&folder.join("io.safetensors")));
        let file = folder.join("weights.ckpt");
        let tokenizer = stand_in(&world, 8, 2, size(&config["constructor"], "c_in_dim"));
        let heads = size(&config["constructor"], "attn_heads");
        let settings = ImportModel { heads, ..part(ImportedPart::Discord, &file) };
        let decoder = world.imported("decoder", &settings, &[("tokenizer", tokenizer)]).output();
        let written = exported(&world, decoder, Layout::Momask)["discord.pth"].clone();
        expect_file(&written, &file, &[]);
        for file in [written, exported(&world, decoder, Layout::Safetensors)["model.safetensors"].clone()] {
            let again = ImportModel { path: text_of(&file), ..settings.clone() };
            assert_eq!(world.imported("again", &again, &[("tokenizer", tokenizer)]).output(), decoder, "out and in");
        }
        let decoder = world.manifest(decoder);
        world.expect_bits(&decoder, &folder.join("weights.safetensors"), &str::to_owned);
        let opened = Checkpoint::open(&DataPath::local(&file)).expect("a checkpoint");
        let sizes = sizes::of_unet(&sizes::unet(&opened).expect("it"), (heads, 32)).expect("its sizes");
        let network = world.load(FlowUnet::new(&sizes, &mut blank(&device)), &decoder, "");
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            if io.find(&format!("{case}/v")).is_none() {
                continue;
            }
            let tokens = stored("c").tensor::<3>(&device);
            let out = network.forward(stored("x_t").tensor(&device), &stored("t").f32s(), tokens, &mut Dropout::off());
            gates.tensor("velocity", &*case, out, stored("v"), FORWARD);
        }
        gates.close(&name(&folder));
    }
}
