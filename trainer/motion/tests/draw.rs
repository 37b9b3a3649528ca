//! Pictures decode, have the motion's length, and show a figure in both colours.

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
    draw::gif_to(&joints, skeleton, &title, &mut bytes).unwrap();
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
    let (mut plain, mut along) = (vec![], vec![]);
    draw::strip_png_to(&[(title.clone(), joints.clone())], 6, skeleton, &mut plain).unwrap();
    let given = draw::Given { waypoints: &waypoints, ..draw::Given::default() };
    draw::strip_png_along_to(&[(title.clone(), joints.clone())], 6, skeleton, given, &mut along).unwrap();
    assert_eq!(purple(plain), (0, 210));
    let (found, height) = purple(along);
    assert!(found > 60 && height > 400, "{found} pixels of waypoints, {height} high");
    // Poses between kept frames have the colour of generated frames, and add no height.
    let mut edited = vec![];
    let given = draw::Given { kept: &[0..5, 15..21], ..draw::Given::default() };
    draw::strip_png_along_to(&[(title.clone(), joints.clone())], 6, skeleton, given, &mut edited).unwrap();
    let (found, height) = purple(edited);
    assert!(found > 60 && height == 210, "{found} pixels of what was drawn, {height} high");
    let (mut plain, mut along) = (vec![], vec![]);
    draw::gif_to(&joints, skeleton, &title, &mut plain).unwrap();
    draw::gif_along_to(&joints, skeleton, &title, &waypoints, &mut along).unwrap();
    assert_ne!(plain, along);
}

#[test]
fn a_sheet_has_a_row_a_motion() {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let mut bytes = vec![];
    draw::strip_png_to(&[motion(), motion()], 6, skeleton, &mut bytes).unwrap();
    let reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    assert_eq!((reader.info().width, reader.info().height), (684, 420));
    let error = draw::gif_to(&[0.0; 65], skeleton, "", vec![]).unwrap_err().to_string();
    assert!(error.contains("65 coordinates"), "{error}");
}
