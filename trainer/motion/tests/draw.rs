//! Pictures decode, have the motion's length, and show a figure in both colours.

use motion::draw::{Given, Row};
use motion::features::recover_joints;
use motion::{Skeleton, draw, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};

fn motion() -> (String, Vec<f32>) {
    let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(1));
    ("a person walks forward.".into(), recover_joints(&dataset.clips[0].features, dataset.skeleton()))
}

#[test]
fn a_gif_plays_as_long_as_the_motion() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let (title, joints) = motion();
    let mut bytes = vec![];
    draw::gif_along_to(&joints, skeleton, &title, &[], &mut bytes).unwrap();
    let mut decoder = gif::DecodeOptions::new();
    decoder.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = decoder.read_info(&bytes[..]).unwrap();
    let (mut frames, mut hundredths, mut blue, mut red) = (0, 0, 0, 0);
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        frames += 1;
        hundredths += usize::from(frame.delay);
        for p in frame.buffer.chunks(4).map(|p| [p[0], p[1], p[2]].map(i32::from)) {
            blue += usize::from(p[2] > p[0] + 100);
            red += usize::from(p[0] > p[2] + 100);
        }
    }
    assert_eq!(frames, joints.len() / 66);
    assert_eq!(hundredths, (frames - 1) * 5 + 60);
    assert!(blue > 100 * frames && red > 100 * frames, "{blue} and {red} pixels in {frames} frames");

    let mut film = vec![];
    draw::rgb_along_to(&joints[..10 * 66], skeleton, &title, &[], &mut film).unwrap();
    let size: usize = draw::FILM.iter().product();
    assert_eq!(film.len(), 3 * size * 10);
    let pictures: Vec<&[u8]> = film.chunks(3 * size).collect();
    assert!(pictures[0] != pictures[9], "the figure moves");
    let left = pictures[0].chunks(3).filter(|p| **p == [36, 110, 200]).count();
    assert!(left > 100, "{left} pixels of the left side");
}

/// Unchanged pixels are left out, so the picture is smaller than its motions' own, and as long as the longest.
#[test]
fn several_motions_play_beside_each_other() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let (title, joints) = motion();
    let short = Row { title: title.clone(), note: "short".into(), joints: joints[..20 * 66].to_vec() };
    let rows = [Row { title, note: "whole".into(), joints: joints.clone() }, short.clone(), short.clone(), short];
    let mut bytes = vec![];
    draw::gif_of_all_to(&rows, skeleton, &mut bytes).unwrap();
    let mut decoder = gif::DecodeOptions::new();
    decoder.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = decoder.read_info(&bytes[..]).unwrap();
    assert_eq!((decoder.width(), decoder.height()), (582, 364));
    let mut frames = 0;
    // Pixels of each panel that change after the first frame.
    let mut changed = [0; 4];
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        let opaque = frame.buffer.chunks(4).enumerate().filter(|(_, pixel)| pixel[3] > 0);
        for (i, _) in opaque.filter(|_| frames > 10) {
            let (x, y) = (i % 582, i / 582);
            changed[x / 194 + 3 * (y / 182)] += 1;
        }
        frames += 1;
    }
    assert_eq!(frames, (joints.len() / 66).div_ceil(2));
    assert!(changed[0] > 1000 && changed[1..] == [0; 3], "a short motion waits in its last pose: {changed:?}");
    assert!(draw::gif_of_all_to(&[], skeleton, vec![]).is_err());
}

#[test]
fn what_was_told_is_drawn() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let (title, joints) = motion();
    let at = |frame, z| draw::Waypoint { frame, joint: 0, position: [0.0, 0.9, z] };
    let waypoints = [at(0, 0.0), at(10, 0.5), at(20, 1.0)];
    let purple = |bytes: Vec<u8>| {
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        let found = pixels.chunks(3).filter(|p| **p == [140, 60, 160]).count();
        (found, reader.info().height)
    };
    let row = || [Row { title: title.clone(), note: String::new(), joints: joints.clone() }];
    let sheet = |given: Given<'_>| {
        let mut bytes = vec![];
        draw::sheet_to(&row(), 6, skeleton, given, &mut bytes).unwrap();
        bytes
    };
    let [_, plain] = draw::sheet_size(1, 6, false).map(|pixels| pixels as u32);
    assert_eq!(purple(sheet(Given::default())), (0, plain));
    let (found, height) = purple(sheet(Given { waypoints: &waypoints, ..Given::default() }));
    assert!(found > 60 && height > plain + 200, "{found} pixels of waypoints, {height} high");
    // Poses between kept frames have the colour of generated frames, and add no height.
    let (found, height) = purple(sheet(Given { kept: &[0..5, 15..21], ..Given::default() }));
    assert!(found > 60 && height == plain, "{found} pixels of what was drawn, {height} high");
    let (mut plain, mut along) = (vec![], vec![]);
    draw::gif_along_to(&joints, skeleton, &title, &[], &mut plain).unwrap();
    draw::gif_along_to(&joints, skeleton, &title, &waypoints, &mut along).unwrap();
    assert_ne!(plain, along);
}

/// Pixels of a sheet.
fn pixels(rows: &[Row]) -> (Vec<u8>, [usize; 2]) {
    let mut bytes = vec![];
    draw::sheet_to(rows, 6, Skeleton::of(DataFormat::Humanml3d), Given::default(), &mut bytes).expect("a picture");
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().expect("a picture");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a picture")];
    reader.next_frame(&mut pixels).expect("a picture");
    (pixels, [reader.info().width as usize, reader.info().height as usize])
}

#[test]
fn a_sheet_has_a_row_a_motion_with_its_note_and_its_way_from_above() {
    let (title, joints) = motion();
    let row = |note: &str, joints: &[f32]| Row { title: title.clone(), note: note.into(), joints: joints.to_vec() };
    let (plain, size) = pixels(&[row("", &joints), row("", &joints)]);
    assert_eq!(size, draw::sheet_size(2, 6, false));
    let (noted, _) = pixels(&[row("", &joints), row("pcm, 1 step, seed 7", &joints)]);
    let differ = |other: &[u8], columns: std::ops::Range<usize>| {
        let rows = plain.chunks(3 * size[0]).zip(other.chunks(3 * size[0]));
        rows.filter(|(a, b)| a[3 * columns.start..3 * columns.end] != b[3 * columns.start..3 * columns.end]).count()
    };
    assert!((5..20).contains(&differ(&noted, 0..size[0])), "a note is one line: {}", differ(&noted, 0..size[0]));
    // The same poses along another way differ only from above.
    let mut turned = joints.clone();
    for (t, frame) in turned.chunks_mut(66).enumerate() {
        frame.chunks_mut(3).for_each(|joint| joint[0] += t as f32 * 0.02);
    }
    let (turned, _) = pixels(&[row("", &turned), row("", &joints)]);
    let (poses, way) = (differ(&turned, 0..684), differ(&turned, 684..size[0]));
    assert!(way > 60 && poses < 8, "{way} lines of the way and {poses} of the poses");
    let error =
        draw::gif_along_to(&[0.0; 65], Skeleton::of(DataFormat::Humanml3d), "", &[], vec![]).unwrap_err().to_string();
    assert!(error.contains("65 coordinates"), "{error}");
}
