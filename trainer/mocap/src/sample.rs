//! A folder of synthetic clips as recordings, to try the import of one's own mocap.

use std::fs;
use std::io;
use std::path::Path;

use motion::features::recover_joints;
use motion::synthetic;
use protocol::Seed;
use protocol::stage::DataSynthetic;

use crate::rig::Rig;

/// Writes `clips` synthetic clips as `000000.bvh` (centimetres, 20 fps, joints named as HumanML3D's) with their
/// sentences in `000000.txt`. Returns the largest distance of a joint in a file's motion from the clip's, in metres.
///
/// # Errors
/// The error of the file system, or a clip that is no motion, which is an internal fault.
pub fn write_bvh_folder(folder: &Path, clips: usize, seed: Seed) -> io::Result<f64> {
    fs::create_dir_all(folder)?;
    let dataset = synthetic::generate(&DataSynthetic { clips, val: 0.0, test: 0.0, mirror: false }, seed);
    let skeleton = dataset.skeleton();
    let mut worst = 0.0_f64;
    for entry in &dataset.entries {
        let rig = Rig::fit(&recover_joints(dataset.features(entry), skeleton), skeleton).map_err(io::Error::other)?;
        worst = worst.max(rig.error);
        fs::write(folder.join(format!("{}.bvh", entry.id)), rig.to_bvh(skeleton.fps, 100.0).to_text())?;
        let text: String =
            entry.captions.iter().map(|caption| format!("{}\n", dataset.captions[*caption].text)).collect();
        fs::write(folder.join(format!("{}.txt", entry.id)), text)?;
    }
    Ok(worst)
}
