//! Published tensor names and sizes, pinned: a renamed field would make published files unreadable.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::Device;
use models::flat::{self, layout};
use models::names::{LoadError, Weights, load, load_from, save, to_bytes};
use models::networks::{
    Denoiser, DenoiserConfig, Discriminator, Evaluator, EvaluatorConfig, Init, Mdm, MdmConfig, POSITIONS,
    TrajectoryConfig, TrajectoryEncoder, Vae, VaeConfig,
};
use protocol::Seed;
use protocol::stage::{LatentShape, MdmNetwork, Network, Positions};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors, serialize};

fn vae_config(v2: bool) -> VaeConfig {
    VaeConfig {
        features: 263,
        latent: LatentShape { tokens: if v2 { 16 } else { 1 }, dim: if v2 { 32 } else { 256 } },
        network: Network { width: 256, layers: 9, heads: 4, feed_forward: 1024, ..Network::default() },
        projection: v2,
    }
}

fn denoiser_config(v2: bool, guidance_dim: Option<usize>) -> DenoiserConfig {
    DenoiserConfig {
        latent: LatentShape { tokens: if v2 { 16 } else { 1 }, dim: if v2 { 32 } else { 256 } },
        network: Network { width: 256, layers: 9, heads: 4, feed_forward: 1024, ..Network::default() },
        text_dim: 768,
        time_dim: 768,
        text_relu: !v2,
        projection: v2,
        guidance_dim,
    }
}

fn trajectory_config(v2: bool) -> TrajectoryConfig {
    TrajectoryConfig {
        joints: 22,
        latent: LatentShape { tokens: if v2 { 16 } else { 1 }, dim: if v2 { 32 } else { 256 } },
        network: Network { width: 256, layers: 9, heads: 4, feed_forward: 1024, ..Network::default() },
        projection: v2,
    }
}

fn mdm_config(features: usize) -> MdmConfig {
    MdmConfig { features, network: MdmNetwork::default(), text_dim: 512 }
}

fn small_vae() -> VaeConfig {
    VaeConfig { latent: LatentShape { tokens: 2, dim: 4 }, network: small_network(), ..vae_config(true) }
}

fn small_network() -> Network {
    Network { width: 8, layers: 3, heads: 2, feed_forward: 12, ..Network::default() }
}

fn small_denoiser(guidance_dim: Option<usize>) -> DenoiserConfig {
    DenoiserConfig {
        latent: LatentShape { tokens: 2, dim: 4 },
        network: small_network(),
        text_dim: 6,
        time_dim: 10,
        ..denoiser_config(true, guidance_dim)
    }
}

fn with<M>(make: impl Fn(&mut Init<'_>) -> M) -> M {
    make(&mut Init::new(Seed(7), "names", Positions::Uniform, &Device::flex()))
}

fn sorted<M: Module>(module: &M) -> BTreeMap<String, Vec<usize>> {
    layout(module).into_iter().map(|entry| (entry.name, entry.shape)).collect()
}

/// `name` and its shape, one a line, as the published checkpoints have them for these sizes.
fn listed(text: &str) -> BTreeMap<String, Vec<usize>> {
    let line = |line: &str| {
        let (name, shape) = line.trim().split_once(' ').expect("a name and a shape");
        (name.to_owned(), shape.split('x').map(|n| n.parse().expect("a size")).collect())
    };
    text.lines().filter(|l| !l.trim().is_empty()).map(line).collect()
}

fn attention(path: &str, (h, h3): (usize, usize)) -> String {
    format!(
        "{path}.in_proj_weight {h3}x{h}\n{path}.in_proj_bias {h3}\n{path}.out_proj.weight {h}x{h}\n{path}.out_proj.bias {h}\n"
    )
}

/// A stack of three blocks, 8 wide, feed-forward 12.
fn stack(path: &str, memory: bool) -> String {
    let mut text = format!(
        "{path}.norm.weight 8\n{path}.norm.bias 8\n{path}.linear_blocks.0.weight 8x16\n{path}.linear_blocks.0.bias 8\n"
    );
    for block in ["input_blocks.0", "middle_block", "output_blocks.0"] {
        let block = format!("{path}.{block}");
        text += &attention(&format!("{block}.self_attn"), (8, 24));
        text += &format!(
            "{block}.linear1.weight 12x8\n{block}.linear1.bias 12\n{block}.linear2.weight 8x12\n{block}.linear2.bias 8\n"
        );
        if memory {
            text += &attention(&format!("{block}.multihead_attn"), (8, 24));
        }
        for norm in ["norm1", "norm2", "norm3"].into_iter().take(if memory { 3 } else { 2 }) {
            text += &format!("{block}.{norm}.weight 8\n{block}.{norm}.bias 8\n");
        }
    }
    text
}

#[test]
fn vae_has_the_published_names() {
    let v2 = "
        global_motion_token 4x8
        skel_embedding.weight 8x263
        skel_embedding.bias 8
        query_pos_encoder.pe 500x1x8
        query_pos_decoder.pe 500x1x8
        final_layer.weight 263x8
        final_layer.bias 263
        latent_pre.weight 4x8
        latent_pre.bias 4
        latent_post.weight 8x4
        latent_post.bias 8
    ";
    let mut expected = listed(&format!("{v2}{}{}", stack("encoder", false), stack("decoder", true)));
    assert_eq!(sorted(&with(|init| Vae::new(&small_vae(), init))), expected);
    expected.retain(|name, _| !name.starts_with("latent_"));
    let v1 = VaeConfig { projection: false, latent: LatentShape { tokens: 2, dim: 8 }, ..small_vae() };
    assert_eq!(sorted(&with(|init| Vae::new(&v1, init))), expected);
}

#[test]
fn denoiser_has_the_published_names() {
    let student = "
        latent_pre.weight 8x4
        latent_pre.bias 8
        latent_post.weight 4x8
        latent_post.bias 4
        time_embedding.linear_1.weight 8x10
        time_embedding.linear_1.bias 8
        time_embedding.cond_proj.weight 10x14
        time_embedding.linear_2.weight 8x8
        time_embedding.linear_2.bias 8
        emb_proj.1.weight 8x6
        emb_proj.1.bias 8
        query_pos.pe 500x1x8
    ";
    let mut expected = listed(&format!("{student}{}", stack("encoder", false)));
    assert_eq!(sorted(&with(|init| Denoiser::new(&small_denoiser(Some(14)), init))), expected);
    expected.remove("time_embedding.cond_proj.weight");
    assert_eq!(sorted(&with(|init| Denoiser::new(&small_denoiser(None), init))), expected);
}

fn evaluator_config(features: usize) -> EvaluatorConfig {
    EvaluatorConfig {
        features,
        movement_hidden: 512,
        movement: 512,
        motion_hidden: 1024,
        word: 300,
        classes: 15,
        text_hidden: 512,
        embedding: 512,
    }
}

#[test]
fn networks_have_the_published_numbers_of_parameters() {
    assert_eq!(POSITIONS, 500);
    for (features, movements) in [(259, 1_842_688), (247, 1_818_112)] {
        let evaluator = with(|i| Evaluator::new(&evaluator_config(features), i));
        let found = [&evaluator.movement_encoder.num_params(), &evaluator.motion_encoder.num_params()];
        assert_eq!(found, [&movements, &15_747_584]);
        assert_eq!(evaluator.text_encoder.num_params(), 4_100_288);
    }
    for (found, expected) in [
        (with(|i| Vae::new(&vae_config(false), i)).num_params(), 18_032_135),
        (with(|i| Vae::new(&vae_config(true), i)).num_params(), 18_056_487),
        (with(|i| Vae::new(&VaeConfig { features: 251, ..vae_config(true) }, i)).num_params(), 18_050_331),
        (with(|i| Denoiser::new(&denoiser_config(false, None), i)).num_params(), 8_221_184),
        (with(|i| Denoiser::new(&denoiser_config(false, Some(256)), i)).num_params(), 8_417_792),
        (with(|i| Denoiser::new(&denoiser_config(true, None), i)).num_params(), 8_237_856),
        (with(|i| Denoiser::new(&denoiser_config(true, Some(256)), i)).num_params(), 8_434_464),
        (with(|i| Discriminator::new(9, 256, 0.01, i)).num_params(), 1_195_785),
        (with(|i| Denoiser::controlnet(&denoiser_config(false, Some(256)), 256, false, i)).num_params(), 9_206_784),
        (with(|i| Denoiser::controlnet(&denoiser_config(true, Some(256)), 256, true, i)).num_params(), 9_108_544),
        (with(|i| TrajectoryEncoder::new(&trajectory_config(false), i)).num_params(), 7_779_072),
        (with(|i| TrajectoryEncoder::new(&trajectory_config(true), i)).num_params(), 7_791_136),
        (with(|i| Mdm::new(&mdm_config(263), i)).num_params(), 17_880_327),
        (with(|i| Mdm::new(&mdm_config(251), i)).num_params(), 17_868_027),
    ] {
        assert_eq!(found, expected);
    }
}

#[test]
fn what_is_saved_loads_bit_for_bit() {
    let network = with(|init| Denoiser::new(&small_denoiser(Some(14)), init));
    let bytes = save(&network);
    let blank =
        Denoiser::new(&small_denoiser(Some(14)), &mut Init::new(Seed(8), "x", Positions::Uniform, &Device::flex()));
    assert_ne!(save(&blank), bytes);
    assert_eq!(save(&load(blank, &bytes, "").unwrap()), bytes);
    assert_eq!(SafeTensors::deserialize(&bytes).unwrap().len(), sorted(&network).len());
}

#[test]
fn weights_that_do_not_fit_are_listed_from_both_sides() {
    let teacher = with(|init| Denoiser::new(&small_denoiser(None), init));
    let student = with(|init| Denoiser::new(&small_denoiser(Some(14)), init));
    let LoadError::Mismatch { missing, unused } = load(student, &save(&teacher), "").unwrap_err() else { panic!() };
    assert_eq!((missing, unused), (vec!["time_embedding.cond_proj.weight [10, 14]".to_owned()], vec![]));

    // Another size: the name appears on both sides, with both shapes.
    let mut entries = layout(&teacher);
    entries[0].shape = vec![4, 8];
    let other = to_bytes(&entries, &models::flat::read(&teacher));
    let message = load(teacher, &other, "").unwrap_err().to_string();
    assert!(message.contains("missing: [latent_pre.weight [8, 4]]; unused: [latent_pre.weight [4, 8]]"), "{message}");

    let teacher = with(|init| Denoiser::new(&small_denoiser(None), init));
    assert!(matches!(load(teacher, b"not weights", ""), Err(LoadError::Unreadable(_))));
}

/// The file equals that of the `safetensors` crate, and its large parts are not copied.
#[test]
fn weights_are_written_from_where_they_lie() {
    let network = with(|init| Denoiser::new(&small_denoiser(None), init));
    let (entries, flat) = (layout(&network), flat::read(&network));
    let weights = Weights::new(&entries, &flat);
    let (pieces, place) = (weights.pieces(), flat.as_ptr_range());
    let (start, end) = (place.start.cast::<u8>(), place.end.cast::<u8>());
    assert_eq!(pieces.len(), 1 + entries.len());
    assert!(pieces[1..].iter().all(|piece| start <= piece.as_ptr() && piece.as_ptr() < end));

    let mut at = 0;
    let bytes: Vec<Vec<u8>> = entries
        .iter()
        .map(|entry| {
            at += entry.len();
            flat[at - entry.len()..at].iter().flat_map(|v| v.to_le_bytes()).collect()
        })
        .collect();
    let views = entries
        .iter()
        .zip(&bytes)
        .map(|(entry, bytes)| (entry.name.clone(), TensorView::new(Dtype::F32, entry.shape.clone(), bytes).unwrap()));
    assert_eq!(pieces.concat(), serialize(views, None).unwrap());
}

#[test]
fn weights_are_read_tensor_by_tensor() {
    let network = with(|init| Denoiser::new(&small_denoiser(None), init));
    let bytes = save(&network);
    let blank =
        || Denoiser::new(&small_denoiser(None), &mut Init::new(Seed(8), "x", Positions::Uniform, &Device::flex()));
    let largest = layout(&network).iter().map(|entry| 4 * entry.len()).max().unwrap();
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut read = |offset: u64, out: &mut [u8]| {
        assert!(out.len() <= largest || offset == 8 && out.len() == header - 8, "{} bytes at once", out.len());
        out.copy_from_slice(&bytes[usize::try_from(offset).unwrap()..][..out.len()]);
        Ok::<_, String>(())
    };
    let loaded = load_from(blank(), bytes.len() as u64, &mut read, "").unwrap().unwrap();
    assert_eq!(save(&loaded), bytes);
    let cut = load_from(blank(), bytes.len() as u64 - 4, &mut read, "").unwrap();
    assert!(matches!(cut, Err(LoadError::Unreadable(_))));
    let mut reads = 0;
    let broken = load_from(
        blank(),
        bytes.len() as u64,
        &mut |offset, out| {
            reads += 1;
            if reads > 4 { Err("the line is cut".to_owned()) } else { read(offset, out) }
        },
        "",
    );
    assert_eq!((broken.unwrap_err().as_str(), reads), ("the line is cut", 5));
}

/// The values replace the old ones, which may already be freed.
#[test]
fn parameters_are_assigned_in_place() {
    for device in [Device::flex(), Device::flex().autodiff()] {
        let make =
            |seed| Denoiser::new(&small_denoiser(None), &mut Init::new(Seed(seed), "x", Positions::Uniform, &device));
        let (mut network, other) = (make(1), make(2));
        let values = flat::read(&other);
        flat::assign(&mut network, &values);
        assert_eq!((flat::read(&network), layout(&network)), (values.clone(), layout(&other)));
        let written = flat::write(make(3), &values);
        assert_eq!(format!("{network:?}").len(), format!("{written:?}").len(), "gradients are tracked as before");
    }
}

#[test]
fn a_prefix_chooses_one_of_several_networks() {
    let teacher = with(|init| Denoiser::new(&small_denoiser(None), init));
    let student = with(|init| Denoiser::new(&small_denoiser(Some(14)), init));
    let renamed = |prefix: &str, module: &Denoiser| {
        let mut entries = layout(module);
        entries.iter_mut().for_each(|entry| entry.name = format!("{prefix}{}", entry.name));
        (entries, models::flat::read(module))
    };
    let ((mut entries, mut flat), (more, values)) = (renamed("teacher.", &teacher), renamed("student.", &student));
    entries.extend(more);
    flat.extend(values);
    let both = to_bytes(&entries, &flat);
    let expected = save(&student);
    let blank =
        Denoiser::new(&small_denoiser(Some(14)), &mut Init::new(Seed(8), "x", Positions::Uniform, &Device::flex()));
    assert_eq!(save(&load(blank, &both, "student.").unwrap()), expected);
}
