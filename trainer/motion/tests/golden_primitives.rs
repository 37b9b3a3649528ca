//! Checks `golden/primitives`: quaternion operations and the heading filter.

mod shared;

use std::path::Path;

use motion::features::gaussian_filter;
use motion::quaternion as quat;
use safetensors::tensor::{Dtype, SafeTensors};
use shared::worst;

struct Tensors<'a>(SafeTensors<'a>);

impl Tensors<'_> {
    fn values(&self, name: &str) -> Vec<f64> {
        let view = self.0.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
        match view.dtype() {
            Dtype::F32 => view
                .data()
                .chunks(4)
                .map(|b| f64::from(f32::from_le_bytes(b.try_into().expect("whole numbers"))))
                .collect(),
            Dtype::F64 => {
                view.data().chunks(8).map(|b| f64::from_le_bytes(b.try_into().expect("whole numbers"))).collect()
            }
            other => panic!("{name}: {other:?}"),
        }
    }

    fn rows<const N: usize>(&self, name: &str) -> Vec<[f64; N]> {
        self.values(name).chunks(N).map(|row| row.try_into().expect("whole rows")).collect()
    }
}

#[test]
fn golden_primitives() {
    for folder in fixtures::golden("primitives") {
        check_primitives(&folder);
    }
}

#[expect(clippy::print_stdout, reason = "part of a test")]
fn check_primitives(folder: &Path) {
    let bytes = std::fs::read(folder.join("quaternions.safetensors")).expect("readable tensors");
    let given = Tensors(SafeTensors::deserialize(&bytes).expect("readable tensors"));
    let (q, p, v, w) = (given.rows::<4>("q"), given.rows::<4>("p"), given.rows::<3>("v"), given.rows::<3>("w"));
    let flat = |m: [[f64; 3]; 3]| m.as_flattened().to_vec();
    let raw = given.rows::<6>("cont6d_raw");
    let mut found: Vec<(String, Vec<f64>)> = vec![
        ("qmul_q_p".into(), q.iter().zip(&p).flat_map(|(q, p)| quat::mul(*q, *p)).collect()),
        ("qinv_q".into(), q.iter().flat_map(|q| quat::inverse(*q)).collect()),
        ("qrot_q_v".into(), q.iter().zip(&v).flat_map(|(q, v)| quat::rotate(*q, *v)).collect()),
        ("qbetween_v_w".into(), v.iter().zip(&w).flat_map(|(v, w)| quat::between(*v, *w)).collect()),
        ("cont6d_q".into(), q.iter().flat_map(|q| quat::to_6d(*q)).collect()),
        ("matrix_q".into(), q.iter().flat_map(|q| flat(quat::to_matrix(*q))).collect()),
        ("matrix_from_cont6d_raw".into(), raw.iter().flat_map(|c| flat(quat::matrix_from_6d(*c))).collect()),
    ];
    for name in given.0.names() {
        if let Some(frames) = name.strip_prefix("gauss20_in_") {
            let out = gaussian_filter(&given.rows::<3>(name), 20.0);
            found.push((format!("gauss20_out_{frames}"), out.into_iter().flatten().collect()));
        }
    }
    // No feature needs a track of quaternions with continuous signs.
    let unused = ["qfix_in", "qfix_out"];
    let inputs = ["q", "p", "v", "w", "cont6d_raw"];
    for name in given.0.names() {
        let known = inputs.contains(&name)
            || unused.contains(&name)
            || name.starts_with("gauss20_in_")
            || found.iter().any(|(n, _)| n == name);
        assert!(known, "tensor `{name}` is not read by this test");
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    for (name, values) in found {
        let error = worst(values, given.values(&name));
        let tolerance = if name.starts_with("gauss") { 1e-10 } else { 1e-5 };
        println!("{name}: {error:.1e} (tolerance {tolerance:.0e})");
        assert!(error < tolerance, "{name}: {error:.2e}");
    }
}
