//! Joint maps: the nodes of a file that are the 22 joints of HumanML3D.
//!
//! A map is YAML: for each joint a node's name, or a point between nodes for skeletons that lack the joint.
//!
//! ```yaml
//! name: my-studio
//! joints:
//!   left_hip: UpperLeg_L
//!   spine3: {from: Chest, towards: Neck, fraction: 0.25}
//!   pelvis: {between: [UpperLeg_L, UpperLeg_R], towards: Spine, metres: 0.08}
//!   # ... all 22
//! ```
//!
//! A name matches as written, else by its [`key`], which ignores prefixes, case and the spelling of the side.
//! [`SHIPPED`] holds the built-in maps.

mod propose;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use motion::quaternion::{self as quat, Vec3};
use motion::{DataPath, Skeleton};
use pipeline::yaml_as_json;
use protocol::stage::DataFormat;
use protocol::{excerpt, excerpts, json_mistake};
use serde::{Deserialize, Serialize};

use crate::bvh::Bvh;

/// The built-in maps by name.
pub const SHIPPED: [(&str, &str); 6] = [
    ("cmu", include_str!("../maps/cmu.yaml")),
    ("lafan1", include_str!("../maps/lafan1.yaml")),
    ("mixamo", include_str!("../maps/mixamo.yaml")),
    ("bandai", include_str!("../maps/bandai.yaml")),
    ("cmu-daz", include_str!("../maps/cmu-daz.yaml")),
    ("smpl", include_str!("../maps/smpl.yaml")),
];

/// Largest size of a map's file, in bytes.
const MAP_BYTES: u64 = 64 << 10;

/// There is no map, or it does not fit a file.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The file system reported an error.
    #[error("{}: {source}", file.display())]
    Io {
        file: PathBuf,
        /// Error of the file system.
        source: std::io::Error,
    },
    /// The text is not a map.
    #[error("{}:{what}", file.display())]
    Text {
        file: PathBuf,
        /// Place and mistake.
        what: String,
    },
    /// No built-in map has that name.
    #[error("there is no built-in joint map `{name}` (there are {}) and no such file", shipped_names())]
    Unknown { name: String },
    /// The file has no such node, or several.
    #[error("joint map `{map}`: `{joint}` uses the node `{node}`, {problem}")]
    Node {
        map: String,
        joint: String,
        /// Name in the map.
        node: String,
        /// Reason that the file cannot supply it.
        problem: String,
    },
    /// Neither a built-in map nor the shape of the skeleton fits.
    #[error(
        "no built-in joint map matches the names of this skeleton, and its shape is not that of a human figure \
         ({what}); write a joint map and pass its file"
    )]
    None {
        /// Missing property of the shape.
        what: String,
    },
}

fn shipped_names() -> String {
    SHIPPED.map(|(name, _)| name).join(", ")
}

/// Source of a joint's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Source {
    /// Position of a node.
    Node(String),
    /// A point between two nodes.
    Along(Along),
    /// The middle of two nodes, moved towards a third.
    Between(Between),
}

/// A point on the way between two nodes: `{from: Chest, towards: Neck, fraction: 0.25}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Along {
    /// Node at the start of the way.
    pub from: String,
    /// Node at the end of the way.
    pub towards: String,
    /// Share of the way, from 0 (start) to 1 (end).
    pub fraction: f64,
}

/// A moved middle: `{between: [LeftUpLeg, RightUpLeg], towards: Spine, metres: 0.08}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Between {
    /// The two nodes.
    pub between: [String; 2],
    /// Node towards which the middle is moved.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub towards: Option<String>,
    /// Distance of the move.
    #[serde(default)]
    pub metres: f64,
}

/// The sources of the 22 joints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointMap {
    /// Name of the map in messages.
    pub name: String,
    /// Source of each joint of HumanML3D.
    pub joints: BTreeMap<String, Source>,
}

/// A map that was found for a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// The map in the file's own names.
    pub map: JointMap,
    /// The built-in map whose names the file has; `None` if the skeleton's shape decided.
    pub shipped: Option<&'static str>,
}

/// A map resolved to the nodes of a file.
#[derive(Debug, Clone)]
pub struct Places(Vec<Place>);

#[derive(Debug, Clone)]
enum Place {
    Node(usize),
    Along { from: usize, towards: usize, fraction: f64 },
    Between { between: [usize; 2], towards: Option<usize>, metres: f64 },
}

impl JointMap {
    /// A shipped map by its name.
    pub fn shipped(name: &str) -> Option<Self> {
        let (name, text) = SHIPPED.iter().find(|(shipped, _)| *shipped == name)?;
        Self::parse(Path::new(name), text).ok()
    }

    /// The map in a file.
    ///
    /// # Errors
    /// It is not there, or is no map.
    pub fn read(file: &DataPath) -> Result<Self, MapError> {
        match file.read(MAP_BYTES) {
            Ok(bytes) => Self::parse(file.shown(), &String::from_utf8_lossy(&bytes)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                Err(MapError::Unknown { name: file.display().to_string() })
            }
            Err(source) => Err(MapError::Io { file: file.shown().into(), source }),
        }
    }

    /// A shipped map by its name, or a map of a file of the user's own.
    ///
    /// # Errors
    /// If neither exists, or the file is not a map.
    pub fn load(name: &str) -> Result<Self, MapError> {
        Self::shipped(name).map_or_else(|| Self::read(&DataPath::local(name)), Ok)
    }

    /// Parses a map; `file` is only its name in errors.
    ///
    /// # Errors
    /// YAML that is not a map, missing joints, or unknown ones.
    pub fn parse(file: &Path, text: &str) -> Result<Self, MapError> {
        let fail = |what: String| MapError::Text { file: file.into(), what };
        let value = yaml_as_json(text)
            .map_err(|mistakes| fail(format!(" not a joint map: {}", excerpt(&mistakes.join("; ")))))?;
        let map: Self = serde_json::from_value(value).map_err(|e| fail(format!(" {}; expected `name` and `joints`, each a node's name, {{from, towards, fraction}} or {{between, towards, metres}}", json_mistake(&e))))?;
        let names = joint_names();
        let missing: Vec<&str> = names.iter().copied().filter(|name| !map.joints.contains_key(*name)).collect();
        let strange: Vec<&str> = map.joints.keys().map(String::as_str).filter(|name| !names.contains(name)).collect();
        if !missing.is_empty() {
            return Err(fail(format!(" joints are missing: {}", missing.join(", "))));
        }
        if !strange.is_empty() {
            return Err(fail(format!(
                " `{}` are not joints; expected {}",
                excerpt(&strange.join("`, `")),
                names.join(", ")
            )));
        }
        let aimless = |source: &Source| matches!(source, Source::Between(b) if b.towards.is_none() && b.metres != 0.0);
        if let Some((joint, _)) = map.joints.iter().find(|(_, source)| aimless(source)) {
            return Err(fail(format!(" `{joint}` has `metres`, but no `towards`; set `towards` to a node")));
        }
        Ok(map)
    }

    /// Serialises as YAML that [`JointMap::parse`] reads.
    pub fn to_yaml(&self) -> String {
        let quote = |text: &str| serde_json::Value::from(text).to_string();
        let mut text = format!("name: {}\njoints:\n", quote(&self.name));
        for name in joint_names() {
            let Some(source) = self.joints.get(*name) else { continue };
            let source = match source {
                Source::Node(node) => quote(node),
                Source::Along(a) => {
                    format!("{{from: {}, towards: {}, fraction: {}}}", quote(&a.from), quote(&a.towards), a.fraction)
                }
                Source::Between(b) => {
                    let towards = b
                        .towards
                        .as_ref()
                        .map_or(String::new(), |node| format!(", towards: {}, metres: {}", quote(node), b.metres));
                    format!("{{between: [{}, {}]{towards}}}", quote(&b.between[0]), quote(&b.between[1]))
                }
            };
            // Writing to a string cannot fail.
            let _ = writeln!(text, "  {name}: {source}");
        }
        text
    }

    /// The same map with the names of a file.
    fn renamed(&self, bvh: &Bvh) -> Result<Self, MapError> {
        let mut joints = self.joints.clone();
        for (joint, source) in &mut joints {
            for node in source.nodes_mut() {
                *node = bvh.nodes[self.find(bvh, joint, node)?].name.clone();
            }
        }
        Ok(Self { name: self.name.clone(), joints })
    }

    /// Finds the nodes of a file.
    ///
    /// # Errors
    /// A node that is missing from the file, or ambiguous.
    pub fn resolve(&self, bvh: &Bvh) -> Result<Places, MapError> {
        let place = |joint: &&str| {
            let find = |node: &String| self.find(bvh, joint, node);
            Ok(match &self.joints[*joint] {
                Source::Node(node) => Place::Node(find(node)?),
                Source::Along(a) => {
                    Place::Along { from: find(&a.from)?, towards: find(&a.towards)?, fraction: a.fraction }
                }
                Source::Between(b) => Place::Between {
                    between: [find(&b.between[0])?, find(&b.between[1])?],
                    towards: b.towards.as_ref().map(find).transpose()?,
                    metres: b.metres,
                },
            })
        };
        Ok(Places(joint_names().iter().map(place).collect::<Result<_, MapError>>()?))
    }

    fn find(&self, bvh: &Bvh, joint: &str, node: &str) -> Result<usize, MapError> {
        let all = |same: &dyn Fn(&str) -> bool| -> Vec<usize> {
            (0..bvh.nodes.len()).filter(|i| same(&bvh.nodes[*i].name)).collect()
        };
        let fail = |problem: String| MapError::Node {
            map: excerpt(&self.name),
            joint: joint.into(),
            node: excerpt(node),
            problem,
        };
        let mut found = all(&|name| name == node);
        if found.is_empty() {
            found = all(&|name| key(name) == key(node));
        }
        match found[..] {
            [one] => Ok(one),
            [] => {
                let names = bvh.nodes.iter().filter(|n| !n.end).map(|n| n.name.as_str());
                Err(fail(format!("which the file does not have; it has {}", excerpts(names, 60))))
            }
            _ => Err(fail(format!("but the file has {} nodes with that name", found.len()))),
        }
    }
}

impl Source {
    fn nodes_mut(&mut self) -> Vec<&mut String> {
        match self {
            Self::Node(node) => vec![node],
            Self::Along(a) => vec![&mut a.from, &mut a.towards],
            Self::Between(b) => b.between.iter_mut().chain(&mut b.towards).collect(),
        }
    }
}

impl Places {
    /// Computes the 22 joints from a frame of nodes `[nodes, 3]`.
    pub fn joints(&self, frame: &[f64], metres_per_unit: f64) -> Vec<Vec3> {
        let at = |i: usize| [frame[3 * i], frame[3 * i + 1], frame[3 * i + 2]];
        let place = |place: &Place| match place {
            Place::Node(i) => at(*i),
            Place::Along { from, towards, fraction } => {
                quat::add(at(*from), quat::scale(quat::sub(at(*towards), at(*from)), *fraction))
            }
            Place::Between { between, towards, metres } => {
                let middle = quat::scale(quat::add(at(between[0]), at(between[1])), 0.5);
                let way = towards.map(|towards| quat::sub(at(towards), middle)).filter(|way| quat::norm(*way) > 0.0);
                way.map_or(middle, |way| quat::add(middle, quat::scale(quat::unit(way), metres / metres_per_unit)))
            }
        };
        self.0.iter().map(place).collect()
    }
}

/// Names of the joints of a map.
pub fn joint_names() -> &'static [&'static str] {
    Skeleton::of(DataFormat::Humanml3d).names
}

/// Normalises a name, without namespace, case and separators, its side first: `mixamorig:LeftUpLeg`, `left_up_leg` and
/// `UpLeg.L` are equal.
pub fn key(name: &str) -> String {
    let bare = name.rsplit(':').next().unwrap_or(name);
    let mut words: Vec<String> = vec![];
    let chars: Vec<char> = bare.chars().collect();
    for (i, c) in chars.iter().enumerate() {
        if !c.is_alphanumeric() {
            words.push(String::new());
            continue;
        }
        let before = i.checked_sub(1).map(|i| chars[i]);
        let begins = c.is_uppercase()
            && before.is_some_and(|b| {
                b.is_lowercase()
                    || b.is_numeric()
                    || (b.is_uppercase() && chars.get(i + 1).is_some_and(|n| n.is_lowercase()))
            });
        if begins || words.is_empty() {
            words.push(String::new());
        }
        if let Some(word) = words.last_mut() {
            word.extend(c.to_lowercase());
        }
    }
    words.retain(|word| !word.is_empty() && word != "mixamorig");
    let mut side = "";
    for (long, short) in [("left", "l"), ("right", "r")] {
        if let Some(at) = words.iter().position(|word| word == long || word == short) {
            words.remove(at);
            side = short;
        } else if let Some(rest) = words.first().and_then(|word| word.strip_prefix(long)).map(str::to_owned) {
            words[0] = rest;
            side = short;
        }
    }
    format!("{side}.{}", words.concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_one_however_they_are_spelt() {
        for (a, b) in [
            ("mixamorig:LeftUpLeg", "leftUpLeg"),
            ("L_Hip", "left_hip"),
            ("UpperLeg_L", "upperleg.l"),
            ("lThigh", "Thigh_L"),
            ("LHipJoint", "left hip joint"),
            ("leftfoot", "LeftFoot"),
        ] {
            assert_eq!(key(a), key(b));
        }
        for (a, b) in [("LeftArm", "RightArm"), ("Spine", "Spine1"), ("LeftLeg", "LeftUpLeg"), ("Head", "Head_end")] {
            assert_ne!(key(a), key(b));
        }
    }

    #[test]
    fn shipped_maps_are_whole_and_mistakes_in_others_are_told() {
        for (name, text) in SHIPPED {
            let map = JointMap::load(name).unwrap();
            assert_eq!(map.name, name);
            assert_eq!(JointMap::parse(Path::new(name), &map.to_yaml()).unwrap(), map);
            let refuse = |from: &str, to: &str, part: &str| {
                let said = JointMap::parse(Path::new("m.yaml"), &text.replacen(from, to, 1)).unwrap_err().to_string();
                assert!(said.contains(part) && said.starts_with("m.yaml:"), "{said}");
            };
            refuse("  pelvis:", "  pelvic:", "missing: pelvis");
            refuse("joints:\n", "joints:\n  tail: Tail\n", "`tail` are not joints");
            refuse("joints:\n", "joints:\n  pelvis: x\n", "pelvis");
            refuse("name:", "title:", "title");
        }
        let (_, text) = SHIPPED[0];
        let pelvis = text.lines().find(|line| line.trim_start().starts_with("pelvis:")).unwrap();
        let aimless = text.replacen(pelvis, "  pelvis: {between: [a, b], metres: 0.1}", 1);
        let said = JointMap::parse(Path::new("m.yaml"), &aimless).unwrap_err().to_string();
        assert!(said.contains("`pelvis` has `metres`, but no `towards`"), "{said}");
        assert!(JointMap::load("nowhere.yaml").unwrap_err().to_string().contains("cmu, lafan1"));
    }
}
