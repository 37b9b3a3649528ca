//! A model that stores one long motion and generates its next frames: a stream of its segments equals that motion.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use motion::features::recover_joints;
use protocol::stage::{ControlHints, DataFormat, Family, Network};

use super::*;
use crate::generate::generator::{Batch, Edit, Infilling, Lap, MotionGenerator, Seeds, Text};
use crate::parts::control::{ControlMeta, ControlOptions};
use crate::parts::text::TextEncoder;

const FRAMES: usize = 400;

#[derive(Debug, Default)]
struct Said {
    /// Number of frames that the stream has.
    given: usize,
    /// Hints of the last segment.
    hints: Vec<Hint>,
}

#[derive(Debug)]
struct Scripted {
    rows: Vec<f32>,
    control: Option<ControlMeta>,
    infills: bool,
    said: Rc<RefCell<Said>>,
    text: NoText,
}

#[derive(Debug)]
struct NoText;

impl TextEncoder for NoText {
    fn dim(&self) -> usize {
        1
    }

    fn pooled(&self, captions: &[&str]) -> Result<Vec<f32>, StageError> {
        Ok(vec![0.0; captions.len()])
    }

    fn tokens(&self, captions: &[&str]) -> Result<Vec<Vec<f32>>, StageError> {
        Ok(vec![vec![0.0]; captions.len()])
    }
}

fn body() -> &'static Skeleton {
    Skeleton::of(DataFormat::Humanml3d)
}

impl Scripted {
    /// Frames of the motion, starting `overlap` frames before the stream's end.
    fn next(&self, overlap: usize, frames: usize) -> Vec<f32> {
        let start = self.said.borrow().given - overlap;
        self.rows[start * body().features..(start + frames) * body().features].to_vec()
    }
}

impl MotionGenerator for Scripted {
    fn format(&self) -> DataFormat {
        DataFormat::Humanml3d
    }

    fn longest(&self) -> usize {
        80
    }

    fn family(&self) -> &Family {
        &Family::Mld
    }

    fn text(&self) -> &dyn TextEncoder {
        &self.text
    }

    fn embed(&self, captions: &[&str]) -> Result<Vec<Text>, StageError> {
        Ok(captions.iter().map(|_| Text { values: vec![0.0] }).collect())
    }

    fn draw(&self, batch: Batch<'_>, _: &Sampler, _: &mut dyn FnMut(Lap)) -> Result<Vec<Vec<f32>>, StageError> {
        let hints = batch.control.map(|control| control.hints.to_vec()).unwrap_or_default();
        let told =
            hints.iter().flat_map(Hint::iter).map(|(frame, ..)| frame).collect::<std::collections::BTreeSet<_>>();
        // Waypoints of the tests are outside the overlap.
        let overlap = (0..).take_while(|frame| told.contains(frame)).count();
        self.said.borrow_mut().hints = hints;
        let overlap = if self.control.is_some() { overlap } else { self.said.borrow().given.min(1) };
        Ok(vec![self.next(overlap, batch.lengths[0])])
    }

    fn control(&self) -> Option<&ControlMeta> {
        self.control.as_ref()
    }

    fn infilling(&self) -> Option<&dyn Infilling> {
        self.infills.then_some(self)
    }
}

impl Infilling for Scripted {
    fn unit(&self) -> usize {
        4
    }

    fn fill_in(&self, edit: Edit<'_>, _: &Rc<Text>, _: &Seeds<'_>, _: &Sampler, _: &mut dyn FnMut(Lap)) -> Vec<f32> {
        let kept = 4 * edit.kept.iter().take_while(|kept| **kept).count();
        let rows = self.next(kept, 4 * edit.kept.len());
        let width = body().features;
        assert_eq!(edit.motion[..kept * width], rows[..kept * width], "what stays is the stream's end");
        rows
    }
}

/// A long motion, a stream of it, and the model's record of its inputs.
fn scripted(joining: Joining) -> (Vec<f32>, Generator, MotionStream, Rc<RefCell<Said>>) {
    let mut rows = vec![0.0; FRAMES * body().features];
    let mut draw = Stream::new(Seed(1), "script", 0, 0);
    draw.fill_normal(&mut rows[..body().features]);
    for t in 1..FRAMES {
        let (before, now) = rows.split_at_mut(t * body().features);
        for (value, last) in now.iter_mut().zip(&before[(t - 1) * body().features..]) {
            *value = 0.98 * last + 0.02 * draw.normal();
        }
    }
    rows.chunks_exact_mut(body().features).for_each(|row| row[..3].iter_mut().for_each(|v| *v *= 0.1));
    let said = Rc::new(RefCell::new(Said::default()));
    let control = (joining == Joining::Control).then(|| ControlMeta {
        format: DataFormat::Humanml3d,
        hints: ControlHints::default(),
        embedding: 8,
        network: Network::default(),
        mean: vec![0.0; 66],
        std: vec![1.0; 66],
        projection: None,
        feedback: 0,
        fits: BTreeMap::new(),
    });
    let infills = joining == Joining::Infilling;
    let model = Scripted { rows: rows.clone(), control, infills, said: Rc::clone(&said), text: NoText };
    let generator = Generator::of(Box::new(model));
    let settings =
        Settings { sampler: None, seed: Seed(2), control: ControlOptions::default(), overlap: None, blend: BLEND };
    let stream = MotionStream::new(&generator, settings).unwrap();
    assert_eq!(stream.joining(), joining);
    (rows, generator, stream, said)
}

fn ask(frames: Option<usize>) -> Ask {
    Ask { caption: "a person walks".into(), frames, waypoints: vec![] }
}

/// Checks frames against the motion. A segment placed by one frame does not have the stream's velocity, and fades from
/// a guess; after the fade it must agree.
fn assert_near(found: &[f64], expected: &[f32], joining: Joining, junctions: &[usize]) {
    let fades = |t: usize| joining == Joining::Placement && junctions.iter().any(|at| (*at..at + BLEND).contains(&t));
    for (i, (a, b)) in found.iter().zip(expected).enumerate().filter(|(i, _)| !fades(i / 66)) {
        assert!((a - f64::from(*b)).abs() < 1e-3, "{joining:?}, frame {}: {a} against {b}", i / 66);
    }
}

#[test]
fn segments_of_one_motion_are_that_motion() {
    for (joining, overlaps) in [
        (Joining::Control, [0, 11, 20, 13, 20]),
        (Joining::Infilling, [0, 8, 16, 12, 20]),
        (Joining::Placement, [0, 1, 1, 1, 1]),
    ] {
        let (rows, generator, mut stream, said) = scripted(joining);
        let whole = recover_joints(&rows, body());
        let mut all = Vec::new();
        let mut junctions = Vec::new();
        // The last two requests: longer than the model generates at once, and the model's own length.
        for (frames, overlap) in [Some(40), Some(33), Some(60), Some(39), None].into_iter().zip(overlaps) {
            let segment = stream.draw(&generator, &ask(frames)).unwrap();
            assert_eq!((segment.frames, segment.overlap), (frames.unwrap_or(80 - overlap), overlap), "{joining:?}");
            assert!(segment.offset < 1e-3, "{}", segment.offset);
            junctions.push(all.len() / 66);
            all.extend(segment.joints);
            said.borrow_mut().given += segment.frames;
        }
        assert_near(&all, &whole, joining, &junctions);
        // The targets of the last segment are the six joints of the frames before it, from the origin, facing z.
        if joining == Joining::Control {
            let start = said.borrow().given - 60 - 20;
            let local = recover_joints(&rows[start * body().features..][..80 * body().features], body());
            let hints = said.borrow().hints.clone();
            assert_eq!(hints[0].told(), 20 * 6);
            for (frame, joint, position) in hints[0].iter() {
                let at = 3 * (frame * 22 + joint);
                assert!(position.iter().zip(&local[at..at + 3]).all(|(a, b)| (a - b).abs() < 1e-3), "{position:?}");
            }
        }
    }
}

#[test]
fn what_is_taken_back_is_drawn_anew() {
    for joining in [Joining::Control, Joining::Infilling, Joining::Placement] {
        let (rows, generator, mut stream, said) = scripted(joining);
        let mut all = stream.draw(&generator, &ask(Some(60))).unwrap().joints;
        stream.cut(27);
        all.truncate(27 * 66);
        said.borrow_mut().given = 27;
        let segment = stream.draw(&generator, &ask(Some(40))).unwrap();
        all.extend(segment.joints);
        assert_near(&all, &recover_joints(&rows, body()), joining, &[27]);
        // Hardly any frames are left to continue from.
        stream.cut(0);
        stream.cut(0);
        assert!(stream.draw(&generator, &ask(Some(10))).is_ok());
    }
}

#[test]
fn waypoints_are_of_the_world() {
    let (rows, generator, mut stream, said) = scripted(Joining::Control);
    let whole = recover_joints(&rows, body());
    let first = stream.draw(&generator, &ask(Some(40))).unwrap();
    said.borrow_mut().given = first.frames;
    let told = |frame: usize, joint: usize| {
        let at = 3 * ((40 + frame) * 22 + joint);
        Waypoint { frame, joint, position: [whole[at], whole[at + 1], whole[at + 2]] }
    };
    let waypoints = vec![told(3, 0), told(30, 21)];
    let segment = stream.draw(&generator, &Ask { waypoints, ..ask(Some(40)) }).unwrap();
    assert_eq!(segment.missed.len(), 2);
    assert!(segment.missed.iter().all(|metres| *metres < 1e-3), "{:?}", segment.missed);
    let hints = said.borrow().hints.clone();
    assert_eq!(hints[0].told(), 6 * segment.overlap + 2, "nothing is told in between");
    let (_, generator, mut stream, _) = scripted(Joining::Placement);
    let refused = stream.draw(&generator, &Ask { waypoints: vec![told(3, 0)], ..ask(Some(40)) }).unwrap_err();
    assert!(refused.to_string().contains("no control part"));
}

#[test]
fn a_difference_fades() {
    for joining in [Joining::Control, Joining::Placement] {
        let (rows, generator, mut stream, said) = scripted(joining);
        let first = stream.draw(&generator, &ask(Some(40))).unwrap();
        // Makes the model continue at another frame of its motion.
        said.borrow_mut().given = 200;
        let second = stream.draw(&generator, &ask(Some(40))).unwrap();
        assert!(second.offset > 0.1, "{}", second.offset);
        let far = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let last = &first.joints[39 * 66..];
        let new = &second.joints[..66];
        assert!(far(last, new) < 0.5 * second.offset, "{} of {}", far(last, new), second.offset);
        // After the fade it is the other motion, placed in the world.
        let own = recover_joints(&rows[199 * body().features..][..41 * body().features], body());
        let own: Vec<f64> = own.into_iter().map(f64::from).collect();
        let distance = |joints: &[f64], t: usize| {
            let at = |j: usize, axis: usize| joints[(t * 22 + j) * 3 + axis];
            (0..3).map(|axis| (at(21, axis) - at(0, axis)).powi(2)).sum::<f64>().sqrt()
        };
        assert!((distance(&second.joints, 30) - distance(&own, 31)).abs() < 1e-3);
        // The root moves as in the other motion, starting at the stream's place: no distance is made up for.
        let way = |joints: &[f64], t: usize, to: usize| {
            let root = |t: usize, axis: usize| joints[t * 66 + axis];
            (root(to, 0) - root(t, 0)).hypot(root(to, 2) - root(t, 2))
        };
        let from_end = [last, &second.joints[..]].concat();
        assert!((way(&from_end, 0, 31) - way(&own, 0, 31)).abs() < 1e-3, "{joining:?}");
    }
}

#[test]
fn an_overlap_must_leave_something_new() {
    let (_, generator, stream, _) = scripted(Joining::Control);
    let settings = Settings { overlap: Some(80), ..stream.settings.clone() };
    assert!(MotionStream::new(&generator, settings).unwrap_err().to_string().contains("have no new frames"));
    let settings = Settings { overlap: Some(50), ..stream.settings };
    let mut stream = MotionStream::new(&generator, settings).unwrap();
    stream.draw(&generator, &ask(Some(80))).unwrap();
    assert_eq!(stream.total(1), 52, "a segment is longer than what it goes on from");
}
