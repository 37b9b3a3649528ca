//! Text in Inter, an open font whose letters are outlines. A letter that it lacks is an empty box.

use std::sync::LazyLock;

use tiny_skia::PathBuilder;
use ttf_parser::{Face, GlyphId, OutlineBuilder};

use super::raster::{Canvas, Colour};

/// Height of the letters of titles, notes and small labels in pixels.
pub(super) const TITLE: f64 = 17.0;
pub(super) const NOTE: f64 = 13.0;
pub(super) const SMALL: f64 = 11.5;

/// The font; `trainer/motion/font/README.md` says how it was made.
static BYTES: &[u8] = include_bytes!("../../font/Inter-Regular.ttf");
#[expect(clippy::expect_used, reason = "the font is part of the program, and a test draws with it")]
static FACE: LazyLock<Face<'static>> = LazyLock::new(|| Face::parse(BYTES, 0).expect("a font"));

/// Outlines of letters at a place, with y down.
struct Outline {
    path: PathBuilder,
    at: [f32; 2],
    scale: f32,
}

impl Outline {
    fn place(&self, x: f32, y: f32) -> (f32, f32) {
        (self.at[0] + self.scale * x, self.at[1] - self.scale * y)
    }
}

impl OutlineBuilder for Outline {
    fn move_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.place(x, y);
        self.path.move_to(x, y);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.place(x, y);
        self.path.line_to(x, y);
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        let ((x1, y1), (x, y)) = (self.place(x1, y1), self.place(x, y));
        self.path.quad_to(x1, y1, x, y);
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let ((x1, y1), (x2, y2), (x, y)) = (self.place(x1, y1), self.place(x2, y2), self.place(x, y));
        self.path.cubic_to(x1, y1, x2, y2, x, y);
    }

    fn close(&mut self) {
        self.path.close();
    }
}

fn scale(size: f64) -> f64 {
    size / f64::from(FACE.units_per_em())
}

/// Glyphs of a text with the advance of each in the font's units.
fn glyphs(text: &str) -> impl Iterator<Item = (GlyphId, f64)> + '_ {
    text.chars().map(|c| {
        let glyph = FACE.glyph_index(c).unwrap_or(GlyphId(0));
        (glyph, f64::from(FACE.glyph_hor_advance(glyph).unwrap_or(0)))
    })
}

/// Width of a text in pixels, at letters of `size` pixels.
pub(super) fn width(text: &str, size: f64) -> f64 {
    glyphs(text).map(|(_, advance)| advance).sum::<f64>() * scale(size)
}

/// Draws a line of text with its upper left corner at `at`, in letters of `size` pixels. Returns its width.
pub(super) fn draw(canvas: &mut Canvas, text: &str, at: [f64; 2], size: f64, colour: Colour) -> f64 {
    let baseline = at[1] + f64::from(FACE.ascender()) * scale(size);
    let place = [at[0] as f32, baseline as f32];
    let mut outline = Outline { path: PathBuilder::new(), at: place, scale: scale(size) as f32 };
    for (glyph, advance) in glyphs(text) {
        FACE.outline_glyph(glyph, &mut outline);
        outline.at[0] += (advance * scale(size)) as f32;
    }
    if let Some(path) = outline.path.finish() {
        canvas.fill(&path, colour);
    }
    f64::from(outline.at[0]) - at[0]
}

/// Shortens a text to `most` pixels, with `…` at its end if something is missing.
pub(super) fn fit(text: &str, size: f64, most: f64) -> String {
    if width(text, size) <= most {
        return text.to_owned();
    }
    let mut shown: String = text.to_owned();
    while !shown.is_empty() && width(&shown, size) + width("…", size) > most {
        shown.pop();
    }
    format!("{}…", shown.trim_end())
}

/// Breaks a text at spaces into lines of at most `most` pixels; a longer word has a line of its own.
pub(super) fn wrap(text: &str, size: f64, most: f64) -> Vec<String> {
    let mut lines: Vec<String> = vec![];
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if width(&format!("{line} {word}"), size) <= most => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_have_their_own_widths_and_shapes() {
        assert!(width("iiii", 16.0) < width("mmmm", 16.0));
        assert_eq!(wrap("a person walks", 16.0, width("a person", 16.0) + 1.0), ["a person", "walks"]);
        let short = fit("a person walks in a circle", 16.0, 100.0);
        assert!(short.ends_with('…') && width(&short, 16.0) <= 100.0, "{short}");
        assert_eq!(fit("short", 16.0, 100.0), "short");
        let drawn = |text: &str| {
            let mut canvas = Canvas::new(40, 40, [255; 3]);
            draw(&mut canvas, text, [4.0, 4.0], 24.0, [0; 3]);
            canvas.bytes()
        };
        for (one, other) in [("p", "P"), ("q", "9"), ("g", "q"), ("é", "e"), ("\u{4e00}", "a")] {
            assert_ne!(drawn(one), drawn(other), "{one} {other}");
        }
        let grey = drawn("o").iter().filter(|value| (1..255).contains(*value)).count();
        assert!(grey > 100, "{grey} values between paper and ink: edges are smooth");
        assert!("ąłżΩж×°–…".chars().all(|c| FACE.glyph_index(c).is_some()), "the font has letters of many languages");
    }
}
