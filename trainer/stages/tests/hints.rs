//! Target positions and their errors, against MotionLCM's loader and metric (fixtures `02_control*` with draws or
//! sampled motions).

use protocol::stage::ControlSetting;
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use stages::parts::hint::{Hint, NormalisedHints, share, told_frames};

/// Shape and values of a tensor of any type.
fn array(file: &SafeTensors<'_>, name: &str) -> Option<(Vec<usize>, Vec<f64>)> {
    let view = file.tensor(name).ok()?;
    let data = view.data();
    let values = match view.dtype() {
        Dtype::F32 => data.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect(),
        Dtype::I64 => {
            data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().expect("eight bytes")) as f64).collect()
        }
        Dtype::BOOL | Dtype::U8 => data.iter().map(|b| f64::from(*b)).collect(),
        other => panic!("`{name}` has the type {other:?}"),
    };
    Some((view.shape().to_vec(), values))
}

fn f32s(values: &[f64]) -> Vec<f32> {
    values.iter().map(|v| *v as f32).collect()
}

fn usizes(value: &Value) -> Vec<usize> {
    serde_json::from_value(value.clone()).expect("whole numbers")
}

#[test]
fn parity_hints() {
    let (mut draws, mut motions) = (0, 0);
    let folders = fixtures::parity(&["02_control"]);
    for folder in &folders {
        let read = |name: &str| std::fs::read(folder.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        let expected: serde_json::Map<String, Value> = serde_json::from_slice(&read("expected.json")).unwrap();
        let bytes = read("io.safetensors");
        let io = SafeTensors::deserialize(&bytes).unwrap();
        for (key, case) in &expected {
            if key.starts_with("draw/") {
                draw(&io, key, case);
                draws += 1;
            } else if case.get("errors_20cm_50cm_per_sequence").is_some() {
                missed(&io, key, case);
                motions += 1;
            }
        }
    }
    assert!(folders.is_empty() || (draws > 0 && motions > 0), "{draws} draws, {motions} motions");
}

/// Checks one draw of the loader: the number of frames, and the hint of the drawn frames.
fn draw(io: &SafeTensors<'_>, key: &str, case: &Value) {
    let (shape, wanted) = array(io, &format!("{key}/hint")).expect("a hint");
    let (_, mask) = array(io, &format!("{key}/mask")).expect("a mask");
    let (length, count) = (shape[0], case["controlled_frames"].as_u64().expect("a number") as usize);
    let (_, joints) = array(io, "draw/joints").expect("joints");
    let width = shape[1];
    let motion = f32s(&joints[..length * width * 3]);
    let statistics = ["stats/raw_mean", "stats/raw_std"].map(|name| f32s(&array(io, name).expect("statistics").1));
    let percent = case["drawn_density_percent"].as_f64().or_else(|| {
        // At test time 1, 2 and 5 are numbers of frames.
        case["density"].as_f64().filter(|density| ![1.0, 2.0, 5.0].contains(density))
    });
    if let Some(percent) = percent {
        assert_eq!(share(percent, length), count, "{key}");
    }
    let temporal = case["temporal"].as_bool().expect("a flag");
    let frames: Vec<usize> = match array(io, &format!("{key}/drawn_frames_in_draw_order")) {
        Some((_, drawn)) => drawn.iter().map(|t| *t as usize).collect(),
        None => {
            let mut unused = motion::Stream::new(protocol::Seed(0), "unused", 0, 0);
            told_frames(ControlSetting::Temporal, count, length, &mut unused)
        }
    };
    assert_eq!(frames.len(), count, "{key}");
    let all = usizes(&case["joints"]);
    let joints = match case["drawn_joint_position_in_list"].as_u64() {
        Some(position) if !temporal => vec![all[position as usize]],
        _ => all,
    };
    let hint = Hint::of(&motion, width, &joints, &frames);
    assert_eq!(hint.told() as u64, case["controlled_entries"].as_u64().expect("a number"), "{key}");
    let found = NormalisedHints::of(&[hint], &statistics[0], &statistics[1]);
    assert_eq!(found.shape, (1, length, width), "{key}");
    for (i, (found, wanted)) in found.values.iter().zip(&wanted).enumerate() {
        assert!((f64::from(*found) - wanted).abs() < 3e-6 * wanted.abs().max(1.0), "{key}: {i}: {found} {wanted}");
    }
    assert!(found.given.iter().zip(&mask).all(|(found, wanted)| *found == (*wanted != 0.0)), "{key}: the mask");
}

/// Checks the errors of sampled motions against their targets.
fn missed(io: &SafeTensors<'_>, key: &str, case: &Value) {
    let get = |name: &str| array(io, &format!("{key}/{name}")).expect("stored");
    let (shape, joints) = get("joints");
    let (_, told) = get("hint_metres");
    let (_, mask) = get("hint_mask");
    let lengths = get("lengths").1;
    let [_, frames, count, _] = shape[..] else { panic!("{key}: joints have four axes") };
    let rows = case["errors_20cm_50cm_per_sequence"].as_array().expect("rows");
    for (b, row) in rows.iter().enumerate() {
        let length = lengths[b] as usize;
        let from = b * frames * count * 3;
        let mut hint = Hint::none(length, count);
        for at in 0..length * count {
            let i = from + 3 * at;
            if mask[i] != 0.0 {
                hint.tell(at / count, at % count, [told[i] as f32, told[i + 1] as f32, told[i + 2] as f32]);
            }
        }
        let motion = f32s(&joints[from..from + length * count * 3]);
        let wanted: Vec<f64> = serde_json::from_value(row.clone()).expect("numbers");
        // Trajectories and positions that miss by 20 and by 50 cm, in pairs, and the mean.
        for (k, threshold) in [(0, 0.2), (1, 0.5)] {
            let found = hint.errors(&motion, threshold).expect("something is told");
            let off = |found: f64, wanted: f64| (found - wanted).abs() < 1e-5;
            assert!(off(found.trajectory, wanted[k]), "{key} {b}: {found:?} {wanted:?}");
            assert!(off(found.location, wanted[2 + k]), "{key} {b}: {found:?} {wanted:?}");
            assert!(off(found.average, wanted[4]), "{key} {b}: {found:?} {wanted:?}");
        }
    }
}
