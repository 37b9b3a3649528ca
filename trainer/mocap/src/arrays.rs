//! Joints in arrays: `.npy` as in HumanML3D's `joints` and `new_joints`, `.npz` as written by tools around AMASS.
//!
//! An array is `[T, J, 3]` or `[T, 3 J]`. J is 21 (KIT-ML), or at least 22; then the first 22 are used, because SMPL,
//! SMPL-H and SMPL-X have the same first joints. An `.npz` holds one of [`KEYS`] and may state its rate in one of
//! [`RATES`]. AMASS's own files hold body parameters instead of joints; converting those needs AMASS's body model.
//!
//! Limits apply before memory is allocated: a file has at most [`limits::CLIP_BYTES`], and no more than that is
//! unpacked from a member.

use std::io::{Cursor, Read as _};
use std::path::Path;

use motion::DataPath;
use motion::npy::{self, Array};
use protocol::{excerpt, excerpts, limits};

/// Names of joint arrays in an `.npz`, in order of preference.
pub const KEYS: [&str; 7] = ["joints", "Jtr", "joints3d", "positions", "new_joints", "keypoints3d", "arr_0"];
/// Names of the frame rate in an `.npz`.
pub const RATES: [&str; 4] = ["mocap_framerate", "mocap_frame_rate", "framerate", "fps"];
/// Largest number of members of an archive.
const MEMBERS: usize = 1_000;

/// Joints as stored in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Joints {
    /// Positions of shape `[T, joints, 3]`.
    pub data: Vec<f32>,
    /// Number of joints, 21 or 22.
    pub joints: usize,
    /// Frames per second, if the file states them.
    pub rate: Option<f64>,
}

/// Reads a `.npy` or `.npz` of joints.
///
/// # Errors
/// A message that names the file.
pub fn read(file: &DataPath) -> Result<Joints, String> {
    let bytes = file.read(limits::CLIP_BYTES).map_err(|e| format!("{}: {e}", file.display()))?;
    parse(file.shown(), &bytes)
}

/// Reads joints from a file's bytes; `file` is only its name in errors.
///
/// # Errors
/// As [`read`].
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Joints, String> {
    let shown = file.display();
    if !bytes.starts_with(b"PK") {
        return joints(file, npy::parse(file, bytes, true).map_err(|e| e.to_string())?, None);
    }
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes))
        .map_err(|e| format!("{shown}: not a .npz archive: {}", excerpt(&e.to_string())))?;
    if archive.len() > MEMBERS {
        return Err(format!("{shown}: has {} arrays; expected at most {MEMBERS}", archive.len()));
    }
    let names: Vec<String> =
        archive.file_names().flatten().filter_map(|name| name.strip_suffix(".npy").map(str::to_owned)).collect();
    let has = |name: &&&str| names.iter().any(|n| n == **name);
    let Some(key) = KEYS.iter().find(has) else {
        let hint = if ["poses", "trans"].iter().all(|name| has(&name)) {
            "; these are body parameters; compute the joints with the body model and save them as `joints`"
        } else {
            ""
        };
        return Err(format!(
            "{shown}: has {}; expected joints [T, J, 3] as one of {}{hint}",
            excerpts(names.iter().map(String::as_str), 20),
            KEYS.join(", ")
        ));
    };
    let rate = RATES.iter().find(has).map(|key| rate(file, &member(file, &mut archive, key)?)).transpose()?;
    let array =
        npy::parse(file, &member(file, &mut archive, key)?, true).map_err(|e| format!("{e} (array `{key}`)"))?;
    joints(file, array, rate)
}

/// Unpacks a member's bytes.
fn member(file: &Path, archive: &mut zip::ZipArchive<Cursor<&[u8]>>, key: &str) -> Result<Vec<u8>, String> {
    let fail = |what: String| format!("{}: array `{key}`: {what}", file.display());
    let unpack = |e: &dyn std::fmt::Display| fail(format!("cannot be unpacked: {}", excerpt(&e.to_string())));
    let member = archive.by_name(&format!("{key}.npy")).map_err(|e| unpack(&e))?;
    let mut bytes = vec![];
    member.take(limits::CLIP_BYTES + 1).read_to_end(&mut bytes).map_err(|e| unpack(&e))?;
    if bytes.len() as u64 > limits::CLIP_BYTES {
        return Err(fail(format!("unpacks to more than {} bytes, the largest supported size", limits::CLIP_BYTES)));
    }
    Ok(bytes)
}

/// Reads a single number, a float or an integer of 32 or 64 bits.
fn rate(file: &Path, bytes: &[u8]) -> Result<f64, String> {
    let whole = |descr: &[u8]| bytes.windows(descr.len()).take(limits::ARRAY_HEADER_BYTES).any(|part| part == descr);
    let value = if whole(b"'<i8'") {
        bytes.last_chunk::<8>().map(|bytes| i64::from_le_bytes(*bytes) as f64)
    } else if whole(b"'<i4'") {
        bytes.last_chunk::<4>().map(|bytes| f64::from(i32::from_le_bytes(*bytes)))
    } else {
        let array = npy::parse(file, bytes, true).map_err(|e| format!("{e} (the frame rate)"))?;
        array.data.first().filter(|_| array.data.len() == 1).map(|value| f64::from(*value))
    };
    value
        .filter(|rate| (1.0..=10_000.0).contains(rate))
        .ok_or_else(|| format!("{}: the frame rate is not a number from 1 to 10000", file.display()))
}

fn joints(file: &Path, array: Array, rate: Option<f64>) -> Result<Joints, String> {
    let found = match array.shape[..] {
        [_, joints, 3] => joints,
        [_, width] if width.is_multiple_of(3) => width / 3,
        _ => 0,
    };
    if found < 21 || array.data.is_empty() {
        let shown = file.display();
        return Err(format!(
            "{shown}: has shape {:?}; expected [frames, joints, 3] with 21 (KIT-ML) or at least 22 joints",
            array.shape
        ));
    }
    if let Some(at) = array.data.iter().position(|v| !v.is_finite()) {
        let frame = at / (3 * found);
        let joint = at % (3 * found) / 3;
        return Err(format!("{}: joint {joint} of frame {frame} is not finite", file.display()));
    }
    let joints = found.min(22);
    let data = if joints == found {
        array.data
    } else {
        array.data.chunks_exact(3 * found).flat_map(|frame| frame[..3 * joints].iter().copied()).collect()
    };
    Ok(Joints { data, joints, rate })
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn archive(members: &[(&str, Vec<u8>)]) -> Vec<u8> {
        let mut archive = zip::ZipWriter::new(Cursor::new(vec![]));
        let packed = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        for (name, bytes) in members {
            archive.start_file(format!("{name}.npy"), packed).unwrap();
            archive.write_all(bytes).unwrap();
        }
        archive.finish().unwrap().into_inner()
    }

    fn number(descr: &str, bytes: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': (), }}\n");
        [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), bytes].concat()
    }

    fn read_bytes(bytes: &[u8]) -> Result<Joints, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("take.npz");
        std::fs::write(&file, bytes).unwrap();
        read(&DataPath::local(file))
    }

    #[test]
    fn joints_are_found_and_what_are_none_is_said() {
        let data: Vec<f32> = (0..2 * 24 * 3).map(|v| v as f32).collect();
        let wide = npy::to_bytes(&[2, 24, 3], &data);
        let rates = [
            number("<f8", &120_f64.to_le_bytes()),
            number("<i8", &120_i64.to_le_bytes()),
            number("<i4", &120_i32.to_le_bytes()),
        ];
        for rate in rates {
            let joints = read_bytes(&archive(&[("mocap_framerate", rate), ("Jtr", wide.clone())])).unwrap();
            assert_eq!((joints.joints, joints.rate, joints.data.len()), (22, Some(120.0), 132));
            assert_eq!((joints.data[65], joints.data[66]), (65.0, 72.0));
        }
        let kit = npy::to_bytes(&[2, 63], &data[..126]);
        assert_eq!(read_bytes(&kit).unwrap(), Joints { data: data[..126].to_vec(), joints: 21, rate: None });
        protocol::show_excerpts();
        let said = |members: &[(&str, Vec<u8>)]| read_bytes(&archive(members)).unwrap_err();
        assert!(said(&[("poses", kit.clone()), ("trans", kit.clone())]).contains("body parameters"));
        assert!(said(&[("x", kit.clone())]).contains("has x; expected joints"));
        assert!(said(&[("joints", kit.clone()), ("fps", number("<f8", &0_f64.to_le_bytes()))]).contains("frame rate"));
        assert!(said(&[("joints", npy::to_bytes(&[4, 5, 3], &data[..60]))]).contains("[4, 5, 3]"));
        assert!(said(&[("joints", npy::to_bytes(&[1, 22, 3], &[f32::NAN; 66]))]).contains("joint 0 of frame 0"));
        let good = archive(&[("joints", kit)]);
        assert!(read_bytes(&good[..good.len() / 2]).unwrap_err().contains("not a .npz archive"));
    }

    #[test]
    fn a_bomb_is_not_unpacked() {
        // 80 MB of zeros are 80 kB in the archive.
        let bomb = archive(&[("joints", vec![0; 80 << 20])]);
        assert!(bomb.len() < 1 << 20);
        assert!(read_bytes(&bomb).unwrap_err().contains("unpacks to more than"));
    }
}
