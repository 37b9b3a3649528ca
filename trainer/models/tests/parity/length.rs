//! Logits, loss, gradients, a few updates and drawn lengths of MoMask's length estimator (fixtures `05_length_estimator*`).

use burn::tensor::{Device, Tensor, TensorData};
use models::flat;
use models::kernels::Dropout;
use models::networks::{Init, LengthEstimator};
use models::optim::{AdamW, clip_factor, global_norm};
use protocol::Seed;
use protocol::stage::Positions;
use serde_json::Value;

use crate::common::{Arrays, Gates, device, folders, json, name, relative, shared, tracked, values};
use crate::networks::{check_gradients, gradients, scalar, split};
use crate::{FORWARD, LOSS};

/// Gate of the norm of a parameter's change in one update.
const CHANGE: f64 = 1e-3;

fn network(config: &Value, folder: &std::path::Path, device: &Device) -> LengthEstimator {
    let size = |key: &str| config[key].as_u64().expect("a size") as usize;
    let mut init = Init::new(Seed(1), "parity", Positions::Uniform, device);
    let fresh = LengthEstimator::new(size("input"), size("output"), &mut init);
    // One fixture stores float16.
    let weights = Arrays::read(&folder.join("weights.safetensors"));
    let entries = flat::layout(&fresh);
    assert_eq!(weights.names().count(), entries.len(), "as many parameters as stored");
    let stored = entries.iter().flat_map(|entry| {
        let array = weights.get(&entry.name);
        assert_eq!(array.shape, entry.shape, "{}", entry.name);
        array.f32s()
    });
    let stored: Vec<f32> = stored.collect();
    flat::write(fresh, &stored)
}

#[test]
fn parity_length_estimator() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["05_length_estimator"]) {
        let config = json(&folder.join("config.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        for case in io.cases() {
            match case.as_str() {
                "sample" => sample(&network(&config, &folder, &device()), &io, &mut gates),
                "eval" | "dropout" => {
                    let expected = json(&folder.join("expected.json"));
                    train(&case, network(&config, &folder, &tracked()), &config, &expected, &io, &mut gates);
                }
                _ => {
                    let network = network(&config, &folder, &device());
                    let text = io.get(&format!("{case}/text")).tensor::<2>(&device());
                    let logits = network.forward(text, &mut Dropout::off());
                    gates.tensor("logits", &*case, logits, io.get(&format!("{case}/logits")), FORWARD);
                }
            }
        }
        gates.close(&name(&folder));
    }
}

/// Checks loss and gradients, then the fixture's updates, each from our previous result.
fn train(case: &str, mut network: LengthEstimator, config: &Value, expected: &Value, io: &Arrays, gates: &mut Gates) {
    let tracked = tracked();
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let number = |value: &Value| value.as_f64().expect("a number");
    let text = stored("text").tensor::<2>(&tracked);
    let classes = config["output"].as_u64().expect("classes") as usize;
    let labels: Vec<usize> =
        stored("frames").usizes().into_iter().map(|frames| LengthEstimator::class(frames, classes)).collect();
    assert_eq!(labels, stored("labels").usizes(), "{case}: classes");
    // Kept values are divided by 0.8; without stored masks nothing is dropped.
    let mask = |k: usize| {
        let array = io.find(&format!("{case}/keep_{k}"))?;
        let scaled = array.values.iter().map(|keep| (keep / 0.8) as f32).collect::<Vec<_>>();
        Some(Tensor::<2>::from_data(TensorData::new(scaled, array.shape.clone()), &tracked))
    };
    let masks = [mask(0), mask(1)];
    let forward = |network: &LengthEstimator| {
        let mut masks = masks.iter();
        network.forward_dropping(text.clone(), |x| match masks.next().expect("two places") {
            Some(mask) => x * mask.clone(),
            None => x,
        })
    };
    let loss_of = |logits| LengthEstimator::loss(logits, &labels) / labels.len() as f32;

    gates.tensor("logits", case, forward(&network), stored("logits"), FORWARD);
    let loss = loss_of(forward(&network));
    gates.check("loss", case, relative(scalar(&loss), number(&expected[format!("{case}/loss")])), LOSS);
    let entries = flat::layout(&network);
    let prefix = format!("{case}/grad");
    check_gradients(gates, &entries, &gradients(&network, loss), &expected[&prefix], io, &prefix);

    let adam = AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.0 };
    let mut weights = flat::read(&network);
    let (mut m, mut v) = (vec![0.0; weights.len()], vec![0.0; weights.len()]);
    for step in 0..config["steps"].as_u64().expect("steps") {
        let expected = &expected[format!("{case}/step_{step}")];
        let what = format!("{case} step {step}");
        let loss = loss_of(forward(&network));
        gates.check("loss", &*what, relative(scalar(&loss), number(&expected["loss"])), LOSS);
        let mut grads = gradients(&network, loss);
        let norm = global_norm(&grads);
        gates.check("norm", &*what, relative(norm, number(&expected["norm_before_clip"])), 1e-4);
        let factor = clip_factor(norm, 0.5);
        grads.iter_mut().for_each(|g| *g *= factor as f32);
        let before = weights.clone();
        adam.step(step + 1, number(&config["lr"]), &mut weights, &grads, &mut m, &mut v);
        let change: Vec<f32> = weights.iter().zip(&before).map(|(a, b)| a - b).collect();
        for (entry, values) in split(&entries, &change) {
            let wanted = number(&expected["change"][&entry.name]);
            gates.check("change", format!("{what} {}", entry.name), relative(global_norm(values), wanted), CHANGE);
        }
        network = flat::write(network, &weights);
    }
    let after = scalar(&loss_of(forward(&network)));
    gates.check(
        "loss",
        format!("{case} after"),
        relative(after, number(&expected[format!("{case}/loss_after")])),
        LOSS,
    );
}

/// Checks draws with the stored exponentials.
fn sample(network: &LengthEstimator, io: &Arrays, gates: &mut Gates) {
    let text = io.get("sample/text").tensor::<2>(&device());
    let logits = network.forward(text, &mut Dropout::off());
    gates.tensor("logits", "sample", logits.clone(), io.get("sample/logits"), FORWARD);
    let (rows, classes) = (logits.dims()[0], logits.dims()[1]);
    let logits = values(logits);
    let draws = &io.get("sample/exponential").values;
    let found: Vec<usize> = draws
        .chunks(classes)
        .enumerate()
        .map(|(i, exponential)| {
            let row = i % rows;
            let mut next = exponential.iter().copied();
            LengthEstimator::draw(&logits[row * classes..(row + 1) * classes], || next.next().expect("one a class"))
        })
        .collect();
    assert_eq!(found, io.get("sample/tokens").usizes(), "drawn lengths");
    let frames: Vec<usize> = found.iter().map(|class| class * LengthEstimator::UNIT).collect();
    assert_eq!(frames, io.get("sample/frames").usizes(), "in frames");
}
