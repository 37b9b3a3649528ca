//! The viewer in a real browser. Two times give two pictures that differ in the figures, in the clock and its slider,
//! and nowhere else. The page requests nothing but the file, and it plays by itself.

use std::fs::File;
use std::io::Cursor;
use std::path::Path;
use std::time::Instant;

use browser::{Browser, DRAWN, PATIENCE, Window};
use mocap::Body;
use mocap::html::{Page, Panel, Section};
use motion::{Skeleton, features, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};

/// Size of the window in pixels.
const WINDOW: [usize; 2] = [900, 1200];

/// The window's pixels at a time, `[height, width, 3]`.
fn picture(browser: &mut Browser, seconds: f64) -> Vec<u8> {
    browser.evaluate(&format!("location.hash = '#t={seconds}'"));
    // The address changes first, and the page is notified.
    browser.until(&format!("document.querySelector('.clock').textContent.startsWith('{seconds:.2} of ')"));
    browser.evaluate(DRAWN);
    let mut reader = png::Decoder::new(Cursor::new(browser.screenshot())).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a small picture")];
    let info = reader.next_frame(&mut pixels).expect("a PNG");
    assert_eq!([info.width as usize, info.height as usize], WINDOW);
    let channels = info.color_type.samples();
    pixels.chunks_exact(channels).flat_map(|pixel| pixel[..3].iter().copied()).collect()
}

/// A page with a moving figure beside a standing one.
fn page(file: &Path) {
    let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(3));
    let joints = features::recover_joints(&dataset.clips[0].features, dataset.skeleton());
    assert!(joints.len() > 40 * 66, "longer than two seconds");
    let still = joints[..66].repeat(joints.len() / 66);
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let panel = |caption: &str, joints| Panel {
        caption: caption.into(),
        note: String::new(),
        body: &body,
        joints,
        waypoints: &[],
    };
    let sections =
        vec![Section { title: String::new(), panels: vec![panel("moves", &joints), panel("stands", &still)] }];
    let page = Page { title: "two figures".into(), sections };
    page.write(File::create(file).expect("a file of ours")).expect("a page");
}

#[test]
fn a_figure_moves_and_nothing_else_does() {
    let Some(program) = browser::program() else {
        fixtures::skip(browser::MISSING);
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("page.html");
    page(&file);
    let mut browser = Browser::start(&program, folder.path());
    let url = format!("file://{}#t=0.5", file.display());
    browser.open(&url, Window { width: WINDOW[0], height: WINDOW[1], mobile: false });
    let canvases = browser.places("canvas.figure");
    let [moves, stands] = canvases[..] else { panic!("two figures, not {canvases:?}") };
    let controls = browser.places(".time, .clock, .strip");
    assert!(controls.iter().all(|place| place[3] <= WINDOW[1] as f64), "all is in the window: {controls:?}");
    // The first picture may show a button that is still being drawn.
    picture(&mut browser, 1.0);
    let (one, other) = (picture(&mut browser, 0.5), picture(&mut browser, 1.5));
    assert!(one == picture(&mut browser, 0.5), "a time has one picture");

    let within = |[left, top, right, bottom]: [f64; 4], x: f64, y: f64| {
        left <= x + 1.0 && x <= right && top <= y + 1.0 && y <= bottom
    };
    let (mut in_figure, mut in_still, mut in_controls, mut elsewhere) = (0, 0, 0, Vec::new());
    for (at, (a, b)) in one.chunks_exact(3).zip(other.chunks_exact(3)).enumerate() {
        let (x, y) = ((at % WINDOW[0]) as f64, (at / WINDOW[0]) as f64);
        match a == b {
            true => {}
            // The strip of a figure begins where the figure ends.
            false if controls.iter().any(|place| within(*place, x, y)) => in_controls += 1,
            false if within(moves, x, y) => in_figure += 1,
            false if within(stands, x, y) => in_still += 1,
            false => elsewhere.push((x, y)),
        }
    }
    eprintln!("{in_figure} pixels of the figure differ, {in_controls} of clock and slider");
    assert!(in_figure > 300, "the figure moves: {in_figure} pixels");
    assert_eq!(in_still, 0, "the other one stands");
    assert!(in_controls > 0, "the clock goes");
    assert!(elsewhere.is_empty(), "{} pixels differ elsewhere, such as {:?}", elsewhere.len(), elsewhere.first());

    // Two figures have at least two colours: a blank page would also have no other differences.
    let colours: std::collections::BTreeSet<&[u8]> = one.chunks_exact(3).collect();
    assert!(colours.len() > 20, "{} colours", colours.len());

    let clock = |browser: &mut Browser| {
        browser.evaluate(&format!("{DRAWN}.then(() => document.querySelector('.clock').textContent)"))
    };
    browser.evaluate("document.querySelector('.play').click()");
    let (before, since) = (clock(&mut browser), Instant::now());
    while clock(&mut browser) == before {
        assert!(since.elapsed() < PATIENCE, "it plays");
    }

    let asked = browser.requested();
    // The empty icon is inside the page itself.
    let others: Vec<&&str> =
        asked.iter().filter(|asked| !url.starts_with(**asked) && !asked.starts_with("data:")).collect();
    assert!(others.is_empty() && asked.iter().any(|asked| url.starts_with(*asked)), "{asked:?}");
    let said = browser.complaints();
    assert!(said.is_empty(), "the browser complains: {said:?}");
}
