//! Draws one clip of every synthetic movement: `cargo run -p motion --release --example contact_sheet -- FOLDER`.

use std::path::PathBuf;

use motion::{draw, features, synthetic};
use protocol::Seed;
use protocol::stage::DataSynthetic;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("usage: contact_sheet FOLDER")?);
    let first = std::env::args().nth(2).map_or(Ok(0), |n| n.parse::<usize>())?;
    std::fs::create_dir_all(&folder)?;
    let start = std::time::Instant::now();
    let settings = DataSynthetic { clips: 28 * (first + 1), ..DataSynthetic::default() };
    let dataset = synthetic::generate(&settings, Seed(3407));
    eprintln!("{} clips in {:.2} s", dataset.clips.len(), start.elapsed().as_secs_f64());
    let skeleton = dataset.skeleton();
    let motions: Vec<(String, Vec<f32>)> = (28 * first..28 * (first + 1))
        .map(|i| {
            let entry = dataset.entries.iter().find(|e| e.clip == i).ok_or("no such clip")?;
            let text = dataset.captions[entry.captions[0]].text.clone();
            let joints = features::recover_joints(&dataset.clips[i].features, skeleton);
            Ok((format!("{} {text}", entry.id), joints))
        })
        .collect::<Result<_, &str>>()?;
    for (i, part) in motions.chunks(7).enumerate() {
        let row = |(title, joints): &(String, Vec<f32>)| draw::Row {
            title: title.clone(),
            note: String::new(),
            joints: joints.clone(),
        };
        let rows: Vec<draw::Row> = part.iter().map(row).collect();
        draw::sheet(&rows, 10, skeleton, draw::Given::default(), &folder.join(format!("sheet-{first}-{i}.png")))?;
    }
    for (name, joints) in motions.iter().take(4) {
        draw::gif(joints, skeleton, name, &folder.join(format!("{}.gif", &name[..6])))?;
    }
    Ok(())
}
