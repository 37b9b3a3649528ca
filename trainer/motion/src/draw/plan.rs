//! Motions from above. z points up the page, so x points left.

use super::colours::{GRID, INK, PAPER, TOLD, TRAIL};
use super::font::{self, SMALL};
use super::raster::Canvas;
use crate::waypoints::Waypoint;

/// Height of the plan in pixels.
pub(super) const HEIGHT: usize = 380;
/// Margin at the edges in pixels.
const MARGIN: f64 = 34.0;
/// Smallest extent of a plan, metres.
const LEAST: f64 = 1.0;

/// A part of the floor on a part of the canvas.
struct Floor {
    /// Lowest and highest x and z, metres.
    bounds: [[f64; 2]; 2],
    /// Pixel of the middle of the bounds.
    centre: [f64; 2],
    /// Pixels per metre.
    scale: f64,
}

impl Floor {
    /// Shows all of the places in a box around `centre`, `size` wide and high.
    fn around(places: impl Iterator<Item = [f64; 2]> + Clone, centre: [f64; 2], size: [f64; 2]) -> Self {
        let bounds = [0, 1].map(|axis| {
            let range = |(low, high): (f64, f64), p: [f64; 2]| (low.min(p[axis]), high.max(p[axis]));
            let (low, high) = places.clone().fold((f64::MAX, f64::MIN), range);
            let middle = (low + high) / 2.0;
            let half = ((high - low) / 2.0).max(LEAST / 2.0);
            [middle - half, middle + half]
        });
        let extent = |axis: usize| bounds[axis][1] - bounds[axis][0];
        let scale = (size[0] / extent(0)).min(size[1] / extent(1));
        // The floor fills the box.
        let bounds = [0, 1].map(|axis| {
            let middle = (bounds[axis][0] + bounds[axis][1]) / 2.0;
            let half = size[axis] / scale / 2.0;
            [middle - half, middle + half]
        });
        Self { bounds, centre, scale }
    }

    fn pixel(&self, [x, z]: [f64; 2]) -> [f64; 2] {
        let middle = self.bounds.map(|[low, high]| (low + high) / 2.0);
        [self.centre[0] - self.scale * (x - middle[0]), self.centre[1] - self.scale * (z - middle[1])]
    }

    /// Draws lines between cells. Returns the size of a cell in metres.
    fn grid(&self, canvas: &mut Canvas) -> f64 {
        let step = [0.5, 1.0, 2.0, 5.0].into_iter().find(|step| step * self.scale >= 14.0).unwrap_or(10.0);
        for (axis, [low, high]) in self.bounds.into_iter().enumerate() {
            let first = (low / step).ceil() as i64;
            let last = (high / step).floor() as i64;
            for k in first..=last {
                let value = k as f64 * step;
                let along = |other: f64| if axis == 0 { [value, other] } else { [other, value] };
                let [from, to] = self.bounds[1 - axis];
                canvas.line(self.pixel(along(from)), self.pixel(along(to)), 1.0, GRID);
            }
        }
        step
    }
}

/// Draws the way of a motion over the floor in a box of `size` pixels below `at`. A disc marks each second, a ring the
/// begin, and an arrow the end.
pub(super) fn trail(canvas: &mut Canvas, path: &[[f64; 2]], fps: f64, at: [f64; 2], size: f64) {
    let inner = size - 34.0;
    let centre = [at[0] + size / 2.0, at[1] + 12.0 + inner / 2.0];
    let floor = Floor::around(path.iter().copied(), centre, [inner, inner]);
    let cell = floor.grid(canvas);
    let way: Vec<[f64; 2]> = path.iter().map(|p| floor.pixel(*p)).collect();
    canvas.lines(way.iter().copied(), 2.5, TRAIL);
    let pace = (fps.round() as usize).max(1);
    for second in way.iter().step_by(pace).skip(1) {
        canvas.disc(*second, 2.5, INK);
    }
    if let Some(begin) = way.first() {
        canvas.disc(*begin, 5.0, INK);
        canvas.disc(*begin, 3.0, PAPER);
    }
    arrow(canvas, &way);
    let label = format!("from above, {cell} m a cell");
    let x = at[0] + (size - font::width(&label, SMALL)) / 2.0;
    font::draw(canvas, &label, [x, at[1] + size - 16.0], SMALL, INK);
}

/// Draws an arrow at the end of a way, along its last ten pixels; nothing if it is shorter.
fn arrow(canvas: &mut Canvas, way: &[[f64; 2]]) {
    let Some(end) = way.last() else { return };
    let Some(from) = way.iter().rev().find(|p| (p[0] - end[0]).hypot(p[1] - end[1]) >= 10.0) else { return };
    let angle = (end[1] - from[1]).atan2(end[0] - from[0]);
    let side = |turn: f64| [end[0] - 8.0 * (angle + turn).cos(), end[1] - 8.0 * (angle + turn).sin()];
    canvas.lines([side(0.5), *end, side(-0.5)], 2.5, INK);
}

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
    let all = courses.iter().flatten().copied().chain(waypoints.iter().map(ends));
    let size = [canvas.width as f64 - 2.0 * MARGIN, HEIGHT as f64 - 2.0 * MARGIN];
    let floor = Floor::around(all, [MARGIN + size[0] / 2.0, top + MARGIN + size[1] / 2.0], size);
    let cell = floor.grid(canvas);
    for course in &courses {
        canvas.lines(course.iter().map(|p| floor.pixel(*p)), 2.5, INK);
    }
    for waypoint in waypoints {
        let to = floor.pixel(ends(waypoint));
        if waypoint.frame < frames {
            canvas.line(to, floor.pixel(at(waypoint.frame, waypoint.joint)), 1.5, TOLD);
        }
        canvas.disc(to, 5.0, TOLD);
    }
    let label = format!("from above: targets (discs) and the motion (line), {cell} m a cell");
    font::draw(canvas, &label, [12.0, top + 8.0], SMALL, INK);
}
