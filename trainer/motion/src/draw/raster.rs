//! Anti-aliased lines, discs and outlines on an RGB canvas, and the palette of a GIF.

use tiny_skia::{FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, PixmapPaint, Stroke, Transform};

/// Red, green and blue, 0 to 255.
pub(super) type Colour = [u8; 3];

/// Mixes `share` of `over` with the rest of `under`.
pub(super) fn blend(under: Colour, over: Colour, share: f64) -> Colour {
    std::array::from_fn(|k| (f64::from(under[k]) + (f64::from(over[k]) - f64::from(under[k])) * share).round() as u8)
}

pub(super) struct Canvas {
    pub(super) width: usize,
    pixels: Pixmap,
}

fn paint(colour: Colour) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color_rgba8(colour[0], colour[1], colour[2], 255);
    paint
}

impl Canvas {
    /// Makes a canvas of at least one pixel.
    ///
    /// # Panics
    /// If the canvas exceeds the address space.
    #[expect(clippy::expect_used, reason = "sizes are those of sheets, far below the limit")]
    pub(super) fn new(width: usize, height: usize, paper: Colour) -> Self {
        let mut pixels = Pixmap::new(width.max(1) as u32, height.max(1) as u32).expect("a canvas of this size");
        pixels.fill(tiny_skia::Color::from_rgba8(paper[0], paper[1], paper[2], 255));
        Self { width, pixels }
    }

    /// Copies a smaller canvas with its upper left corner to `at`.
    pub(super) fn place(&mut self, other: &Self, at: [usize; 2]) {
        let [x, y] = at.map(|pixels| pixels as i32);
        let paint = PixmapPaint::default();
        self.pixels.draw_pixmap(x, y, other.pixels.as_ref(), &paint, Transform::identity(), None);
    }

    fn colours(&self) -> impl Iterator<Item = Colour> + '_ {
        // Every pixel is opaque, so its colour is not multiplied by anything.
        self.pixels.pixels().iter().map(|pixel| [pixel.red(), pixel.green(), pixel.blue()])
    }

    /// Red, green and blue of each pixel.
    pub(super) fn bytes(&self) -> Vec<u8> {
        self.colours().flatten().collect()
    }

    /// Draws a line through points, with round ends and corners.
    pub(super) fn lines(&mut self, points: impl IntoIterator<Item = [f64; 2]>, width: f64, colour: Colour) {
        let mut path = PathBuilder::new();
        for [x, y] in points {
            match path.is_empty() {
                true => path.move_to(x as f32, y as f32),
                false => path.line_to(x as f32, y as f32),
            }
        }
        let stroke =
            Stroke { width: width as f32, line_cap: LineCap::Round, line_join: LineJoin::Round, ..Stroke::default() };
        // A path without extent is not drawn.
        if let Some(path) = path.finish() {
            self.pixels.stroke_path(&path, &paint(colour), &stroke, Transform::identity(), None);
        }
    }

    /// Draws a line with round ends.
    pub(super) fn line(&mut self, a: [f64; 2], b: [f64; 2], width: f64, colour: Colour) {
        self.lines([a, b], width, colour);
    }

    pub(super) fn disc(&mut self, at: [f64; 2], radius: f64, colour: Colour) {
        if let Some(path) = PathBuilder::from_circle(at[0] as f32, at[1] as f32, radius as f32) {
            self.fill(&path, colour);
        }
    }

    /// Fills the inside of a path.
    pub(super) fn fill(&mut self, path: &Path, colour: Colour) {
        self.pixels.fill_path(path, &paint(colour), FillRule::Winding, Transform::identity(), None);
    }
}

/// A fixed palette: every mixture of two of the given colours in a few steps, for anti-aliased edges.
pub(super) struct Palette {
    pub(super) bytes: Vec<u8>,
    /// Nearest entry by colour, 5 bits per channel.
    nearest: Vec<u8>,
}

pub(super) fn palette(colours: &[Colour]) -> Palette {
    let mut entries: Vec<Colour> = vec![];
    let mut add = |c: Colour| {
        if entries.len() < 256 && !entries.contains(&c) {
            entries.push(c);
        }
    };
    colours.iter().for_each(|c| add(*c));
    for (i, a) in colours.iter().enumerate() {
        for b in &colours[i + 1..] {
            (1..8).for_each(|k| add(blend(*a, *b, f64::from(k) / 8.0)));
        }
    }
    let nearest = (0..1_usize << 15)
        .map(|key| {
            let c = [key >> 10, (key >> 5) & 31, key & 31].map(|v| (v * 8 + 4) as i32);
            let distance = |e: &Colour| (0..3).map(|k| (i32::from(e[k]) - c[k]).pow(2)).sum::<i32>();
            (0..entries.len()).min_by_key(|i| distance(&entries[*i])).unwrap_or(0) as u8
        })
        .collect();
    Palette { bytes: entries.into_flattened(), nearest }
}

impl Palette {
    /// An index that no pixel has, for pixels that stay as they were. The palette must be smaller than 256 colours.
    pub(super) fn unused(&self) -> u8 {
        (self.bytes.len() / 3).min(255) as u8
    }

    pub(super) fn indices(&self, canvas: &Canvas) -> Vec<u8> {
        let key = |c: Colour| usize::from(c[0] >> 3) << 10 | usize::from(c[1] >> 3) << 5 | usize::from(c[2] >> 3);
        canvas.colours().map(|c| self.nearest[key(c)]).collect()
    }
}
