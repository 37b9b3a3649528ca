//! Pictures of motion: an animated stick figure, and a sheet of poses over time.
//!
//! A small rasteriser of our own: orthographic projection from a 3/4 view, anti-aliased thick lines, a built-in 5x7
//! font. Joints are `[T, J, 3]` in the skeleton's units with y up.

mod colours;
mod font;
mod plan;
mod raster;

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::Path;

use colours::{BODY, GRID, INK, LEFT, PAPER, RIGHT, SHADOW, TOLD, TRAIL};
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
        let (right, near) = (x * cos - z * sin, x * sin + z * cos);
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
    let (x0, z0) = ((x / step).round() * step, (z / step).round() * step);
    for i in -cells..=cells {
        let (d, r) = (i as f64 * step, cells as f64 * step);
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
    let lines = font::wrap(title, width / 12 - 2);
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
        for pair in path[..=t].windows(2) {
            let flat = |p: [f64; 3]| view.project([p[0], 0.0, p[2]]).0;
            canvas.line(flat(pair[0]), flat(pair[1]), 2.5, TRAIL);
        }
        told(&mut canvas, &view, waypoints, t);
        figure(&mut canvas, &view, skeleton, &pose, 1.0);
        for (i, line) in lines.iter().enumerate() {
            font::draw(&mut canvas, line, [12.0, 12.0 + 20.0 * i as f64], 2, INK);
        }
        let clock = format!("{:.1} s", t as f64 / skeleton.fps);
        font::draw(&mut canvas, &clock, [width as f64 - 60.0, height as f64 - 20.0], 1, INK);
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
    film(joints, skeleton, title, waypoints, |canvas, _| out.write_all(canvas.bytes()))
}

/// Writes an animated GIF: the motion at its own speed, with the camera following the root and `title` above.
///
/// # Errors
/// If `out` fails, or the joints are not a whole number of frames.
pub fn gif_to(joints: &[f32], skeleton: &Skeleton, title: &str, out: impl Write) -> io::Result<()> {
    gif_along_to(joints, skeleton, title, &[], out)
}

/// Like [`gif_to`], with the waypoints of the motion.
///
/// # Errors
/// As [`gif_to`].
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

/// Writes an animated GIF with [`gif_to`] to a file.
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

/// Writes a PNG with one row per motion: its name, and `poses` poses spread over its time, side by side.
///
/// # Errors
/// If `out` fails, or a motion is not a whole number of frames.
pub fn strip_png_to(
    motions: &[(String, Vec<f32>)],
    poses: usize,
    skeleton: &Skeleton,
    out: impl Write,
) -> io::Result<()> {
    strip_png_along_to(motions, poses, skeleton, Given::default(), out)
}

/// Inputs of generated motions besides the text.
#[derive(Debug, Clone, Copy, Default)]
pub struct Given<'a> {
    /// Waypoints of the first motion.
    pub waypoints: &'a [Waypoint],
    /// Frames that were kept when a part of a motion was regenerated; empty for a motion generated as a whole.
    pub kept: &'a [Range<usize>],
}

/// Like [`strip_png_to`]. Poses of kept frames are pale, and a line below each row marks their time. With waypoints,
/// the first motion and its waypoints are shown from above at the bottom.
///
/// # Errors
/// As [`strip_png_to`].
pub fn strip_png_along_to(
    motions: &[(String, Vec<f32>)],
    poses: usize,
    skeleton: &Skeleton,
    Given { waypoints, kept }: Given<'_>,
    out: impl Write,
) -> io::Result<()> {
    const ROW: usize = 210;
    let below = if waypoints.is_empty() { 0 } else { plan::HEIGHT };
    let (width, height) = (CELL * poses + 24, ROW * motions.len() + below);
    let mut canvas = Canvas::new(width, height, PAPER);
    for (row, (name, joints)) in motions.iter().enumerate() {
        let frames = frames_of(joints, skeleton)?;
        let top = (row * ROW) as f64;
        font::draw(&mut canvas, name, [12.0, top + 8.0], 2, INK);
        for column in 0..poses {
            let t = column * (frames - 1) / poses.saturating_sub(1).max(1);
            let pose = frame(joints, skeleton, t);
            let view = View {
                scale: 78.0,
                centre: [12.0 + CELL as f64 * (column as f64 + 0.5), top + 126.0],
                looking_at: [pose[0][0], 0.85, pose[0][2]],
            };
            let floor = |dx: f64, dz: f64| view.project([pose[0][0] + dx, 0.0, pose[0][2] + dz]).0;
            for (a, b) in [
                ((-0.5, -0.5), (0.5, -0.5)),
                ((0.5, -0.5), (0.5, 0.5)),
                ((0.5, 0.5), (-0.5, 0.5)),
                ((-0.5, 0.5), (-0.5, -0.5)),
            ] {
                canvas.line(floor(a.0, a.1), floor(b.0, b.1), 1.0, GRID);
            }
            let stayed = kept.iter().any(|span| span.contains(&t));
            figure(&mut canvas, &view, skeleton, &pose, if stayed { 0.4 } else { 1.0 });
        }
        timeline(&mut canvas, top + ROW as f64, (frames, poses), kept);
    }
    if let (Some((_, joints)), true) = (motions.first(), below > 0) {
        let at = |t: usize, joint: usize| frame(joints, skeleton, t)[joint];
        let frames = frames_of(joints, skeleton)?;
        plan::draw(&mut canvas, (ROW * motions.len()) as f64, (frames, &at), waypoints);
    }
    let mut encoder = png::Encoder::new(out, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let failed = |e: png::EncodingError| io::Error::other(e.to_string());
    encoder.write_header().and_then(|mut w| w.write_image_data(canvas.bytes())).map_err(failed)
}

/// Pixels between the poses of a sheet.
const CELL: usize = 110;

/// Draws a line above `bottom` that marks the kept and the generated frames of a row; nothing without kept frames.
fn timeline(canvas: &mut Canvas, bottom: f64, (frames, poses): (usize, usize), kept: &[Range<usize>]) {
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
        font::draw(canvas, word, [x(from), bottom - 20.0], 1, if stayed(from) { BODY } else { TOLD });
        from = to;
    }
}

/// Writes a PNG with [`strip_png_to`] to a file.
///
/// # Errors
/// If the file cannot be written, or a motion is not a whole number of frames.
pub fn strip_png(motions: &[(String, Vec<f32>)], poses: usize, skeleton: &Skeleton, path: &Path) -> io::Result<()> {
    strip_png_along(motions, poses, skeleton, Given::default(), path)
}

/// Writes a PNG with [`strip_png_along_to`] to a file.
///
/// # Errors
/// As [`strip_png`].
pub fn strip_png_along(
    motions: &[(String, Vec<f32>)],
    poses: usize,
    skeleton: &Skeleton,
    given: Given<'_>,
    path: &Path,
) -> io::Result<()> {
    let mut file = BufWriter::new(File::create(path)?);
    strip_png_along_to(motions, poses, skeleton, given, &mut file)?;
    file.flush()
}
