//! `trainer generate --control`: target positions of a motion, and the distances of the generated motion from them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use checkpoint::Blobs as _;
use checkpoint::model::{self as assembly, Model};
use clap::Args;
use motion::Skeleton;
use motion::waypoints::{self, Waypoint};
use protocol::Manifest;
use protocol::artifact::Role;
use protocol::limits::{FEEDBACK_ROUNDS, REFINE_STEPS};
use stages::generate::{Generated, Generator};
use stages::parts::control::ControlOptions;
use stages::parts::hint::{Hint, metres};

use super::model::{self, Found};
use crate::reader::Reader;
use crate::report::problem::{Problem, Result};

/// Distance in metres beyond which the papers count a waypoint as missed.
const MISSED: f64 = 0.5;

#[derive(Debug, Args)]
pub(super) struct ControlArgs {
    /// Target positions: a .csv with columns t,x,y,z or t,joint,x,y,z, a .json of [t, x, y, z] by joint (seconds and
    /// metres; the motion starts at x = z = 0 and faces z), or a motion as .npy
    #[arg(long, value_name = "FILE", conflicts_with = "edit")]
    control: Option<PathBuf>,
    /// Controlled joints, such as pelvis,left_wrist [default: the joints in the file, else the pelvis]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    joints: Vec<String>,
    /// Strength of the control; 0 turns it off [default: 1, as trained]
    #[arg(long, value_name = "S")]
    control_scale: Option<f64>,
    /// Rounds in which the control part corrects the sample [default: as many as in its training]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(..=FEEDBACK_ROUNDS as u64))]
    feedback: Option<u64>,
    /// Refines the sample in N steps that move the latent until the decoded motion passes the positions; costs about 4
    /// N decodings [default: 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(..=REFINE_STEPS as u64))]
    refine: Option<u64>,
    /// Takes the control part of another model, MODEL@ALIAS or MODEL:VERSION, which must have been trained for this one
    #[arg(long, value_name = "MODEL", visible_alias = "control-part")]
    control_from: Option<String>,
}

/// Target positions of a motion and the strength of the control.
#[derive(Debug)]
pub(super) struct Targets {
    hint: Hint,
    options: ControlOptions,
    pub(super) waypoints: Vec<Waypoint>,
}

/// Distances of a motion from its target positions.
#[derive(Debug, Clone, Copy)]
pub(super) struct Missed {
    /// Number of target positions.
    pub(super) targets: usize,
    /// Mean distance in metres.
    pub(super) average: f64,
    /// Largest distance in metres.
    pub(super) worst: f64,
    /// Share of positions missed by more than half a metre.
    pub(super) location: f64,
}

impl ControlArgs {
    /// Returns true if a path is given.
    pub(super) fn given(&self) -> bool {
        self.control.is_some()
    }

    /// Refuses options of control without a path, unless the command streams.
    pub(super) fn check(&self, streams: bool) -> Result<()> {
        let ControlOptions { scale, .. } = self.options();
        if !(scale >= 0.0 && scale.is_finite()) {
            return Err(Problem::usage(format!("`--control-scale` is {scale}; expected 0 or more")));
        }
        let given = [
            (!self.joints.is_empty(), "joints"),
            (self.control_scale.is_some(), "control-scale"),
            (self.feedback.is_some(), "feedback"),
            (self.refine.is_some(), "refine"),
            (self.control_from.is_some(), "control-from"),
        ];
        match given.into_iter().find(|(given, _)| *given && !streams && self.control.is_none()) {
            None => Ok(()),
            Some((_, name)) => {
                Err(Problem::usage(format!("`--{name}` has no effect without `--control` or `--stream`")))
            }
        }
    }

    /// Strength of the control and its corrections.
    pub(super) fn options(&self) -> ControlOptions {
        ControlOptions {
            scale: self.control_scale.unwrap_or(1.0),
            feedback: self.feedback.map(|rounds| rounds as usize),
            refine: self.refine.unwrap_or(0) as usize,
        }
    }

    /// The controlled joints.
    pub(super) fn joints(&self) -> &[String] {
        &self.joints
    }

    /// Replaces the control part of `found` with that of another model, if one is named.
    pub(super) async fn completed(&self, reader: &Reader, mut found: Found) -> Result<Found> {
        let Some(name) = &self.control_from else { return Ok(found) };
        let other = model::version(reader, name).await?;
        let parts = Model::read(&other.manifest).map_err(Problem::failed)?.parts;
        let Some(digest) = parts.get(&Role::CONTROL) else {
            return Err(Problem::usage(format!("{name} has no control part")).hint(TRAIN));
        };
        let bytes = other.blobs.get(*digest).map_err(Problem::failed)?;
        let part: Manifest = serde_json::from_slice(&bytes).map_err(|error| {
            Problem::failed(format!("cannot parse the manifest of the control part of {name}: {error}"))
        })?;
        found.manifest =
            assembly::extend(&found.manifest, None, &BTreeMap::from([(Role::CONTROL, part)])).map_err(|error| {
                Problem::usage(format!("{}: {error}", found.label)).hint(
                    "a control part fits only the model that it was trained with; `trainer registry show` names that \
                     model",
                )
            })?;
        found.blobs.add(other.blobs);
        Ok(found)
    }

    /// Reads the target positions for a model; `None` without a path. Without `frames`, the motion ends with the path.
    pub(super) fn targets(&self, generator: &Generator, label: &str, frames: Option<usize>) -> Result<Option<Targets>> {
        let Some(file) = &self.control else { return Ok(None) };
        if generator.control().is_none() {
            return Err(Problem::usage(format!("{label} has no control part, so it cannot follow a path")).hint(TRAIN));
        }
        let skeleton = Skeleton::of(generator.format());
        let waypoints = waypoints::read(file, skeleton, &self.joints).map_err(Problem::usage)?;
        waypoints::check_start(&waypoints, skeleton, [0.0; 3])
            .map_err(|why| Problem::usage(format!("`{}`: {why}", file.display())))?;
        let end = waypoints.iter().map(|waypoint| waypoint.frame + 1).max().unwrap_or_default();
        let frames = frames.unwrap_or_else(|| end.next_multiple_of(skeleton.unit).max(skeleton.min_frames));
        if let Some(outside) = waypoints.iter().find(|waypoint| waypoint.frame >= frames) {
            return Err(Problem::usage(format!(
                "`{}`: the waypoint of `{}` at {:.2} s is outside the motion, whose {frames} frames end at {:.2} s",
                file.display(),
                skeleton.names[outside.joint],
                outside.frame as f64 / skeleton.fps,
                frames.saturating_sub(1) as f64 / skeleton.fps
            ))
            .hint(format!("`--frames {end}` or more covers all waypoints")));
        }
        let longest = generator.longest();
        if frames > longest {
            return Err(Problem::usage(format!(
                "`{}`: the path takes {:.1} s, but {label} generates motions of at most {:.1} s ({longest} frames)",
                file.display(),
                end as f64 / skeleton.fps,
                longest as f64 / skeleton.fps
            )));
        }
        let mut hint = Hint::none(frames, skeleton.joints);
        waypoints.iter().for_each(|waypoint| hint.tell(waypoint.frame, waypoint.joint, waypoint.position));
        Ok(Some(Targets { hint, options: self.options(), waypoints }))
    }
}

/// Hint for a model without a control part.
pub(super) const TRAIN: &str = "a `train.control` stage outputs a model with a control part";

impl Targets {
    /// Target positions and strength of the control.
    pub(super) fn request(&self) -> (&Hint, ControlOptions) {
        (&self.hint, self.options)
    }

    /// Measures the distances of `motion` from its targets.
    pub(super) fn missed(&self, motion: &Generated) -> Option<Missed> {
        let skeleton = Skeleton::of(motion.format);
        let joints = metres(&motion.features, skeleton);
        let errors = self.hint.errors(&joints, MISSED)?;
        let distance = |w: &Waypoint| {
            let at = 3 * (w.frame * skeleton.joints + w.joint);
            let squares = joints[at..at + 3].iter().zip(w.position).map(|(a, b)| f64::from(a - b).powi(2));
            squares.sum::<f64>().sqrt()
        };
        let worst = self.waypoints.iter().map(distance).fold(0.0, f64::max);
        Some(Missed { targets: self.hint.told(), average: errors.average, worst, location: errors.location })
    }
}
