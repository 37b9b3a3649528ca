//! `init`: the source is found by kind, its weights are copied where they fit, and the rest is logged.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use std::collections::BTreeMap;

use checkpoint::Blobs as _;
use models::names;
use models::networks::{Init, Vae};
use protocol::artifact::FileEntry;
use protocol::stage::{DataFormat, LatentShape, Positions, StageSettings, TrainVae};
use protocol::{ArtifactKind, Digest, Manifest, Seed};
use stage_lab::{Bench, Script};
use stages::artifacts::{MODEL_FILE, VaeMeta};

fn bench(members: usize) -> Bench {
    Bench::new(burn::tensor::Device::flex(), 7, members)
}

fn run_all(bench: &mut Bench, names: &[&str]) -> BTreeMap<&'static str, Digest> {
    let mut outputs = BTreeMap::new();
    for (name, settings, inputs) in common::chain(1, [3; 4]) {
        if names.contains(&name) {
            let inputs: Vec<(&str, Digest)> = inputs.iter().map(|(field, from)| (*field, outputs[from])).collect();
            let ran = bench.run(name, &settings, &inputs).unwrap_or_else(|e| panic!("{name}: {e}"));
            outputs.insert(name, ran.output());
        }
    }
    outputs
}

fn vae_settings() -> TrainVae {
    let settings =
        common::chain(1, [3; 4]).into_iter().find_map(|(name, settings, _)| (name == "vae").then_some(settings));
    match settings {
        Some(StageSettings::TrainVae(settings)) => TrainVae { init: "other".into(), ..settings },
        other => panic!("{other:?}"),
    }
}

/// A VAE of KIT-ML's features, of the sizes of `like`.
fn kit_vae(bench: &Bench, like: &TrainVae) -> Digest {
    let features = 251;
    let meta = VaeMeta {
        format: DataFormat::Kit,
        features,
        latent: like.latent,
        network: like.network.clone(),
        mean: vec![0.0; features],
        std: vec![1.0; features],
        projection: None,
    };
    let device = burn::tensor::Device::flex();
    let network = Vae::new(&meta.config(), &mut Init::new(Seed(3), "kit", Positions::Uniform, &device));
    let bytes = names::save(&network);
    let blobs = bench.blobs();
    let mut manifest = Manifest::new(ArtifactKind::Vae, serde_json::to_value(&meta).unwrap());
    let entry = FileEntry::of_blob(blobs.put_pieces(&[&bytes]).unwrap(), bytes.len() as u64);
    manifest.files.insert(MODEL_FILE.into(), entry);
    blobs.put_pieces(&[&manifest.to_bytes()]).unwrap()
}

#[test]
fn p6_a_vae_of_other_features_is_gone_on_from_and_fresh_where_features_go_in_and_out() {
    let mut bench = bench(1);
    let outputs = run_all(&mut bench, &["dataset", "vae"]);
    let settings = vae_settings();
    let kit = kit_vae(&bench, &settings);
    let inputs = [("dataset", outputs["dataset"]), ("init", kit)];
    bench.forget("vae");
    let ran = bench.run("vae", &settings.clone().into(), &inputs).unwrap();
    assert_ne!(ran.output(), outputs["vae"], "it began elsewhere");
    let said = ran.told.log.join("\n");
    let fresh: Vec<&String> = ran.told.log.iter().filter(|line| line.starts_with("fresh: ")).collect();
    assert!(
        (2..=4).contains(&fresh.len()) && fresh.iter().all(|line| line.contains("263") && line.contains("251")),
        "{said}"
    );
    assert!(
        said.contains("starts with") && said.contains("was trained with another `features`, `format`, `mean`, `std`"),
        "{said}"
    );
    for (members, script) in
        [(2, Script::default()), (3, Script { lost: vec![(0, 1)], joins: vec![(2, 2)], ..Script::default() })]
    {
        bench.forget("vae");
        bench.members = members;
        bench.script = script;
        let again = bench.run("vae", &settings.clone().into(), &inputs).unwrap();
        assert_eq!(again.output(), ran.output(), "{members} members");
    }
}

#[test]
fn what_fits_nothing_and_what_is_of_another_kind_is_refused() {
    let mut bench = bench(1);
    let outputs = run_all(&mut bench, &["dataset", "text", "vae", "latents", "mld"]);
    let settings = vae_settings();
    // The VAE of a model, found by its kind.
    let inputs = |init| vec![("dataset", outputs["dataset"]), ("init", init)];
    bench.forget("vae");
    let of_model = bench.run("vae", &settings.clone().into(), &inputs(outputs["mld"])).unwrap();
    bench.forget("vae");
    let itself = bench.run("vae", &settings.clone().into(), &inputs(outputs["vae"])).unwrap();
    assert_eq!(of_model.output(), itself.output());
    assert!(!itself.told.log.join("\n").contains("fresh: "), "{:?}", itself.told.log);

    let mut network = settings.network.clone();
    (network.width, network.feed_forward) = (24, 48);
    let other = TrainVae { network, latent: LatentShape { tokens: 3, dim: 12 }, ..settings.clone() };
    let mut refused = |settings: TrainVae, init| {
        bench.forget("vae");
        bench.run("vae", &settings.into(), &inputs(init)).unwrap_err().to_string()
    };
    let nothing = refused(other, outputs["vae"]);
    assert!(nothing.contains("`init` does not match this network"), "{nothing}");
    let kind = refused(settings, outputs["latents"]);
    assert!(kind.contains("expected a VAE"), "{kind}");
}

#[test]
fn every_kind_of_the_latent_chain_begins_with_what_it_gave() {
    let mut bench = bench(1);
    let names = ["dataset", "text", "length", "vae", "latents", "mld", "lcm", "pcm", "control"];
    let outputs = run_all(&mut bench, &names);
    let links = common::chain(1, [3; 4]).into_iter().filter(|(name, ..)| names.contains(name)).collect();
    assert_eq!(common::begin_again(&mut bench, links, &outputs), 6);
}
