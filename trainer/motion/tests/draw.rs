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
