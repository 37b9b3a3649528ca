//! Movements and the two embeddings of ragged batches (fixtures `04_*`).

use models::networks::{Evaluator, EvaluatorConfig, Init};
use models::{kernels::Dropout, names};
use protocol::Seed;
use protocol::stage::Positions;

use crate::FORWARD;
use crate::common::{Array, Arrays, Gates, device, error, folders, json, name, row, shared, values};

#[test]
fn parity_evaluator() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["04_evaluator"]) {
        let config = json(&folder.join("config.json"));
        let size = |net: &str, key: &str| config[net][key].as_u64().expect("a size") as usize;
        let config = EvaluatorConfig {
            features: size("movement_encoder", "input"),
            movement_hidden: size("movement_encoder", "hidden"),
            movement: size("movement_encoder", "output"),
            motion_hidden: size("motion_encoder", "hidden"),
            word: size("text_encoder", "word"),
            classes: size("text_encoder", "pos"),
            text_hidden: size("text_encoder", "hidden"),
            embedding: size("text_encoder", "output"),
        };
        let device = device();
        let fresh = Evaluator::new(&config, &mut Init::new(Seed(1), "parity", Positions::Uniform, &device));
        let bytes = std::fs::read(folder.join("weights.safetensors")).expect("readable weights");
        let network = names::load(fresh, &bytes, "").unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        for case in io.cases() {
            one(&case, &network, &config, &io, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

fn one(case: &str, network: &Evaluator, config: &EvaluatorConfig, io: &Arrays, gates: &mut Gates) {
    let device = network.device();
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let what = |part: &str| format!("{case}/{part}");
    let motions = stored("motions").tensor::<3>(&device);
    let [batch, frames, _] = motions.dims();
    let lengths = stored("m_lens").usizes();

    let inner = motions.clone().slice([0..batch, 0..frames, 0..config.features]);
    let movements = network.movement_encoder.forward(inner, &mut Dropout::off());
    gates.tensor("movements", what("input order"), movements, stored("movements_input_order"), FORWARD);
    let motion = network.motion(motions, &lengths);
    gates.tensor("motion", what("input order"), motion.clone(), stored("motion_embedding_input_order"), FORWARD);
    let words = stored("word_embs").tensor::<3>(&device);
    let classes = stored("pos_onehot").tensor::<3>(&device);
    let text = network.text_encoder.forward(words, classes, &stored("cap_lens").usizes());
    gates.tensor("text", what("input order"), text.clone(), stored("text_embedding_input_order"), FORWARD);

    // The published wrapper sorts motions by length, and captions likewise; distances are in that order.
    let order = stored("align_idx").usizes();
    let sorted = |all: &[f32]| -> Vec<f32> {
        let width = config.embedding;
        order.iter().flat_map(|b| all[b * width..(b + 1) * width].to_vec()).collect()
    };
    let (motion, text) = (sorted(&values(motion)), sorted(&values(text)));
    gates.check("motion", what("sorted"), error(&motion, &stored("motion_embedding_sorted").values), FORWARD);
    gates.check("text", what("sorted"), error(&text, &stored("text_embedding_sorted").values), FORWARD);
    let expected = stored("euclidean_distance_text_motion_sorted");
    let distances: Vec<f32> = text
        .chunks(config.embedding)
        .flat_map(|t| {
            let to = |m: &[f32]| t.iter().zip(m).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt() as f32;
            motion.chunks(config.embedding).map(to).collect::<Vec<_>>()
        })
        .collect();
    gates.check("distance", what("matrix"), error(&distances, &expected.values), FORWARD);

    // A sequence alone has the same embedding as in a batch. It is cut to its length plus the frames that the
    // convolutions read after it.
    for (b, length) in lengths.iter().enumerate() {
        let alone: Array = row(stored("motions"), b);
        let one = alone.tensor::<2>(&device).unsqueeze::<3>();
        let keep = (length / 4 * 4 + 4).min(frames);
        let one = network.motion(one.slice([0..1, 0..keep, 0..config.features + 4]), &[*length]);
        let together = row(stored("motion_embedding_input_order"), b);
        gates.check("alone", what(&format!("motion {b}")), error(&values(one), &together.values), FORWARD);
    }
}
