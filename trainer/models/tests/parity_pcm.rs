//! Phased consistency's tables and coefficients against the image repository's arithmetic (fixtures `08_pcm*`).

mod common;

use burn::tensor::{Device, Tensor};
use common::{Arrays, Gates, folders, json, name, relative, shared};
use models::diffusion::{Grid, Phases, Schedule, affine, guided_by, unzip};
use models::losses;

const GATE: f64 = 3e-6;

#[test]
fn parity_pcm() {
    let Some(root) = shared("parity") else { return };
    for folder in folders(&root, &["08_pcm"]) {
        let config = json(&folder.join("config.json"));
        let expected = json(&folder.join("expected.json"));
        let io = Arrays::read(&folder.join("io.safetensors"));
        let mut gates = Gates::default();
        let steps = config["grid"].as_u64().expect("grid points") as usize;
        let grid = Grid::new(1000 / steps);
        for m in config["phases"].as_array().expect("phase counts") {
            phases(&grid, m.as_u64().expect("a count") as usize, &io, &expected, &mut gates);
        }
        hinge(&io, &expected, &mut gates);
        gates.close(&name(&folder));
    }
}

fn phases(grid: &Grid, count: usize, io: &Arrays, expected: &serde_json::Value, gates: &mut Gates) {
    let (device, schedule, phases) = (common::device(), Schedule::published(), Phases::new(grid, count));
    let stored = |part: &str| io.get(&format!("M{count}/{part}"));
    let load = |part: &str| stored(part).tensor::<3>(&device);
    let what = |part: &str| format!("M{count}/{part}");

    assert_eq!(phases.edges, stored("edge_grid_index").usizes());
    let times: Vec<usize> = (0..count).map(|m| phases.edge_time(m)).collect();
    assert_eq!(times, stored("edge_timestep").usizes());
    // The image repository blends with factors that always select either the point or the network.
    for i in 0..grid.steps {
        assert_eq!(stored("c_skip_online").values[i], 0.0, "the online network is never at an edge");
        assert_eq!(stored("c_out_online").values[i], 1.0);
        assert_eq!(stored("c_skip_target").values[i] == 1.0, phases.is_edge(i), "edge at grid index {i}");
        assert_eq!(stored("c_out_target").values[i] == 0.0, phases.is_edge(i), "edge at grid index {i}");
    }

    let index = stored("grid_index").usizes();
    let start: Vec<usize> = index.iter().map(|i| grid.tau(*i)).collect();
    let prev: Vec<usize> = index.iter().map(|i| grid.prev(*i)).collect();
    let end: Vec<usize> = index.iter().map(|i| phases.edge_time(phases.phase_of(*i))).collect();
    let adversarial = stored("adv_timestep").usizes();
    assert_eq!(start, stored("start_timestep").usizes());
    assert_eq!(prev, stored("prev_timestep").usizes());
    assert_eq!(end, stored("end_timestep").usizes());

    let jumps = |from: &[usize], to: &[usize]| unzip(from.iter().zip(to).map(|(t, s)| schedule.jump(*t, *s)));
    let (a, e) = unzip(start.iter().map(|t| schedule.add_noise(*t)));
    let z_t = affine(load("z0"), load("noise"), &a, &e);
    gates.tensor("noised", what("z_t"), z_t.clone(), stored("z_t"), GATE);
    let (a, e) = unzip(start.iter().map(|t| schedule.clean(*t)));
    let x0 = affine(z_t.clone(), load("student_eps"), &a, &e);
    gates.tensor("x0", what("student_x0"), x0, stored("student_x0"), GATE);
    let (a, e) = jumps(&start, &end);
    let prediction = affine(z_t.clone(), load("student_eps"), &a, &e);
    gates.tensor("jump", what("prediction"), prediction.clone(), stored("phased_prediction_f64"), GATE);

    let guided = guided_by(load("teacher_cond_eps"), load("teacher_uncond_eps"), &stored("w").f32s());
    let (a, e) = jumps(&start, &prev);
    let z_prev = affine(z_t, guided, &a, &e);
    gates.tensor("solver", what("z_prev"), z_prev.clone(), stored("z_prev_f64"), GATE);
    // At an edge prev is already the end, and the jump is the identity.
    let (a, e) = jumps(&prev, &end);
    let target = affine(z_prev, load("target_eps"), &a, &e);
    gates.tensor("target", what("target"), target.clone(), stored("target_f64"), GATE);

    let (a, e) = unzip(end.iter().zip(&adversarial).map(|(m, s)| schedule.transition(*m, *s)));
    let fake = affine(prediction.clone(), load("adv_noise_fake"), &a, &e);
    gates.tensor("transition", what("fake"), fake, stored("fake_adv"), GATE);
    let real = affine(target.clone(), load("adv_noise_real"), &a, &e);
    gates.tensor("transition", what("real from target"), real, stored("real_adv_from_target"), GATE);
    let (a, e) = unzip(adversarial.iter().map(|s| schedule.add_noise(*s)));
    let real = affine(load("z0"), load("adv_noise_real"), &a, &e);
    gates.tensor("noised", what("real from z0"), real, stored("real_adv_from_z0"), GATE);

    let loss = losses::pseudo_huber(prediction, target, 0.5);
    let wanted = expected[format!("M{count}/huber_c0.5")].as_f64().expect("a stored loss");
    gates.check("huber", what("loss"), relative(scalar(loss) / index.len() as f64, wanted), 1e-5);
}

fn hinge(io: &Arrays, expected: &serde_json::Value, gates: &mut Gates) {
    let device = common::device();
    let heads = |side: &str| -> Vec<Tensor<3>> {
        let prefix = format!("hinge/{side}");
        let names: Vec<&str> = io.names().filter(|n| n.starts_with(&prefix)).collect();
        assert!(!names.is_empty(), "no stored scores `{prefix}*`");
        names.iter().map(|n| scores(io.get(n), &device)).collect()
    };
    let (fake, real) = (heads("fake"), heads("real"));
    let batch = fake[0].dims()[0] as f64;
    let d = scalar(losses::hinge_discriminator(real, fake.clone())) / batch;
    let g = scalar(losses::hinge_generator(fake)) / batch;
    gates.check("hinge", "d", relative(d, expected["hinge/d_loss"].as_f64().expect("a loss")), 1e-5);
    gates.check("hinge", "g", relative(g, expected["hinge/g_loss"].as_f64().expect("a loss")), 1e-5);
}

/// Converts scores [B, ...] to [B, N, 1].
fn scores(array: &common::Array, device: &Device) -> Tensor<3> {
    let flat = common::Array { shape: vec![array.shape[0], array.values.len() / array.shape[0], 1], ..array.clone() };
    flat.tensor(device)
}

fn scalar(tensor: Tensor<1>) -> f64 {
    f64::from(common::values(tensor)[0])
}
