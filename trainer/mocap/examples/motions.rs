//! Writes a few synthetic motions in each form: `cargo run -p mocap --example motions -- FOLDER`.

#![allow(clippy::print_stdout, reason = "an example talks to its user")]

use std::path::PathBuf;

use mocap::export::{Motion, write_all};
use motion::waypoints::Waypoint;
use motion::{features, synthetic};
use protocol::Seed;
use protocol::stage::DataSynthetic;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("usage: motions FOLDER")?);
    std::fs::create_dir_all(&folder)?;
    let dataset = synthetic::generate(&DataSynthetic { clips: 28, ..DataSynthetic::default() }, Seed(3407));
    let clip = |clip: usize| {
        let entry = dataset.entries.iter().find(|e| e.clip == clip).ok_or("no such clip")?;
        Ok(Motion {
            caption: dataset.captions[entry.captions[0]].text.clone(),
            note: format!("clip {clip}"),
            skeleton: dataset.skeleton(),
            joints: features::recover_joints(&dataset.clips[clip].features, dataset.skeleton()),
            features: None,
            waypoints: Vec::new(),
            kept: Vec::new(),
        })
    };
    let mut motions: Vec<Motion> = [0, 5, 10, 15].into_iter().map(clip).collect::<Result<_, &str>>()?;
    let walk = &mut motions[0];
    let told =
        |frame: usize| Waypoint { frame, joint: 0, position: [0, 1, 2].map(|k| walk.joints[66 * frame + k] + 0.03) };
    walk.waypoints = (0..walk.frames()).step_by(20).map(told).collect();
    for ending in ["bvh", "glb", "gif", "png", "html", "npy"] {
        let written = motions[0].write(&folder.join(format!("walk.{ending}")))?;
        println!("{} {:?}", written.path.display(), written.off_metres);
    }
    motions[2].write(&folder.join("crawl.glb"))?;
    motions[2].write(&folder.join("crawl.bvh"))?;
    motions[2].write(&folder.join("crawl.npy"))?;
    write_all("Four motions", &[("Synthetic clips".to_owned(), motions.iter().collect())], &folder.join("four.html"))?;
    Ok(())
}
