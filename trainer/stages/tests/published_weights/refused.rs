//! Refused imports: incomplete networks, invalid files, parts of other models.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::stage::{DataFormat, ImportModel, ImportedPart};
use stages::artifacts;

use crate::fixtures::json;
use crate::latent::motion_lcm;
use crate::world::{World, part, size, with_file};

/// Tensors by name: shape and values.
type Named = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Writes tensors as a safetensors file after `change`.
fn changed(from: &Path, to: &Path, change: &dyn Fn(&mut Named)) {
    let bytes = std::fs::read(from).expect("a file of the fixture");
    let stored = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
    let floats = |data: &[u8]| data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let mut all =
        stored.iter().map(|(name, view)| (name.to_owned(), (view.shape().to_vec(), floats(view.data())))).collect();
    change(&mut all);
    let all = all
        .into_iter()
        .fold(artifacts::Tensors::default(), |all, (name, (shape, values))| all.with(&name, shape, values));
    std::fs::write(to, all.to_bytes().expect("tensors")).expect("a test's own files");
}

#[test]
fn what_makes_no_whole_network_is_refused_with_all_that_is_wrong() {
    protocol::show_excerpts();
    let Some(folder) = with_file("01_vae_v2", "weights.ckpt").into_iter().next() else { return };
    let mut world = World::new();
    let (from, to) = (folder.join("weights.safetensors"), world.folder.path().join("changed.safetensors"));
    let config = json(&folder.join("config.json"));
    let settings = ImportModel {
        heads: size(&config["constructor"], "num_heads"),
        statistics: world.statistics(263),
        ..part(ImportedPart::Vae, &to)
    };
    let mut refused = |change: &dyn Fn(&mut Named), settings: &ImportModel| {
        changed(&from, &to, change);
        world.import(settings, &[]).map(|ran| ran.output()).unwrap_err()
    };
    let said = refused(
        &|all| {
            all.remove("decoder.norm.bias");
            all.insert("final_layer.bias".into(), (vec![5], vec![0.0; 5]));
            all.insert("encoder.input_blocks.0.norm9.bias".into(), (vec![2], vec![0.0; 2]));
        },
        &settings,
    );
    for part in [
        "changed.safetensors: ",
        "`decoder.norm.bias` [",
        "is missing",
        "`final_layer.bias` has shape [5]; expected [263]",
        "`encoder.input_blocks.0.norm9.bias` [2] is not part of this network",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let nan = refused(&|all| all.get_mut("final_layer.bias").expect("it").1[3] = f32::NAN, &settings);
    assert!(nan.contains("`final_layer.bias`: number 3 of 263 is not finite"), "{nan}");
    // A wide axis describes a network that the file does not hold; nothing is allocated for it.
    let wide = refused(
        &|all| {
            let huge = (vec![3, 1 << 20], vec![0.0; 3 << 20]);
            all.insert("encoder.middle_block.self_attn.in_proj_weight".into(), huge);
        },
        &settings,
    );
    assert!(wide.contains("and ") && wide.contains(" more"), "{wide}");
    let heads = refused(&|_| {}, &ImportModel { heads: 7, ..settings.clone() });
    assert!(heads.contains("not a multiple of the 7 attention heads; set `heads`"), "{heads}");
    let kit = refused(&|_| {}, &ImportModel { format: DataFormat::Kit, ..settings.clone() });
    assert!(kit.contains("263 features") && kit.contains("set `format`"), "{kit}");
    let other = refused(&|_| {}, &ImportModel { part: ImportedPart::Tokenizer, ..settings.clone() });
    assert!(other.contains("it has no tokenizer: the tensor `encoder.model.0.weight` is missing"), "{other}");
    let extra = |all: &mut BTreeMap<String, (Vec<usize>, Vec<f32>)>| {
        all.insert("text_encoder.x".into(), (vec![1], vec![0.0]));
        all.insert("t2m_textencoder.hidden".into(), (vec![1], vec![0.0]));
    };
    changed(&from, &to, &extra);
    let ran = world.imported("with extra names", &settings, &[]);
    assert!(ran.told.log.join("").contains("`t2m_textencoder` (1), `text_encoder` (1)"), "{:?}", ran.told.log);
}

#[test]
fn nothing_of_a_file_is_run_and_none_but_weights_are_read() {
    protocol::show_excerpts();
    let mut world = World::new();
    let owned = world.folder.path().join("owned");
    let command = format!("touch {}", owned.display());
    let length = u32::try_from(command.len()).expect("a short command").to_le_bytes();
    let pickle = [&b"cposix\nsystem\n(X"[..], &length, command.as_bytes(), b"tR."].concat();
    let long_header = [&(1_u64 << 60).to_le_bytes()[..], b"{}"].concat();
    for (name, bytes, words) in [
        ("pickle.tar", pickle, "expected a dict"),
        ("short.ckpt", b"PK".to_vec(), "has 2 bytes; expected a torch checkpoint"),
        ("long.safetensors", long_header, "header"),
        ("no.ckpt", b"PK\x03\x04 is no archive at all".to_vec(), "no.ckpt: "),
    ] {
        let file = world.folder.path().join(name);
        std::fs::write(&file, bytes).expect("a test's own files");
        let settings = ImportModel { statistics: world.statistics(263), ..part(ImportedPart::Vae, &file) };
        let said = world.import(&settings, &[]).map(|ran| ran.output()).unwrap_err();
        assert!(said.to_lowercase().contains(words) && said.contains(name), "{name}: {said}");
    }
    assert!(!owned.exists(), "a pickle was run");
}

#[test]
fn what_is_of_another_kind_or_of_another_vae_is_refused() {
    protocol::show_excerpts();
    let Some(folder) = with_file("02_control", "weights.ckpt").into_iter().next() else { return };
    let mut world = World::new();
    let (file, config) = (folder.join("weights.ckpt"), json(&folder.join("config.json")));
    let (vae, _, _) = motion_lcm(&mut world, &folder, &file);
    let text = world.text(size(&config["denoiser"], "text_dim"));
    let settings = ImportModel { heads: size(&config["denoiser"], "num_heads"), ..part(ImportedPart::Lcm, &file) };
    let teacher = ImportModel { part: ImportedPart::Mld, ..settings.clone() };
    let said = world.import(&teacher, &[("vae", vae), ("text", text)]).unwrap_err();
    assert!(said.contains("write `part: lcm`"), "{said}");
    let narrow = world.text(12);
    let said = world.import(&settings, &[("vae", vae), ("text", narrow)]).unwrap_err();
    assert!(said.contains("768 numbers per caption, but `text` has 12"), "{said}");
    // Another VAE of the same size: one number differs.
    let (from, to) = (folder.join("weights.safetensors"), world.folder.path().join("other.safetensors"));
    changed(&from, &to, &|all| all.get_mut("vae.final_layer.bias").expect("it").1[0] += 1.0);
    let other = {
        let file = to;
        crate::world::vae(&mut world, &file, &config["vae"]).output()
    };
    let said = world.import(&settings, &[("vae", other), ("text", text)]).unwrap_err();
    assert!(said.contains("its VAE, `state_dict.vae.`") && said.contains("the values differ"), "{said}");
}
