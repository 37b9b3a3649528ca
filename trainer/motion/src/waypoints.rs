//! Paths that a user draws for a motion: target positions of joints at given times.
//!
//! Positions are metres in the frame of HumanML3D's clips: y is up, the motion starts with its root at x = z = 0 and
//! faces z. Times are seconds from its first frame; a waypoint applies to the frame nearest to its time. There are
//! three kinds of file:
//!
//! - `.csv`: a header and one line per waypoint, with the columns `t,x,y,z`, or `t,joint,x,y,z` for more than one
//!   joint, in any order;
//! - `.json`: a list of `[t, x, y, z]`, or an object of such lists by joint;
//! - `.npy`: a motion `[frames, joints, 3]`, or features `[frames, D]`, whose joints are targets in every frame.
//!
//! Not its job: the steering of a model by them.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::{excerpt, limits};
use serde_json::Value;

use crate::features::recover_joints;
use crate::{DataPath, Skeleton, npy};

/// Largest size of a file of waypoints, in bytes.
const PATH_BYTES: u64 = 4 << 20;
/// Upper limit of times, in seconds.
const LONGEST: f64 = 3600.0;
/// Upper limit of a body's speed, in metres per second.
pub const FASTEST: f64 = 10.0;

/// Target position of a joint at a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Waypoint {
    /// Index of the frame.
    pub frame: usize,
    /// Index of the joint.
    pub joint: usize,
    /// Position in metres.
    pub position: [f32; 3],
}

/// One line of a file: its name in errors, its time, its joint if it has one, and its position.
#[derive(Debug, Clone, PartialEq)]
struct Line {
    place: String,
    seconds: f64,
    joint: Option<String>,
    position: [f64; 3],
}

/// Reads the waypoints of a file, ordered by joint and then by time.
///
/// `joints` selects the joints of a file that names joints, or of a motion. A file without joint names needs exactly
/// one. An empty list selects all joints that the file names, or the root.
///
/// # Errors
/// The defect, with its line or place and the expected content.
pub fn read(file: &Path, skeleton: &Skeleton, joints: &[String]) -> Result<Vec<Waypoint>, String> {
    let limit = if ending(file) == "npy" { limits::ARRAY_BYTES } else { PATH_BYTES };
    let bytes = if ["csv", "json", "npy"].contains(&ending(file).as_str()) {
        DataPath::local(file).read(limit).map_err(|error| format!("`{}`: {error}", file.display()))?
    } else {
        Vec::new()
    };
    parse(file, &bytes, skeleton, joints)
}

/// Reads waypoints from a file's bytes, like [`read`]; the extension of the file's name decides the kind.
///
/// # Errors
/// As [`read`].
pub fn parse(file: &Path, bytes: &[u8], skeleton: &Skeleton, joints: &[String]) -> Result<Vec<Waypoint>, String> {
    let told: Vec<usize> = joints.iter().map(|name| number(name, skeleton)).collect::<Result<_, _>>()?;
    let named = |error: String| format!("`{}`: {error}", file.display());
    let ending = ending(file);
    if ending == "npy" {
        return motion(file, bytes, skeleton, if told.is_empty() { &[0] } else { &told });
    }
    if ending != "csv" && ending != "json" {
        return Err(named("expected a file name that ends in .csv, .json or .npy".into()));
    }
    let text = std::str::from_utf8(bytes).map_err(|_| named("is not UTF-8 text".into()))?;
    let lines = if ending == "csv" { csv(text) } else { json(text) }.map_err(named)?;
    waypoints(&lines, skeleton, &told).map_err(named)
}

/// Reads waypoints from a JSON value with the content of a `.json` file; `joints` as for [`read`].
///
/// # Errors
/// The defect, with its place and the expected content.
pub fn of_json(value: &Value, skeleton: &Skeleton, joints: &[String]) -> Result<Vec<Waypoint>, String> {
    let told: Vec<usize> = joints.iter().map(|name| number(name, skeleton)).collect::<Result<_, _>>()?;
    waypoints(&of_value(value)?, skeleton, &told)
}

/// Refuses a first waypoint of the root that it cannot reach from its start, `start` in metres. The limit is 10 m/s
/// over the time to the waypoint, which counts as one frame at least.
///
/// # Errors
/// The speed that it would need.
pub fn check_start(waypoints: &[Waypoint], skeleton: &Skeleton, start: [f64; 3]) -> Result<(), String> {
    let Some(first) = waypoints.iter().filter(|waypoint| waypoint.joint == 0).min_by_key(|waypoint| waypoint.frame)
    else {
        return Ok(());
    };
    let far = [0, 2].map(|axis| f64::from(first.position[axis]) - start[axis]);
    let far = far[0].hypot(far[1]);
    let speed = far * skeleton.fps / first.frame.max(1) as f64;
    if speed > FASTEST {
        let name = skeleton.names[0];
        let seconds = first.frame as f64 / skeleton.fps;
        return Err(format!(
            "`{name}` starts at x = {:.2}, z = {:.2} and would need {speed:.1} m/s to be {far:.2} m away at \
             {seconds:.2} s; expected at most {FASTEST} m/s",
            start[0], start[2]
        ));
    }
    Ok(())
}

/// Extension of a file's name, in lower case.
fn ending(file: &Path) -> String {
    file.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase()
}

fn number(name: &str, skeleton: &Skeleton) -> Result<usize, String> {
    skeleton.names.iter().position(|known| *known == name).ok_or_else(|| {
        format!(
            "`{}` is not a joint of a skeleton with {} joints; its joints are {}",
            excerpt(name),
            skeleton.joints,
            skeleton.names.join(", ")
        )
    })
}

/// Waypoints from the joints of a motion, in every frame.
fn motion(file: &Path, bytes: &[u8], skeleton: &Skeleton, told: &[usize]) -> Result<Vec<Waypoint>, String> {
    let array = npy::parse(file, bytes, true).map_err(|error| error.to_string())?;
    let joints = skeleton.joints;
    let features = skeleton.features;
    let rows = match array.shape[..] {
        [_, count, 3] if count == joints => array.data,
        [_, width] if width == features => recover_joints(&array.data, skeleton),
        _ => {
            return Err(format!(
                "`{}` has shape {:?}; expected positions [frames, {joints}, 3] or features [frames, {features}]",
                file.display(),
                array.shape
            ));
        }
    };
    let metres = |v: f32| (f64::from(v) * skeleton.metres_per_unit) as f32;
    let mut found = Vec::new();
    for joint in told {
        for (frame, row) in rows.chunks_exact(3 * joints).enumerate() {
            let position = [0, 1, 2].map(|axis| metres(row[3 * joint + axis]));
            if !position.iter().all(|v| v.is_finite()) {
                return Err(format!("`{}`: frame {frame} is not finite", file.display()));
            }
            found.push(Waypoint { frame, joint: *joint, position });
        }
    }
    Ok(found)
}

fn csv(text: &str) -> Result<Vec<Line>, String> {
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let expected = "expected the columns t,x,y,z or t,joint,x,y,z";
    let Some((_, header)) = lines.next() else { return Err(format!("is empty; {expected}")) };
    let columns: Vec<String> = header.split(',').map(|column| column.trim().to_lowercase()).collect();
    let column = |name: &str| columns.iter().position(|column| column == name);
    let (Some(t), Some(x), Some(y), Some(z)) = (column("t"), column("x"), column("y"), column("z")) else {
        return Err(format!("line 1 is `{}`; {expected}", excerpt(header.trim())));
    };
    let joint = column("joint");
    if columns.len() != 4 + usize::from(joint.is_some()) {
        return Err(format!("line 1 is `{}`; {expected}", excerpt(header.trim())));
    }
    lines
        .map(|(i, line)| {
            let place = format!("line {}", i + 1);
            let cells: Vec<&str> = line.split(',').map(str::trim).collect();
            if cells.len() != columns.len() {
                return Err(format!("{place} has {} columns; expected {}", cells.len(), columns.len()));
            }
            let value = |k: usize| {
                let cell = cells[k];
                cell.parse::<f64>()
                    .map_err(|_| format!("{place}: `{}` in column `{}` is not a number", excerpt(cell), columns[k]))
            };
            let seconds = value(t)?;
            let position = [value(x)?, value(y)?, value(z)?];
            Ok(Line { place, seconds, joint: joint.map(|k| cells[k].to_owned()), position })
        })
        .collect()
}

fn json(text: &str) -> Result<Vec<Line>, String> {
    let value: Value = serde_json::from_str(text).map_err(|error| format!("is not valid JSON: {error}"))?;
    of_value(&value)
}

fn of_value(value: &Value) -> Result<Vec<Line>, String> {
    let rows = |list: &Value, joint: Option<&str>, at: &str| -> Result<Vec<Line>, String> {
        let list = list.as_array().ok_or_else(|| format!("{at}: expected a list of [t, x, y, z]"))?;
        let row = |(i, row): (usize, &Value)| {
            let place = format!("{at}[{i}]");
            let numbers: Option<Vec<f64>> = row.as_array().and_then(|r| r.iter().map(Value::as_f64).collect());
            match numbers.as_deref() {
                Some([t, x, y, z]) => {
                    let joint = joint.map(str::to_owned);
                    Ok(Line { place, seconds: *t, joint, position: [*x, *y, *z] })
                }
                _ => Err(format!(
                    "{place} is {}; expected [t, x, y, z] in seconds and metres",
                    excerpt(&row.to_string())
                )),
            }
        };
        list.iter().enumerate().map(row).collect()
    };
    match value {
        Value::Object(joints) => {
            let each = joints.iter().map(|(joint, list)| rows(list, Some(joint), &excerpt(joint)));
            Ok(each.collect::<Result<Vec<_>, _>>()?.concat())
        }
        list => rows(list, None, "path"),
    }
}

fn waypoints(lines: &[Line], skeleton: &Skeleton, told: &[usize]) -> Result<Vec<Waypoint>, String> {
    let one = match told {
        [] => Some(0),
        [joint] => Some(*joint),
        _ => None,
    };
    let mut by_joint: BTreeMap<usize, Vec<(&Line, Waypoint)>> = BTreeMap::new();
    for line in lines {
        let Line { place, seconds, position, .. } = line;
        if !(0.0..=LONGEST).contains(seconds) {
            return Err(format!("{place}: its time is {seconds}; expected 0 to {LONGEST} seconds"));
        }
        if !position.iter().all(|v| v.abs() < 1e4) {
            return Err(format!("{place}: its position is {position:?}; expected metres"));
        }
        let joint = match (&line.joint, one) {
            (Some(name), _) => number(name, skeleton).map_err(|why| format!("{place}: {why}"))?,
            (None, Some(joint)) => joint,
            (None, None) => {
                return Err("has no joint names, but several joints are controlled; add a column `joint`, or use the \
                    names as keys"
                    .into());
            }
        };
        if !told.is_empty() && !told.contains(&joint) {
            continue;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "held against the length by the caller"
        )]
        let frame = (seconds * skeleton.fps).round() as usize;
        let position = position.map(|v| v as f32);
        by_joint.entry(joint).or_default().push((line, Waypoint { frame, joint, position }));
    }
    if by_joint.is_empty() {
        return Err("has no waypoint for the requested joints".into());
    }
    for (joint, own) in &mut by_joint {
        own.sort_by_key(|(_, waypoint)| waypoint.frame);
        for pair in own.windows(2) {
            let [before, after] = pair else { continue };
            check_pair(before, after, skeleton, skeleton.names[*joint])?;
        }
    }
    Ok(by_joint.into_values().flatten().map(|(_, waypoint)| waypoint).collect())
}

/// Refuses two successive waypoints of joint `name` at one frame, or too far apart for the time between them.
fn check_pair(
    (before, first): &(&Line, Waypoint),
    (after, second): &(&Line, Waypoint),
    skeleton: &Skeleton,
    name: &str,
) -> Result<(), String> {
    if first.frame == second.frame {
        return Err(format!(
            "{} and {} are both waypoints of `{name}` at frame {}, {:.2} s; a frame lasts {} s",
            before.place,
            after.place,
            first.frame,
            first.frame as f64 / skeleton.fps,
            1.0 / skeleton.fps
        ));
    }
    let seconds = (second.frame - first.frame) as f64 / skeleton.fps;
    let squares = first.position.iter().zip(second.position).map(|(a, b)| f64::from(a - b).powi(2));
    let speed = squares.sum::<f64>().sqrt() / seconds;
    if speed <= FASTEST {
        return Ok(());
    }
    Err(format!(
        "{}: `{name}` would need {speed:.1} m/s from {}; expected at most {FASTEST} m/s",
        after.place, before.place
    ))
}

#[cfg(test)]
mod tests {
    use protocol::stage::DataFormat;

    use super::*;

    fn body() -> &'static Skeleton {
        Skeleton::of(DataFormat::Humanml3d)
    }

    fn from(name: &str, text: &str, joints: &[&str]) -> Result<Vec<Waypoint>, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(name);
        std::fs::write(&file, text).unwrap();
        let joints: Vec<String> = joints.iter().map(|joint| (*joint).to_owned()).collect();
        read(&file, body(), &joints)
    }

    #[test]
    fn a_table_and_a_document_say_the_same() {
        let table = from(
            "a.csv",
            "t,joint,x,y,z\n0,pelvis,0,0.9,0\n\n1.01, left_wrist ,0.2,1.2,0.5\n0.5,pelvis,0,0.9,1\n",
            &[],
        );
        let table = table.unwrap();
        let places: Vec<(usize, usize)> = table.iter().map(|w| (w.joint, w.frame)).collect();
        assert_eq!(places, [(0, 0), (0, 10), (20, 20)], "by joint, in time, at the nearest frame");
        assert_eq!(table[2].position, [0.2, 1.2, 0.5]);
        let text = r#"{"pelvis": [[0, 0, 0.9, 0], [0.5, 0, 0.9, 1]], "left_wrist": [[1.0, 0.2, 1.2, 0.5]]}"#;
        assert_eq!(from("a.json", text, &[]).unwrap(), table);
        assert_eq!(from("a.json", text, &["left_wrist"]).unwrap(), table[2..]);
        let plain = from("a.csv", "x,y,z,t\n1,2,3,0.1\n", &["head"]).unwrap();
        assert_eq!((plain[0].joint, plain[0].frame, plain[0].position), (15, 2, [1.0, 2.0, 3.0]));
        assert_eq!(from("a.json", "[[0, 0, 1, 0]]", &[]).unwrap()[0].joint, 0);
    }

    #[test]
    fn the_first_waypoint_is_reached_from_where_the_body_stands() {
        protocol::show_excerpts();
        let told = |t: &str| from("a.csv", &format!("t,x,y,z\n{t}\n"), &[]).unwrap();
        let check = |t: &str, start| check_start(&told(t), body(), start);
        assert_eq!(check("0,0,0.9,0.3", [0.0; 3]), Ok(()), "as far as a frame allows");
        assert_eq!(check("1,3,0.9,4", [0.0; 3]), Ok(()));
        let refused = check("0,3,0.9,4", [0.0; 3]).unwrap_err();
        assert!(refused.contains("100.0 m/s") && refused.contains("5.00 m"), "{refused}");
        assert!(check("1,3,0.9,4", [-30.0, 0.0, 0.0]).is_err(), "it stands elsewhere");
        assert_eq!(check_start(&from("a.csv", "t,x,y,z\n0,9,1,9\n", &["head"]).unwrap(), body(), [0.0; 3]), Ok(()));
        let value = serde_json::json!([[0, 0, 0.9, 0], [0.5, 0, 0.9, 1]]);
        assert_eq!(of_json(&value, body(), &[]).unwrap().len(), 2);
        assert!(of_json(&value, body(), &["tail".to_owned()]).unwrap_err().contains("`tail`"));
    }

    #[test]
    fn a_motion_is_told_in_every_frame() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.npy");
        let rows: Vec<f32> = (0..3 * 22 * 3).map(|v| v as f32).collect();
        npy::write(&file, &[3, 22, 3], &rows).unwrap();
        let found = read(&file, body(), &["spine1".to_owned()]).unwrap();
        assert_eq!(found.len(), 3);
        assert_eq!(found[1], Waypoint { frame: 1, joint: 3, position: [75.0, 76.0, 77.0] });
        npy::write(&file, &[3, 21, 3], &rows[..3 * 21 * 3]).unwrap();
        assert!(read(&file, body(), &[]).unwrap_err().contains("[frames, 22, 3]"));
    }

    #[test]
    fn mistakes_are_named_with_their_place() {
        protocol::show_excerpts();
        for (name, text, joints, words) in [
            ("a.csv", "", &[][..], &["is empty"][..]),
            ("a.csv", "t,x,y\n", &[], &["line 1", "t,x,y,z"]),
            ("a.csv", "t,x,y,z\n0,1,2\n", &[], &["line 2", "3 columns"]),
            ("a.csv", "t,x,y,z\n0,1,two,3\n", &[], &["line 2", "`two`", "column `y`"]),
            ("a.csv", "t,x,y,z\n-1,1,2,3\n", &[], &["line 2", "time is -1"]),
            ("a.csv", "t,x,y,z\n1e300,1,2,3\n", &[], &["line 2", "0 to 3600 seconds"]),
            ("a.csv", "t,x,y,z\n0,inf,2,3\n", &[], &["line 2", "metres"]),
            ("a.csv", "t,joint,x,y,z\n0,tail,1,2,3\n", &[], &["line 2", "`tail`", "left_wrist"]),
            ("a.csv", "t,x,y,z\n0,0,1,0\n", &["tail"], &["`tail`", "pelvis"]),
            ("a.csv", "t,x,y,z\n0,0,1,0\n", &["pelvis", "head"], &["column `joint`"]),
            ("a.csv", "t,x,y,z\n0,0,1,0\n0.02,0,1,0\n", &[], &["line 2 and line 3", "frame 0"]),
            ("a.csv", "t,x,y,z\n0,0,1,0\n0.1,0,1,1.2\n", &[], &["line 3", "12.0 m/s", "10 m/s"]),
            ("a.csv", "t,joint,x,y,z\n0,head,0,1,0\n", &["pelvis"], &["has no waypoint"]),
            ("a.json", "{", &[], &["not valid JSON"]),
            ("a.json", r#"{"pelvis": [[0, 1, 2]]}"#, &[], &["pelvis[0]", "[t, x, y, z]"]),
            ("a.json", "3", &[], &["list of [t, x, y, z]"]),
            ("a.txt", "", &[], &[".csv, .json or .npy"]),
        ] {
            let refused = from(name, text, joints).unwrap_err();
            for word in words {
                assert!(refused.contains(word), "{text:?}: {refused}");
            }
        }
        assert!(read(Path::new("/nowhere/a.csv"), body(), &[]).unwrap_err().contains("a.csv"));
    }
}
