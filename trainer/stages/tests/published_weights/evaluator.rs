//! Import of published evaluators (`04_evaluator*`).

use std::path::Path;

use models::names;
use models::networks::Evaluator;
use motion::{Skeleton, npy};
use protocol::Digest;
use protocol::stage::{DataFormat, ImportEvaluator};
use stages::parts::evaluator::TrainedEvaluator;

use crate::fixtures::{Arrays, Gates, device, name};
use crate::world::{FORWARD, World, blank, format_of, text_of, with_file};

/// An evaluator's file beside statistics that normalise nothing, in the published layout.
fn evaluator(world: &mut World, folder: &Path, format: DataFormat) -> Digest {
    let (path, features) = (world.folder.path().join("evaluator"), Skeleton::of(format).features);
    let (model, meta) = (path.join("text_mot_match/model"), path.join("Comp_v6_KLD01/meta"));
    [&model, &meta].into_iter().for_each(|folder| std::fs::create_dir_all(folder).expect("a test's own files"));
    std::fs::copy(folder.join("finest.tar"), model.join("finest.tar")).expect("a file of the fixture");
    for (name, value) in [("mean.npy", 0.0), ("std.npy", 1.0)] {
        npy::write(&meta.join(name), &[features], &vec![value; features]).expect("a test's own files");
    }
    let settings = ImportEvaluator { path: text_of(&path), format, words: String::new() };
    world.bench.run("evaluator", &settings.into(), &[]).unwrap_or_else(|e| panic!("{e}")).output()
}

#[test]
fn evaluators_give_what_they_were_published_with() {
    for folder in with_file("04_evaluator", "finest.tar") {
        let (mut world, mut gates) = (World::new(), Gates::default());
        let io = Arrays::read(&folder.join("io.safetensors"));
        let width = io.get("full/motions").shape[2];
        let imported = evaluator(&mut world, &folder, format_of(width).expect("a format with these features"));
        let manifest = world.manifest(imported);
        let trained = TrainedEvaluator::read(&*world.bench.blobs(), &manifest, &device()).expect("an evaluator");
        // The network itself is compared: measuring pads motions, as loaders do, where the fixture ends them.
        let device = device();
        let fresh = Evaluator::new(&trained.meta().config, &mut blank(&device));
        let network = names::load(fresh, &trained.weights(), "").expect("its own weights");
        for case in io.cases() {
            let stored = |part: &str| io.get(&format!("{case}/{part}"));
            let motions = network.motion(stored("motions").tensor(&device), &stored("m_lens").usizes());
            gates.tensor("motion", &*case, motions, stored("motion_embedding_input_order"), FORWARD);
            let (words, classes) =
                (stored("word_embs").tensor::<3>(&device), stored("pos_onehot").tensor::<3>(&device));
            let text = network.text_encoder.forward(words, classes, &stored("cap_lens").usizes());
            gates.tensor("text", &*case, text, stored("text_embedding_input_order"), FORWARD);
        }
        gates.close(&name(&folder));
    }
}
