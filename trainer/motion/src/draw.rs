//! Pictures of motion: an animated stick figure, and a sheet of poses over time.
//!
//! Orthographic projection from a 3/4 view, anti-aliased lines and letters. A sheet has the time below each pose and the
//! way from above behind each row. Joints are `[T, J, 3]` in the skeleton's units with y up.

mod colours;
mod font;
mod panels;
mod plan;
mod raster;

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::Path;

use colours::{BODY, FAINT, GRID, INK, LEFT, PAPER, RIGHT, SHADOW, TOLD, TRAIL};
use font::{NOTE, SMALL, TITLE};
pub use panels::gif_of_all_to;
use raster::{Canvas, Colour};

use crate::skeleton::Skeleton;
pub use crate::waypoints::Waypoint;

/// Camera angle about the vertical, radians.
const TURN: f64 = -0.65;
const TIP: f64 = 0.26;

/// A view of the world: pixels per metre and the point shown at `centre`.
struct View {
    scale: f64,
    centre: [f64; 2],
    looking_at: [f64; 3],
}

impl View {
    /// Pixel position, and depth (larger is nearer).
    fn project(&self, p: [f64; 3]) -> ([f64; 2], f64) {
        let [x, y, z] = [0, 1, 2].map(|k| p[k] - self.looking_at[k]);
        let (sin, cos) = TURN.sin_cos();
        let right = x * cos - z * sin;
        let near = x * sin + z * cos;
        let (tip_sin, tip_cos) = TIP.sin_cos();
        let up = y * tip_cos - near * tip_sin;
        ([self.centre[0] + self.scale * right, self.centre[1] - self.scale * up], near * tip_cos + y * tip_sin)
    }
}

/// Converts joints of frame `t` to metres.
fn frame(joints: &[f32], skeleton: &Skeleton, t: usize) -> Vec<[f64; 3]> {
    let width = 3 * skeleton.joints;
    let metres = |v: f32| f64::from(v) * skeleton.metres_per_unit;
    joints[t * width..(t + 1) * width].chunks_exact(3).map(|p| [metres(p[0]), metres(p[1]), metres(p[2])]).collect()
}

fn colour_of(skeleton: &Skeleton, joint: usize) -> Colour {
    if skeleton.left.contains(&joint) {
        LEFT
    } else if skeleton.right.contains(&joint) {
        RIGHT
    } else {
        BODY
    }
}

/// Draws the key of colours from `at` to the right. `kept` adds the pale figures of kept frames, `told` the targets.
fn key(canvas: &mut Canvas, at: [f64; 2], kept: bool, told: bool) {
    let all = [
        (LEFT, "left side", true),
        (RIGHT, "right side", true),
        (SHADOW, "kept", kept),
        (TOLD, "drawn", kept),
        (TOLD, "target", told && !kept),
    ];
    let mut x = at[0];
    for (colour, word, _) in all.into_iter().filter(|(_, _, shown)| *shown) {
        canvas.line([x + 2.0, at[1] + 7.5], [x + 14.0, at[1] + 7.5], 5.0, colour);
        x += 22.0 + font::draw(canvas, word, [x + 22.0, at[1]], SMALL, INK) + 16.0;
    }
}

/// Size of the head above the last joint of the spine, metres.
const HEAD: f64 = 0.115;

fn figure(canvas: &mut Canvas, view: &View, skeleton: &Skeleton, pose: &[[f64; 3]], strength: f64) {
    let fade = |colour: Colour| raster::blend(PAPER, colour, strength);
    for chain in skeleton.chains {
        for bone in chain.windows(2) {
            let flat = |j: usize| view.project([pose[j][0], 0.0, pose[j][2]]).0;
            canvas.line(flat(bone[0]), flat(bone[1]), 0.030 * view.scale, fade(SHADOW));
        }
    }
    let mut bones: Vec<(f64, [usize; 2])> = skeleton
        .chains
        .iter()
        .flat_map(|chain| chain.windows(2))
        .map(|bone| (0.5 * (view.project(pose[bone[0]]).1 + view.project(pose[bone[1]]).1), [bone[0], bone[1]]))
        .collect();
    bones.sort_by(|a, b| a.0.total_cmp(&b.0));
    let skull = skeleton.chains.iter().map(|c| c[c.len() - 1]).find(|j| colour_of(skeleton, *j) == BODY);
    for (_, [a, b]) in bones {
        let colour = fade(colour_of(skeleton, b));
        let width = if colour_of(skeleton, b) == BODY { 0.055 } else { 0.048 };
        canvas.line(view.project(pose[a]).0, view.project(pose[b]).0, width * view.scale, colour);
        if Some(b) == skull {
            let lift = [0, 1, 2].map(|k| pose[b][k] + 0.35 * (pose[b][k] - pose[a][k]));
            canvas.disc(view.project(lift).0, HEAD * view.scale, colour);
        }
    }
}

fn ground(canvas: &mut Canvas, view: &View, reach: f64) {
    let step = 0.5;
    let [x, _, z] = view.looking_at;
    let cells = (reach / step).ceil() as i64;
    let x0 = (x / step).round() * step;
    let z0 = (z / step).round() * step;
    for i in -cells..=cells {
        let d = i as f64 * step;
        let r = cells as f64 * step;
        let mut line = |a: [f64; 3], b: [f64; 3]| canvas.line(view.project(a).0, view.project(b).0, 1.0, GRID);
        line([x0 + d, 0.0, z0 - r], [x0 + d, 0.0, z0 + r]);
        line([x0 - r, 0.0, z0 + d], [x0 + r, 0.0, z0 + d]);
    }
}

/// Draws a line through each joint's waypoints, and the waypoints; those of later frames are lighter.
fn told(canvas: &mut Canvas, view: &View, waypoints: &[Waypoint], t: usize) {
    let place = |w: &Waypoint| view.project(w.position.map(f64::from)).0;
    for pair in waypoints.windows(2).filter(|pair| pair[0].joint == pair[1].joint) {
        canvas.line(place(&pair[0]), place(&pair[1]), 1.5, raster::blend(PAPER, TOLD, 0.4));
    }
    for waypoint in waypoints {
        let strength = if waypoint.frame <= t { 1.0 } else { 0.5 };
        canvas.disc(place(waypoint), 4.0, raster::blend(PAPER, TOLD, strength));
    }
}

/// Width and height of a film in pixels.
pub const FILM: [usize; 2] = [400, 400];

/// Draws every frame of a motion, with the camera following the root and `title` above.
fn film(
    joints: &[f32],
    skeleton: &Skeleton,
    title: &str,
    waypoints: &[Waypoint],
    mut each: impl FnMut(&Canvas, usize) -> io::Result<()>,
) -> io::Result<()> {
    let [width, height] = FILM;
    let frames = frames_of(joints, skeleton)?;
    let lines = font::wrap(title, TITLE, width as f64 - 24.0);
    let path: Vec<[f64; 3]> = (0..frames).map(|t| frame(joints, skeleton, t)[0]).collect();
    for t in 0..frames {
        let pose = frame(joints, skeleton, t);
        let view = View {
            scale: 145.0,
            centre: [width as f64 / 2.0, height as f64 * 0.60],
            looking_at: [follow(&path, t, 0), 0.80, follow(&path, t, 2)],
        };
        let mut canvas = Canvas::new(width, height, PAPER);
        ground(&mut canvas, &view, 3.5);
        canvas.lines(path[..=t].iter().map(|p| view.project([p[0], 0.0, p[2]]).0), 2.5, TRAIL);
        told(&mut canvas, &view, waypoints, t);
        figure(&mut canvas, &view, skeleton, &pose, 1.0);
        for (i, line) in lines.iter().enumerate() {
            font::draw(&mut canvas, line, [12.0, 10.0 + 21.0 * i as f64], TITLE, INK);
        }
        let bottom = height as f64 - 24.0;
        key(&mut canvas, [12.0, bottom], false, !waypoints.is_empty());
        let clock = format!("{:.1} s of {:.1}", t as f64 / skeleton.fps, frames as f64 / skeleton.fps);
        let x = width as f64 - 12.0 - font::width(&clock, SMALL);
        font::draw(&mut canvas, &clock, [x, bottom], SMALL, INK);
        each(&canvas, t)?;
    }
    Ok(())
}

/// Writes the frames of a film one after another for a video encoder, [`FILM`] pixels of red, green and blue each.
///
/// # Errors
/// If `out` fails, or the joints are not a whole number of frames.
pub fn rgb_along_to(
    joints: &[f32],
    skeleton: &Skeleton,
    title: &str,
    waypoints: &[Waypoint],
    mut out: impl Write,
) -> io::Result<()> {
    film(joints, skeleton, title, waypoints, |canvas, _| out.write_all(&canvas.bytes()))
}

/// Writes an animated GIF: the motion at its own speed, with the camera following the root, its waypoints and `title`
/// above.
///
/// # Errors
/// If `out` fails, or the joints are not a whole number of frames.
pub fn gif_along_to(
    joints: &[f32],
    skeleton: &Skeleton,
    title: &str,
    waypoints: &[Waypoint],
    out: impl Write,
) -> io::Result<()> {
    let [width, height] = FILM.map(|pixels| pixels as u16);
    let frames = frames_of(joints, skeleton)?;
    let palette = raster::palette(&[PAPER, INK, GRID, TRAIL, SHADOW, BODY, LEFT, RIGHT, TOLD]);
    let failed = |e: gif::EncodingError| io::Error::other(e.to_string());
    let mut encoder = gif::Encoder::new(out, width, height, &palette.bytes).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    film(joints, skeleton, title, waypoints, |canvas, t| {
        let mut image = gif::Frame::from_indexed_pixels(width, height, palette.indices(canvas), None);
        // Hundredths of a second, rounded over the whole clip, so that its length is right.
        let ends = |t: usize| (t as f64 * 100.0 / skeleton.fps).round() as u16;
        image.delay = if t + 1 == frames { 60 } else { ends(t + 1).wrapping_sub(ends(t)) };
        encoder.write_frame(&image).map_err(failed)
    })
}

/// Writes an animated GIF without waypoints to a file.
///
/// # Errors
/// If the file cannot be written, or the joints are not a whole number of frames.
pub fn gif(joints: &[f32], skeleton: &Skeleton, title: &str, path: &Path) -> io::Result<()> {
    gif_along(joints, skeleton, title, &[], path)
}

/// Writes an animated GIF with [`gif_along_to`] to a file.
///
/// # Errors
/// As [`gif`].
pub fn gif_along(
    joints: &[f32],
    skeleton: &Skeleton,
    title: &str,
    waypoints: &[Waypoint],
    path: &Path,
) -> io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    gif_along_to(joints, skeleton, title, waypoints, &mut file)?;
    file.flush()
}

/// Course of the camera: the root's, averaged over a second.
fn follow(path: &[[f64; 3]], t: usize, axis: usize) -> f64 {
    let near = &path[t.saturating_sub(10)..(t + 11).min(path.len())];
    near.iter().map(|p| p[axis]).sum::<f64>() / near.len() as f64
}

fn frames_of(joints: &[f32], skeleton: &Skeleton) -> io::Result<usize> {
    let width = 3 * skeleton.joints;
    if joints.is_empty() || !joints.len().is_multiple_of(width) {
        let what =
            format!("{} coordinates are not a whole number of frames of {} joints x 3", joints.len(), skeleton.joints);
        return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
    }
    Ok(joints.len() / width)
}

/// A motion of a sheet.
#[derive(Debug, Clone)]
pub struct Row {
    /// Its sentence or name.
    pub title: String,
    /// Its origin, such as model, sampler and seed; may be empty.
    pub note: String,
    /// Positions `[T, J, 3]`.
    pub joints: Vec<f32>,
}

/// Inputs of generated motions besides the text.
#[derive(Debug, Clone, Copy, Default)]
pub struct Given<'a> {
    /// Waypoints of the first motion.
    pub waypoints: &'a [Waypoint],
    /// Frames that were kept when a part of a motion was regenerated; empty for a motion generated as a whole.
    pub kept: &'a [Range<usize>],
}

/// Pixels between the poses of a sheet.
const CELL: usize = 110;
/// Height of a row of a sheet in pixels.
const ROW: usize = 226;
/// Width of the way from above behind each row.
const WAY: usize = 176;
/// Height of the key below the last row.
const KEY: usize = 32;

/// Width and height of a sheet in pixels.
pub fn sheet_size(rows: usize, poses: usize, with_waypoints: bool) -> [usize; 2] {
    [CELL * poses + 24 + WAY, ROW * rows + KEY + if with_waypoints { plan::HEIGHT } else { 0 }]
}

/// Writes a PNG with one row per motion: title and note, `poses` poses spread over its time with their seconds, and its
/// way from above. Poses of kept frames are pale, and a line below each row marks their time. With waypoints, the first
/// motion and its waypoints are shown from above at the bottom.
///
/// # Errors
/// If `out` fails, or a motion is not a whole number of frames.
pub fn sheet_to(rows: &[Row], poses: usize, skeleton: &Skeleton, given: Given<'_>, out: impl Write) -> io::Result<()> {
    let Given { waypoints, kept } = given;
    let [width, height] = sheet_size(rows.len(), poses, !waypoints.is_empty());
    let mut canvas = Canvas::new(width, height, PAPER);
    for (i, row) in rows.iter().enumerate() {
        sheet_row(&mut canvas, row, poses, skeleton, (ROW * i) as f64, kept)?;
    }
    let bottom = (ROW * rows.len()) as f64;
    key(&mut canvas, [12.0, bottom + 8.0], !kept.is_empty(), !waypoints.is_empty());
    if let (Some(row), false) = (rows.first(), waypoints.is_empty()) {
        let at = |t: usize, joint: usize| frame(&row.joints, skeleton, t)[joint];
        let frames = frames_of(&row.joints, skeleton)?;
        plan::draw(&mut canvas, bottom + KEY as f64, (frames, &at), waypoints);
    }
    let mut encoder = png::Encoder::new(out, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let failed = |e: png::EncodingError| io::Error::other(e.to_string());
    encoder.write_header().and_then(|mut w| w.write_image_data(&canvas.bytes())).map_err(failed)
}

/// Draws a row of a sheet below `top`.
fn sheet_row(
    canvas: &mut Canvas,
    Row { title, note, joints }: &Row,
    poses: usize,
    skeleton: &Skeleton,
    top: f64,
    kept: &[Range<usize>],
) -> io::Result<()> {
    let frames = frames_of(joints, skeleton)?;
    let wide = canvas.width as f64 - 24.0;
    let title = font::fit(title, TITLE, wide * 0.62);
    let used = font::draw(canvas, &title, [12.0, top + 6.0], TITLE, INK);
    let note = font::fit(note, NOTE, wide - used - 16.0);
    font::draw(canvas, &note, [28.0 + used, top + 9.5], NOTE, FAINT);
    for column in 0..poses {
        let t = column * (frames - 1) / poses.saturating_sub(1).max(1);
        let pose = frame(joints, skeleton, t);
        let middle = 12.0 + CELL as f64 * (column as f64 + 0.5);
        let [x, _, z] = pose[0];
        let view = View { scale: 78.0, centre: [middle, top + 130.0], looking_at: [x, 0.85, z] };
        let corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5)];
        canvas.lines(corners.map(|(dx, dz)| view.project([x + dx, 0.0, z + dz]).0), 1.0, GRID);
        let stayed = kept.iter().any(|span| span.contains(&t));
        figure(canvas, &view, skeleton, &pose, if stayed { 0.4 } else { 1.0 });
        if kept.is_empty() {
            let clock = format!("{:.1} s", t as f64 / skeleton.fps);
            let x = middle - font::width(&clock, SMALL) / 2.0;
            font::draw(canvas, &clock, [x, top + ROW as f64 - 18.0], SMALL, FAINT);
        }
    }
    timeline(canvas, top + ROW as f64, (frames, poses), skeleton.fps, kept);
    let way: Vec<[f64; 2]> = (0..frames).map(|t| frame(joints, skeleton, t)[0]).map(|[x, _, z]| [x, z]).collect();
    let left = (12 + CELL * poses + 8) as f64;
    plan::trail(canvas, &way, skeleton.fps, [left, top + 24.0], (WAY - 12) as f64);
    Ok(())
}

/// Draws a line above `bottom` that marks the kept and the generated frames of a row with their seconds; nothing without
/// kept frames.
fn timeline(canvas: &mut Canvas, bottom: f64, (frames, poses): (usize, usize), fps: f64, kept: &[Range<usize>]) {
    if kept.is_empty() {
        return;
    }
    let pace = (poses.saturating_sub(1) * CELL) as f64 / frames.saturating_sub(1).max(1) as f64;
    let x = |t: usize| 12.0 + 0.5 * CELL as f64 + pace * t as f64;
    let stayed = |t: usize| kept.iter().any(|span| span.contains(&t));
    let mut from = 0;
    while from < frames {
        let to = (from..frames).find(|t| stayed(*t) != stayed(from)).unwrap_or(frames);
        let (colour, word) = if stayed(from) { (SHADOW, "kept") } else { (TOLD, "drawn") };
        canvas.line([x(from), bottom - 6.0], [x(to - 1), bottom - 6.0], 4.0, colour);
        let label = format!("{word} {:.1} to {:.1} s", from as f64 / fps, to as f64 / fps);
        let ink = if stayed(from) { BODY } else { TOLD };
        font::draw(canvas, &font::fit(&label, SMALL, x(to) - x(from)), [x(from), bottom - 23.0], SMALL, ink);
        from = to;
    }
}

/// Writes a PNG with [`sheet_to`] to a file.
///
/// # Errors
/// If the file cannot be written, or a motion is not a whole number of frames.
pub fn sheet(rows: &[Row], poses: usize, skeleton: &Skeleton, given: Given<'_>, path: &Path) -> io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    sheet_to(rows, poses, skeleton, given, &mut file)?;
    file.flush()
}
