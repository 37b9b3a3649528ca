//! Target positions of a controlled motion. Source: MotionLCM (Dai et al., ECCV 2024; v2 of late 2024), after
//! OmniControl.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{DataFormat, Problems};

/// Frames and joints that get targets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ControlSetting {
    /// All joints of the list, in the first frames: MotionLCM's task.
    #[default]
    Temporal,
    /// Frames drawn at random; in training one joint of the list: OmniControl's task.
    Spatial,
}

/// Target positions of a motion in training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct ControlHints {
    /// Frames and joints that get targets.
    pub setting: ControlSetting,
    /// Names of joints, or of sets of joints. `six` (K = 6 of the paper): pelvis, feet, head, wrists. `twelve` (K =
    /// 12): its list is not public; ours adds hips, ankles and shoulders. `all` (K = 22).
    pub joints: Vec<String>,
    /// Percent of the frames that get targets: drawn from this range, then rounded down to frames. [0, 100] in the
    /// spatial setting means 1 to all but one frame, each number equally likely, as published.
    #[schemars(extend("minimum" = 0.0, "maximum" = 100.0), extend("x-unit" = "percent of the frames"))]
    pub density: (f64, f64),
}

impl Default for ControlHints {
    fn default() -> Self {
        Self { setting: ControlSetting::Temporal, joints: vec!["six".into()], density: (25.0, 25.0) }
    }
}

impl ControlHints {
    /// Returns true if all numbers of frames are equally likely.
    pub fn any_number(&self) -> bool {
        self.setting == ControlSetting::Spatial && self.density == (0.0, 100.0)
    }

    pub(super) fn check(&self, p: &mut Problems) {
        check_words(p, "hints.joints", &self.joints);
        let (low, high) = self.density;
        if !(low >= 0.0 && low <= high && high <= 100.0) {
            let message = format!(
                "`hints.density` is [{low}, {high}]; expected percentages from 0 to 100, the smaller one first"
            );
            p.add("hints.density", message, "published: [25, 25] (temporal) and [0, 100] (spatial)");
        }
        if high == 0.0 {
            p.add("hints.density", "`hints.density` is [0, 0], so there are no hints", "published: [25, 25]");
        }
    }
}

/// Names of sets of joints.
const SETS: [&str; 3] = ["six", "twelve", "all"];

/// HumanML3D: pelvis, feet, head, wrists.
const SIX: [usize; 6] = [0, 10, 11, 15, 20, 21];
/// The six joints, hips, ankles and shoulders of HumanML3D.
const TWELVE: [usize; 12] = [0, 1, 2, 7, 8, 10, 11, 15, 16, 17, 20, 21];
/// The six joints of KIT-ML, which has no head above its upper neck.
const SIX_KIT: [usize; 6] = [0, 4, 7, 10, 15, 20];
const TWELVE_KIT: [usize; 12] = [0, 4, 5, 7, 8, 10, 11, 13, 15, 16, 18, 20];

impl DataFormat {
    /// Names of its joints, by index.
    pub const fn joints(self) -> &'static [&'static str] {
        match self {
            Self::Humanml3d => &[
                "pelvis",
                "left_hip",
                "right_hip",
                "spine1",
                "left_knee",
                "right_knee",
                "spine2",
                "left_ankle",
                "right_ankle",
                "spine3",
                "left_foot",
                "right_foot",
                "neck",
                "left_collar",
                "right_collar",
                "head",
                "left_shoulder",
                "right_shoulder",
                "left_elbow",
                "right_elbow",
                "left_wrist",
                "right_wrist",
            ],
            Self::Kit => &[
                "root",
                "pelvis",
                "thorax",
                "lower_neck",
                "upper_neck",
                "right_shoulder",
                "right_elbow",
                "right_wrist",
                "left_shoulder",
                "left_elbow",
                "left_wrist",
                "right_hip",
                "right_knee",
                "right_ankle",
                "right_midfoot",
                "right_foot",
                "left_hip",
                "left_knee",
                "left_ankle",
                "left_midfoot",
                "left_foot",
            ],
        }
    }

    /// Indices of the joints of `word`: a joint's name, `six`, `twelve` or `all`.
    ///
    /// # Errors
    /// An unknown word; the message lists the skeleton's joints.
    pub fn joints_of(self, word: &str) -> Result<Vec<usize>, String> {
        let names = self.joints();
        match (word, self) {
            ("all", _) => Ok((0..names.len()).collect()),
            ("six", Self::Humanml3d) => Ok(SIX.to_vec()),
            ("six", Self::Kit) => Ok(SIX_KIT.to_vec()),
            ("twelve", Self::Humanml3d) => Ok(TWELVE.to_vec()),
            ("twelve", Self::Kit) => Ok(TWELVE_KIT.to_vec()),
            (name, _) => names.iter().position(|known| *known == name).map(|joint| vec![joint]).ok_or_else(|| {
                let skeleton = self.skeleton();
                let names = names.join(", ");
                format!("a skeleton of {skeleton} has no joint `{word}`; its joints are {names}")
            }),
        }
    }

    /// Indices of all joints of `words`, each once, in the skeleton's order.
    ///
    /// # Errors
    /// As [`joints_of`](Self::joints_of).
    pub fn joints_of_all(self, words: &[String]) -> Result<Vec<usize>, String> {
        let mut all = Vec::new();
        for word in words {
            all.extend(self.joints_of(word)?);
        }
        all.sort_unstable();
        all.dedup();
        Ok(all)
    }
}

/// Checks a list of joints before the skeleton is known.
pub(super) fn check_words(p: &mut Problems, field: &str, words: &[String]) {
    if words.is_empty() {
        p.add(field, format!("`{field}` is empty; expected joint names, `six`, `twelve` or `all`"), "");
    }
    let known = |word: &str| {
        SETS.contains(&word) || [DataFormat::Humanml3d, DataFormat::Kit].iter().any(|f| f.joints().contains(&word))
    };
    for (i, word) in words.iter().enumerate() {
        if !known(word) {
            let message = format!("`{word}` is not a joint; expected a joint name, `six`, `twelve` or `all`");
            p.add(&format!("{field}[{i}]"), message, &format!("joints: {}", DataFormat::Humanml3d.joints().join(", ")));
        } else if words[..i].contains(word) {
            p.add(&format!("{field}[{i}]"), format!("`{field}` lists `{word}` twice"), "");
        }
    }
}

/// Refuses joints that the skeleton of `format` lacks.
pub(super) fn check_skeleton(p: &mut Problems, field: &str, words: &[String], format: Option<DataFormat>) {
    for (i, word) in words.iter().enumerate() {
        if let Some(Err(why)) = format.map(|format| format.joints_of(word)) {
            p.add(&format!("{field}[{i}]"), why, "");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_joints_of_the_same_parts_of_the_body() {
        let names = |format: DataFormat, set| -> Vec<&str> {
            format.joints_of(set).unwrap().into_iter().map(|joint| format.joints()[joint]).collect()
        };
        let six = names(DataFormat::Humanml3d, "six");
        assert_eq!(six, ["pelvis", "left_foot", "right_foot", "head", "left_wrist", "right_wrist"]);
        let kit = ["root", "upper_neck", "right_wrist", "left_wrist", "right_foot", "left_foot"];
        assert_eq!(names(DataFormat::Kit, "six"), kit);
        for format in [DataFormat::Humanml3d, DataFormat::Kit] {
            let twelve = names(format, "twelve");
            assert_eq!(twelve.len(), 12);
            assert!(names(format, "six").iter().all(|joint| twelve.contains(joint)));
            for pair in ["hip", "ankle", "foot", "shoulder", "wrist"] {
                for side in ["left", "right"] {
                    assert!(twelve.contains(&&*format!("{side}_{pair}")), "{side} {pair}");
                }
            }
        }
        let words = ["six".to_owned(), "pelvis".to_owned()];
        assert_eq!(DataFormat::Humanml3d.joints_of_all(&words).unwrap().len(), 6, "each once");
        assert!(DataFormat::Kit.joints_of("head").unwrap_err().contains("upper_neck"));
    }
}
