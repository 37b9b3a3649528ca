//! A viewer for motions as one HTML file, which needs only a browser and no network.
//!
//! Each motion is a figure on a floor with a draggable camera. All figures share one time line that plays, stops and
//! can be scrubbed. The caption is above; left bones are blue and right ones orange; waypoints of the motion are shown.
//! `page.html#t=1.5` opens at that second, stopped.
//!
//! Layout of the file: captions and notes are text. Positions are in a block of JSON: per motion the bytes of
//! `T x J x 3` numbers of 16 bits (little-endian, base64), `step` and `origin`; a coordinate is
//! `origin + step * number` metres. `step` is [`STEP`], or larger for a motion wider than 6.5 m. So the error of a
//! coordinate is at most half a step.
//!
//! Captions come from untrusted users and files. They are escaped; control characters and marks that change the reading
//! direction are shown as their numbers. The page's policy allows only the script and the style with the given digests,
//! and no requests.

use std::io::{self, Write};

use data_encoding::BASE64;
use motion::waypoints::Waypoint;
use protocol::{Digest, printable};
use serde_json::{Value, json};

use crate::body::{Body, Side};

const START: &str = include_str!("html/page.js");
const STYLE: &str = include_str!("html/page.css");
const CONTROLS: &str = include_str!("html/controls.html");

/// Metres between neighbouring numbers.
pub const STEP: f64 = 1e-4;

/// Largest number of motions on a page.
pub const MOST_PANELS: usize = 512;

/// Largest number of coordinates on a page: 40 MB of text.
pub const MOST_COORDINATES: usize = 15_000_000;

/// Coordinates beyond this distance in metres are a mistake.
const FARTHEST: f64 = 1e4;

/// A motion on the page.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel<'a> {
    /// Text above the motion, such as its prompt; left out if it equals the title of page or section.
    pub caption: String,
    /// Text in small letters, such as model and seed.
    pub note: String,
    /// Body of the joints.
    pub body: &'a Body,
    /// Positions `[T, J, 3]` in the body's unit.
    pub joints: &'a [f32],
    /// Waypoints of the motion, in metres.
    pub waypoints: &'a [Waypoint],
}

/// A group of motions, side by side.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Section<'a> {
    /// Title above the motions; may be empty.
    pub title: String,
    /// Motions in reading order.
    pub panels: Vec<Panel<'a>>,
}

/// A page of the viewer.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Page<'a> {
    /// Heading of the page.
    pub title: String,
    /// Sections from top to bottom.
    pub sections: Vec<Section<'a>>,
}

/// A page that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// There is nothing to show.
    #[error("the page has no motions; expected at least one")]
    Empty,
    /// More than one page can hold.
    #[error(
        "the page has {panels} motions with {coordinates} coordinates; expected at most {MOST_PANELS} with \
         {MOST_COORDINATES}"
    )]
    TooMuch {
        /// Number of motions.
        panels: usize,
        /// Number of their coordinates.
        coordinates: usize,
    },
    /// The array is not a whole number of frames, or empty.
    #[error("motion {panel} has {values} coordinates; expected frames of {joints} joints x 3")]
    Shape {
        /// Number of the motion, from 1.
        panel: usize,
        /// Number of coordinates.
        values: usize,
        /// Number of joints J.
        joints: usize,
    },
    /// A value is not finite, or too far away.
    #[error("frame {frame} of motion {panel} has a coordinate of {value} m; expected less than 10 km")]
    NotFinite {
        /// Number of the motion, from 1.
        panel: usize,
        /// Number of the frame, from 0.
        frame: usize,
        /// The invalid value.
        value: f64,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Io(#[from] io::Error),
}

impl Page<'_> {
    /// Writes the page as one HTML file.
    ///
    /// # Errors
    /// If joints are no motion, exceed the limits of a page, or the file cannot be written.
    pub fn write(&self, mut out: impl Write) -> Result<(), PageError> {
        let panels = || self.sections.iter().flat_map(|section| &section.panels);
        let (count, coordinates) = (panels().count(), panels().map(|panel| panel.joints.len()).sum());
        if count == 0 {
            return Err(PageError::Empty);
        }
        if count > MOST_PANELS || coordinates > MOST_COORDINATES {
            return Err(PageError::TooMuch { panels: count, coordinates });
        }
        let data = packed(panels())?;
        // Every `<` is escaped, so that nothing in the block can end it.
        let data = data.to_string().replace('<', "\\u003c");
        self.head(&mut out)?;
        self.figures(&mut out)?;
        out.write_all(CONTROLS.as_bytes())?;
        writeln!(out, "<script type=\"application/json\" id=\"motions\">{data}</script>")?;
        writeln!(out, "<script type=\"module\">{}</script>\n</body>\n</html>", script())?;
        out.flush()?;
        Ok(())
    }

    fn head(&self, out: &mut impl Write) -> io::Result<()> {
        let digest = |text: &str| BASE64.encode(Digest::of(text.as_bytes()).as_bytes());
        let title = text(&self.title);
        let style = style();
        let script = script();
        write!(
            out,
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'sha256-{}'; style-src 'sha256-{}'; \
             img-src data:; base-uri 'none'; form-action 'none'\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<meta name=\"color-scheme\" content=\"light dark\">\n\
             <link rel=\"icon\" href=\"data:,\">\n<title>{title}</title>\n<style>{style}</style>\n</head>\n<body class=\"viewer\">\n\
             <header><h1 dir=\"auto\">{title}</h1></header>\n",
            digest(&script),
            digest(&style),
        )
    }

    fn figures(&self, out: &mut impl Write) -> io::Result<()> {
        let mut number = 0;
        writeln!(out, "<main>")?;
        for section in &self.sections {
            writeln!(out, "<section>")?;
            if !section.title.is_empty() {
                writeln!(out, "<h2 dir=\"auto\">{}</h2>", text(&section.title))?;
            }
            writeln!(out, "<div class=\"row\">")?;
            for panel in &section.panels {
                // Text that is already above is not repeated.
                let said = panel.caption == self.title || panel.caption == section.title;
                let caption = if said { String::new() } else { text(&panel.caption) };
                let note = text(&panel.note);
                let frames = panel.joints.len() / (3 * panel.body.joints());
                let fps = panel.body.fps;
                writeln!(
                    out,
                    "<figure><figcaption id=\"c{number}\"><span dir=\"auto\">{caption}</span><small dir=\"auto\">{note}</small>\
                     <small>{frames} frames at {fps} fps</small></figcaption>\
                     <canvas class=\"figure\" tabindex=\"0\" role=\"img\" aria-labelledby=\"c{number}\"></canvas></figure>"
                )?;
                number += 1;
            }
            writeln!(out, "</div>\n</section>")?;
        }
        writeln!(out, "</main>")
    }
}

/// Motions as the viewer reads them, without their captions.
///
/// # Errors
/// If joints are no motion, or too far away.
pub fn packed<'a>(panels: impl IntoIterator<Item = &'a Panel<'a>>) -> Result<Value, PageError> {
    let mut bodies: Vec<&Body> = Vec::new();
    let mut motions = Vec::new();
    for (i, panel) in panels.into_iter().enumerate() {
        let known = bodies.iter().position(|body| *body == panel.body);
        let body = known.unwrap_or_else(|| {
            bodies.push(panel.body);
            bodies.len() - 1
        });
        motions.push(motion(i + 1, panel, body)?);
    }
    Ok(json!({"bodies": bodies.into_iter().map(describe).collect::<Vec<_>>(), "motions": motions}))
}

/// The viewer, and the lines that start it here.
fn script() -> String {
    format!("{}{START}", page::VIEWER)
}

/// The style of the page and of the viewer's figures.
fn style() -> String {
    format!("{STYLE}{}", page::VIEWER_STYLE)
}

/// Escapes untrusted text for an element.
fn text(untrusted: &str) -> String {
    let mut escaped = String::with_capacity(untrusted.len());
    for c in printable(untrusted).chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            c => escaped.push(c),
        }
    }
    escaped
}

/// A body in the script's form.
fn describe(body: &Body) -> Value {
    let letter = |side: &Side| match side {
        Side::Middle => 'm',
        Side::Left => 'l',
        Side::Right => 'r',
    };
    json!({
        "parents": body.parents,
        "sides": body.sides.iter().map(letter).collect::<String>(),
        "head": body.head,
    })
}

/// Positions in steps, and the waypoints of the motion.
fn motion(number: usize, panel: &Panel<'_>, body: usize) -> Result<Value, PageError> {
    let Panel { joints, body: Body { fps, metres_per_unit, .. }, .. } = panel;
    let width = 3 * panel.body.joints();
    if width == 0 || joints.is_empty() || !joints.len().is_multiple_of(width) {
        return Err(PageError::Shape { panel: number, values: joints.len(), joints: panel.body.joints() });
    }
    let metres = |v: f32| f64::from(v) * metres_per_unit;
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
    for (at, value) in joints.iter().enumerate() {
        let value = metres(*value);
        if value.is_nan() || value.abs() > FARTHEST {
            return Err(PageError::NotFinite { panel: number, frame: at / width, value });
        }
        let [low, high] = &mut bounds[at % 3];
        (*low, *high) = (low.min(value), high.max(value));
    }
    let origin = bounds.map(|[low, high]| (low + high) / 2.0);
    let reach = bounds.iter().map(|[low, high]| (high - low) / 2.0).fold(0.0, f64::max);
    let step = STEP.max(reach / f64::from(i16::MAX));
    #[expect(clippy::cast_possible_truncation, reason = "a step is so large that the farthest has the largest number")]
    let number_of = |(at, v): (usize, &f32)| ((metres(*v) - origin[at % 3]) / step).round() as i16;
    let bytes: Vec<u8> = joints.iter().enumerate().map(number_of).flat_map(i16::to_le_bytes).collect();
    let told = panel.waypoints.iter().map(|w| json!([w.frame, w.joint, w.position[0], w.position[1], w.position[2]]));
    Ok(json!({
        "body": body,
        "fps": fps,
        "frames": joints.len() / width,
        "step": step,
        "origin": origin,
        "joints": BASE64.encode(&bytes),
        "waypoints": told.collect::<Vec<_>>(),
    }))
}
