//! Encoding, decoding, joints, the three loss recipes and their gradients (fixtures `01_*`).

use burn::tensor::Device;
use models::flat;
use models::kernels::Dropout;
use models::losses::{self, Body, Pointwise, VaeRecipe};
use motion::skeleton::Skeleton;
use protocol::stage::{DataFormat, VaeLoss};
use serde_json::Value;

use crate::common::{Arrays, Gates, folders, json, name, relative, shared, tracked};
use crate::networks::{check_gradients, gradients, scalar, vae};
use crate::{FORWARD, LOSS};

#[test]
fn parity_vae() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["01_"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        let device = tracked();
        let network = vae(&config["constructor"], &folder.join("weights.safetensors"), &device);
        let format = match config["njoints"].as_u64() {
            Some(22) => DataFormat::Humanml3d,
            Some(21) => DataFormat::Kit,
            other => panic!("{other:?} joints: no format has as many"),
        };
        let (mean, std) = (io.get("stats/mean").f32s(), io.get("stats/std").f32s());
        // The fixtures keep the data's unit, also for KIT-ML.
        let mut body = Body::new(Skeleton::of(format), &mean, &std, &device);
        body.metres_per_unit = 1.0;
        for case in io.cases().into_iter().filter(|case| case != "stats") {
            one(&case, &network, &body, &config, &expected, &io, &device, &mut gates);
        }
        gates.close(&name(&folder));
    }
}

#[expect(clippy::too_many_arguments, reason = "a case needs all of its fixture")]
fn one(
    case: &str,
    network: &models::networks::Vae,
    body: &Body,
    config: &Value,
    expected: &Value,
    io: &Arrays,
    device: &Device,
    gates: &mut Gates,
) {
    let stored = |part: &str| io.get(&format!("{case}/{part}"));
    let what = |part: &str| format!("{case}/{part}");
    let lengths = stored("lengths").usizes();
    let features = stored("features").tensor::<3>(device);
    let [batch, frames, _] = features.dims();
    for (b, length) in lengths.iter().enumerate() {
        let live = &stored("mask").values[b * frames..(b + 1) * frames];
        assert!(live.iter().enumerate().all(|(t, m)| (*m == 1.0) == (t < *length)), "a mask is a length");
    }
    let off = &mut Dropout::off();
    let posterior = network.encode(features.clone(), &lengths, off);
    gates.tensor("latent", what("mu"), posterior.mu_bnd.clone(), stored("mu"), FORWARD);
    gates.tensor("latent", what("logvar"), posterior.logvar_bnd.clone(), stored("logvar"), FORWARD);
    let z = posterior.sample(stored("noise").tensor(device));
    gates.tensor("latent", what("z"), z.clone(), stored("z"), FORWARD);
    let decoded = network.decode(posterior.mu_bnd.clone(), &lengths, frames, off);
    gates.tensor("decoded", what("mu"), decoded, stored("decoded_mu"), FORWARD);
    let decoded = network.decode(z, &lengths, frames, off);
    gates.tensor("decoded", what("z"), decoded.clone(), stored("decoded_z"), FORWARD);
    gates.tensor("joints", what("decoded"), body.joints(decoded.clone()), stored("joints_decoded_z"), FORWARD);
    gates.tensor("joints", what("reference"), body.joints(features.clone()), stored("joints_ref"), FORWARD);

    let entries = flat::layout(network);
    for (kind, settings) in config["loss"].as_object().expect("loss recipes") {
        // Burn consumes the tape in a backward pass: every loss needs a forward pass of its own.
        let posterior = network.encode(features.clone(), &lengths, off);
        let decoded = network.decode(posterior.sample(stored("noise").tensor(device)), &lengths, frames, off);
        let terms = losses::vae(&recipe(settings), body, decoded, features.clone(), &posterior, &lengths);
        let wanted = &expected[what(&format!("loss/{kind}"))];
        let total = terms.total().expect("a recipe has terms") / batch as f32;
        for (part, term) in [
            ("rec_feats_loss", &terms.feature),
            ("rec_joints_loss", &terms.joint),
            ("rec_velocity_loss", &terms.velocity),
            ("kl_loss", &terms.kl),
        ] {
            let found = term.as_ref().map_or(0.0, |t| scalar(t) / batch as f64);
            let stored = wanted[part].as_f64().expect("a loss");
            gates.check("loss", what(&format!("{kind}/{part}")), relative(found, stored), LOSS);
        }
        let stored = wanted["loss"].as_f64().expect("a loss");
        gates.check("loss", what(&format!("{kind}/total")), relative(scalar(&total), stored), LOSS);

        let grads = gradients(network, total);
        if let Some(stored) = expected.get(what(&format!("grad_{kind}"))) {
            check_gradients(gates, &entries, &grads, stored, io, &what(&format!("grad_{kind}")));
        } else {
            let stored = expected[what(&format!("grad_{kind}_global_norm"))].as_f64().expect("a norm");
            let norm = models::optim::global_norm(&grads);
            gates.check("grad norm", what(kind), relative(norm, stored), 1e-4);
        }
    }
}

fn recipe(settings: &Value) -> VaeRecipe {
    let weight = |key: &str| settings[key].as_f64().expect("a weight");
    let distance = |key: &str| match settings[key].as_str() {
        Some("l1_smooth") => Pointwise::SmoothL1,
        Some("l1") => Pointwise::L1,
        Some("l2") => Pointwise::L2,
        other => panic!("distance {other:?} does not exist here"),
    };
    let weights = VaeLoss {
        feature: weight("rf"),
        joint: weight("rj"),
        velocity: weight("rv"),
        kl: weight("kl"),
        masked: settings["mask"].as_bool().expect("a flag"),
        ..VaeLoss::default()
    };
    VaeRecipe { feature: distance("lf"), joint: distance("lj"), velocity: distance("lv"), ..weights.into() }
}
