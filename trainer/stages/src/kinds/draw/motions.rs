//! `draw.motions`: motions of a model for given sentences.
//!
//! Files: `motions.json` has all motions in the viewer's form (`mocap::html`) with their measures, and their captions.
//! Each motion is also in files of its own, such as `motion-00.npy` with positions `[T, J, 3]` in metres, `motion-00.bvh`
//! and `motion-00.glb`. `motions.html` is a page with all of them, `motions.gif` a moving picture of the first 24. Motions
//! of one sentence are neighbours and have one length.

use std::collections::BTreeMap;

use mocap::Body;
use mocap::glb;
use mocap::html::{Page, Panel, Section, packed};
use mocap::rig::Rig;
use motion::waypoints::{self, Waypoint};
use motion::{Skeleton, draw, npy};
use protocol::stage::{DrawMotions, Sampler};
use protocol::{ArtifactKind, Seed};
use serde_json::json;

use crate::artifacts;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::generate::{Generated, Generator};
use crate::kinds::shape::Plain;
use crate::metrics::physics::{mean_physics, physics};
use crate::parts::control::ControlOptions;
use crate::parts::hint::Hint;

/// File of all motions in the viewer's form.
const MOTIONS_FILE: &str = "motions.json";
/// File of all motions as a page.
const PAGE_FILE: &str = "motions.html";
/// File of the first motions as one moving picture.
const FILM_FILE: &str = "motions.gif";
/// Largest number of motions in the moving picture.
const FILMED: usize = 24;

impl Plain for DrawMotions {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let generator = Generator::load(&manifest, &*cx.blobs(), &cx.device())?;
        let sampler = sampler(self, generator.sampler());
        generator.check_sampler(&sampler)?;
        let skeleton = Skeleton::of(generator.format());
        let frames = frames(self, &generator)?;
        let targets = targets(self, &generator, frames)?;
        let total = self.sentences.len() * self.count;
        let mut drawn = Vec::with_capacity(total);
        for sentence in &self.sentences {
            let frames = match (&targets, frames) {
                (Some(targets), _) => targets.hint.frames(),
                (None, Some(frames)) => frames,
                (None, None) => generator.frames(sentence, self.seed)?,
            };
            for number in 0..self.count {
                if cx.interrupted() {
                    return Ok(Outcome::Yielded { at: 0 });
                }
                let seed = Seed(self.seed.0.wrapping_add(number as u64));
                let motion = match &targets {
                    None => generator.generate(sentence, Some(frames), Some(&sampler), seed)?,
                    Some(targets) => {
                        let control = (&targets.hint, ControlOptions::default());
                        generator.generate_controlled(sentence, Some(&sampler), seed, control)?
                    }
                };
                drawn.push(Drawn { sentence, seed, motion });
                cx.progress(drawn.len() as u64, total as u64, "motions", &[]);
            }
        }
        let waypoints = targets.map(|targets| targets.waypoints).unwrap_or_default();
        publish(cx, skeleton, &sampler, (&drawn, &waypoints))
    }
}

/// The model's own sampler with the changes of the settings.
fn sampler(settings: &DrawMotions, own: Sampler) -> Sampler {
    let steps = if settings.steps == 0 { own.steps } else { settings.steps };
    let guidance = if settings.guidance < 0.0 { own.guidance } else { settings.guidance };
    // Another number of steps needs other timesteps.
    let timesteps = if steps == own.steps { own.timesteps } else { Vec::new() };
    Sampler { steps, guidance, timesteps, ..own }
}

/// Number of frames of each motion, if the settings say it.
fn frames(settings: &DrawMotions, generator: &Generator) -> Result<Option<usize>, StageError> {
    if settings.seconds == 0.0 {
        return Ok(None);
    }
    let fps = Skeleton::of(generator.format()).fps;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked to be 0 to 60 seconds")]
    let frames = (settings.seconds * fps).round() as usize;
    if frames == 0 || frames > generator.longest() {
        let seconds = settings.seconds;
        let longest = generator.longest() as f64 / fps;
        let message = format!("`seconds` is {seconds}; the model draws {:.2} to {longest:.1}", 1.0 / fps);
        return Err(StageError::Input(message));
    }
    Ok(Some(frames))
}

/// Positions that all motions pass.
struct Targets {
    hint: Hint,
    waypoints: Vec<Waypoint>,
}

/// The path of the settings for motions of `frames` frames, which end with the path without a length.
fn targets(
    settings: &DrawMotions,
    generator: &Generator,
    frames: Option<usize>,
) -> Result<Option<Targets>, StageError> {
    if settings.path.is_empty() {
        return Ok(None);
    }
    let refused = |why: String| StageError::Input(format!("`path`: {why}"));
    if generator.control().is_none() {
        return Err(refused("the model has no control part; a `train.control` stage outputs one that has".into()));
    }
    let skeleton = Skeleton::of(generator.format());
    let waypoints = waypoints::of_json(&json!(settings.path), skeleton, &[]).map_err(refused)?;
    waypoints::check_start(&waypoints, skeleton, [0.0; 3]).map_err(refused)?;
    let end = waypoints.iter().map(|waypoint| waypoint.frame + 1).max().unwrap_or_default();
    let frames = frames.unwrap_or_else(|| end.next_multiple_of(skeleton.unit).max(skeleton.min_frames));
    let most = frames.min(generator.longest());
    if end > most {
        let seconds = |frames: usize| frames as f64 / skeleton.fps;
        return Err(refused(format!("it takes {:.2} s; expected at most {:.2}", seconds(end), seconds(most))));
    }
    let mut hint = Hint::none(most, skeleton.joints);
    waypoints.iter().for_each(|waypoint| hint.tell(waypoint.frame, waypoint.joint, waypoint.position));
    Ok(Some(Targets { hint, waypoints }))
}

/// Positions of a motion in metres.
fn metres(motion: &Generated, skeleton: &Skeleton) -> Vec<f64> {
    motion.joints.iter().map(|value| f64::from(*value) * skeleton.metres_per_unit).collect()
}

/// A motion with its sentence and seed.
struct Drawn<'a> {
    sentence: &'a str,
    seed: Seed,
    motion: Generated,
}

/// Refuses a motion that has no files, such as one of an untrained network that is not finite.
fn refused(error: impl std::fmt::Display) -> StageError {
    StageError::Input(format!("the model's motion cannot be stored: {error}"))
}

fn publish(
    cx: &mut dyn AttemptContext,
    skeleton: &'static Skeleton,
    sampler: &Sampler,
    (drawn, waypoints): (&[Drawn<'_>], &[Waypoint]),
) -> Result<Outcome, StageError> {
    let all: Vec<_> = drawn.iter().map(|drawn| physics(&metres(&drawn.motion, skeleton), skeleton)).collect();
    let metrics: BTreeMap<String, f64> = mean_physics(all.as_flattened()).collect();
    let body = Body::of(skeleton);
    let mut panels = Vec::with_capacity(drawn.len());
    for Drawn { sentence, seed, motion } in drawn {
        let caption = (*sentence).to_owned();
        let note = format!("seed {}", seed.0);
        panels.push(Panel { caption, note, body: &body, joints: &motion.joints, waypoints });
    }
    let mut motions = packed(&panels).map_err(refused)?;
    motions["captions"] = panels.iter().map(|panel| json!(panel.caption)).collect();
    for (number, [skating, jerk, ..]) in all.iter().enumerate() {
        motions["motions"][number]["measures"] = json!({"skating": skating, "jerk": jerk});
    }
    let sections = vec![Section { title: String::new(), panels }];
    let mut page = Vec::new();
    Page { title: "Motions".to_owned(), sections }.write(&mut page).map_err(refused)?;

    let row = |drawn: &Drawn<'_>| draw::Row {
        title: drawn.sentence.to_owned(),
        note: format!("seed {}", drawn.seed.0),
        joints: drawn.motion.joints.clone(),
    };
    let rows: Vec<draw::Row> = drawn.iter().take(FILMED).map(row).collect();
    let mut film = Vec::new();
    draw::gif_of_all_to(&rows, skeleton, &mut film).map_err(refused)?;

    let meta = json!({"kind": cx.task().settings.kind(), "metrics": metrics, "sampler": sampler});
    let mut draft = artifacts::Draft::new(cx, ArtifactKind::Report, meta);
    draft.add(MOTIONS_FILE, protocol::canonical::to_bytes(&motions))?;
    draft.add(PAGE_FILE, page)?;
    draft.add(FILM_FILE, film)?;
    for (number, Drawn { sentence, motion, .. }) in drawn.iter().enumerate() {
        let Skeleton { fps, metres_per_unit, joints, .. } = *skeleton;
        let rig = Rig::fit(&motion.joints, skeleton).map_err(refused)?;
        let name = |ending: &str| format!("motion-{number:02}.{ending}");
        draft.add(&name("bvh"), rig.to_bvh(fps, 100.0 * metres_per_unit).to_text().into_bytes())?;
        draft.add(&name("glb"), glb::to_bytes(&rig, fps, metres_per_unit, sentence).map_err(refused)?)?;
        let positions: Vec<f32> = metres(motion, skeleton).into_iter().map(|value| value as f32).collect();
        draft.add(&name("npy"), npy::to_bytes(&[motion.frames, joints, 3], &positions))?;
    }
    Ok(Outcome::Finished { output: draft.finish(cx)?, metrics })
}
