//! A motion from above with its waypoints. z points up the page, so x points left; a cell of the grid is half a metre.

use super::colours::{GRID, INK, TOLD};
use super::font;
use super::raster::Canvas;
use crate::waypoints::Waypoint;

/// Height of the plan in pixels.
pub(super) const HEIGHT: usize = 380;
/// Margin at the edges in pixels.
const MARGIN: f64 = 34.0;
/// Metres between lines of the grid.
const STEP: f64 = 0.5;
/// Smallest extent of the plan, metres.
const LEAST: f64 = 1.0;

/// Draws below `top`: waypoints as discs, a line from each to its joint at its frame, and the paths of the joints with
/// waypoints. The motion is given as its number of frames and a joint's position in a frame, in metres.
pub(super) fn draw(
    canvas: &mut Canvas,
    top: f64,
    (frames, motion): (usize, &dyn Fn(usize, usize) -> [f64; 3]),
    waypoints: &[Waypoint],
) {
    let mut told: Vec<usize> = waypoints.iter().map(|w| w.joint).collect();
    told.sort_unstable();
    told.dedup();
    let at = |t: usize, joint: usize| {
        let [x, _, z] = motion(t, joint);
        [x, z]
    };
    let courses: Vec<Vec<[f64; 2]>> = told.iter().map(|j| (0..frames).map(|t| at(t, *j)).collect()).collect();
    let ends = |w: &Waypoint| [f64::from(w.position[0]), f64::from(w.position[2])];
    let all = || courses.iter().flatten().copied().chain(waypoints.iter().map(ends));
    let bounds = [0, 1].map(|axis| {
        let (low, high) = all().fold((f64::MAX, f64::MIN), |(low, high), p| (low.min(p[axis]), high.max(p[axis])));
        let (middle, half) = ((low + high) / 2.0, ((high - low) / 2.0).max(LEAST / 2.0));
        [middle - half, middle + half]
    });
    let (width, height) = (canvas.width as f64 - 2.0 * MARGIN, HEIGHT as f64 - 2.0 * MARGIN);
    let extent = |axis: usize| bounds[axis][1] - bounds[axis][0];
    let scale = (width / extent(0)).min(height / extent(1));
    let middle = [0, 1].map(|axis| (bounds[axis][0] + bounds[axis][1]) / 2.0);
    let (cx, cy) = (MARGIN + width / 2.0, top + MARGIN + height / 2.0);
    let pixel = |[x, z]: [f64; 2]| [cx - scale * (x - middle[0]), cy - scale * (z - middle[1])];

    for (axis, [low, high]) in bounds.into_iter().enumerate() {
        let (first, last) = ((low / STEP).ceil() as i64, (high / STEP).floor() as i64);
        for k in first..=last {
            let value = k as f64 * STEP;
            let along = |other: f64| if axis == 0 { [value, other] } else { [other, value] };
            let [from, to] = bounds[1 - axis];
            canvas.line(pixel(along(from)), pixel(along(to)), 1.0, GRID);
        }
    }
    for course in &courses {
        for pair in course.windows(2) {
            canvas.line(pixel(pair[0]), pixel(pair[1]), 2.5, INK);
        }
    }
    for waypoint in waypoints {
        let to = pixel(ends(waypoint));
        if waypoint.frame < frames {
            canvas.line(to, pixel(at(waypoint.frame, waypoint.joint)), 1.5, TOLD);
        }
        canvas.disc(to, 5.0, TOLD);
    }
    let label = "from above: path (discs), motion (line), a cell is 0.5 m";
    font::draw(canvas, label, [12.0, top + 8.0], 1, INK);
}
