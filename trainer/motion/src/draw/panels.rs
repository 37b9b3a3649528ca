//! Several motions beside each other in one animated GIF, each with a camera of its own.
//!
//! Every second frame is drawn. A pixel that stays as it was is not stored again, so a camera moves only with a motion
//! that leaves its place.

use std::io::{self, Write};

use super::colours::{BODY, FAINT, GRID, INK, LEFT, PAPER, RIGHT, SHADOW, TRAIL};
use super::font::{self, SMALL};
use super::raster::{self, Canvas};
use super::{Row, View, figure, follow, frame, frames_of, ground};
use crate::skeleton::Skeleton;

/// Width and height of a panel in pixels.
const PANEL: [usize; 2] = [194, 182];
/// Panels beside each other.
const COLUMNS: usize = 3;
/// Frames of a motion for one frame of the picture.
const STRIDE: usize = 2;
/// A motion whose root stays within this distance of its mean has a fixed camera, metres.
const AT_PLACE: f64 = 0.45;
/// Delay after the last frame, hundredths of a second.
const PAUSE: u16 = 80;

/// Writes an animated GIF of all motions at their own speed, in rows of three. A shorter motion waits in its last
/// pose for the longest.
///
/// # Errors
/// If `out` fails, there is no motion, or one is not a whole number of frames.
pub fn gif_of_all_to(rows: &[Row], skeleton: &Skeleton, out: impl Write) -> io::Result<()> {
    let panels: Vec<Panel<'_>> = rows.iter().map(|row| Panel::of(row, skeleton)).collect::<io::Result<_>>()?;
    let Some(longest) = panels.iter().map(|panel| panel.path.len()).max() else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "there is no motion to draw"));
    };
    let columns = rows.len().min(COLUMNS);
    let width = PANEL[0] * columns;
    let height = PANEL[1] * rows.len().div_ceil(columns);
    let palette = raster::palette(&[PAPER, INK, GRID, TRAIL, SHADOW, BODY, LEFT, RIGHT]);
    let same = palette.unused();
    let failed = |e: gif::EncodingError| io::Error::other(e.to_string());
    let mut encoder = gif::Encoder::new(out, width as u16, height as u16, &palette.bytes).map_err(failed)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
    let mut before: Vec<u8> = Vec::new();
    for t in (0..longest).step_by(STRIDE) {
        let mut canvas = Canvas::new(width, height, PAPER);
        for (i, panel) in panels.iter().enumerate() {
            canvas.place(&panel.draw(skeleton, t), [PANEL[0] * (i % columns), PANEL[1] * (i / columns)]);
        }
        let now = palette.indices(&canvas);
        let stays = |i: usize, pixel: u8| before.get(i) == Some(&pixel);
        let changed: Vec<u8> =
            now.iter().enumerate().map(|(i, pixel)| if stays(i, *pixel) { same } else { *pixel }).collect();
        let mut image = gif::Frame::from_indexed_pixels(width as u16, height as u16, changed, Some(same));
        image.dispose = gif::DisposalMethod::Keep;
        let ends = |t: usize| (t as f64 * 100.0 / skeleton.fps).round() as u16;
        image.delay = if t + STRIDE >= longest { PAUSE } else { ends(t + STRIDE).wrapping_sub(ends(t)) };
        encoder.write_frame(&image).map_err(failed)?;
        before = now;
    }
    Ok(())
}

struct Panel<'a> {
    row: &'a Row,
    /// Positions of the root.
    path: Vec<[f64; 3]>,
    /// Mean position of the root, if the camera is fixed there.
    fixed: Option<[f64; 2]>,
}

impl<'a> Panel<'a> {
    fn of(row: &'a Row, skeleton: &Skeleton) -> io::Result<Self> {
        let frames = frames_of(&row.joints, skeleton)?;
        let path: Vec<[f64; 3]> = (0..frames).map(|t| frame(&row.joints, skeleton, t)[0]).collect();
        let mean = [0, 2].map(|axis| path.iter().map(|p| p[axis]).sum::<f64>() / frames as f64);
        let stays = path.iter().all(|p| (p[0] - mean[0]).hypot(p[2] - mean[1]) <= AT_PLACE);
        Ok(Self { row, path, fixed: stays.then_some(mean) })
    }

    fn draw(&self, skeleton: &Skeleton, t: usize) -> Canvas {
        let [width, height] = PANEL;
        let t = t.min(self.path.len() - 1);
        let [x, z] = self.fixed.unwrap_or_else(|| [follow(&self.path, t, 0), follow(&self.path, t, 2)]);
        let centre = [width as f64 / 2.0, height as f64 * 0.57];
        let view = View { scale: 70.0, centre, looking_at: [x, 0.80, z] };
        let mut canvas = Canvas::new(width, height, PAPER);
        ground(&mut canvas, &view, 1.5);
        canvas.lines(self.path[..=t].iter().map(|p| view.project([p[0], 0.0, p[2]]).0), 2.0, TRAIL);
        figure(&mut canvas, &view, skeleton, &frame(&self.row.joints, skeleton, t), 1.0);
        let wide = width as f64 - 10.0;
        font::draw(&mut canvas, &font::fit(&self.row.title, SMALL, wide), [5.0, 5.0], SMALL, INK);
        font::draw(&mut canvas, &font::fit(&self.row.note, SMALL, wide), [5.0, height as f64 - 19.0], SMALL, FAINT);
        canvas
    }
}
