//! The viewer's page: complete, safe against captions, and with exact positions.

use browser::decoded;
use mocap::Body;
use mocap::html::{MOST_PANELS, Page, Panel, STEP, Section};
use motion::waypoints::Waypoint;
use motion::{Skeleton, features, synthetic};
use protocol::stage::{DataFormat, DataSynthetic};
use protocol::{Digest, Seed};
use serde_json::Value;

fn motion() -> Vec<f32> {
    let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(1));
    features::recover_joints(&dataset.clips[0].features, dataset.skeleton())
}

fn page(caption: &str, body: &Body, joints: &[f32], waypoints: &[Waypoint]) -> Result<String, String> {
    let panel = Panel { caption: caption.into(), note: caption.into(), body, joints, waypoints };
    let sections = vec![Section { title: format!("of {caption}"), panels: vec![panel.clone(), panel] }];
    let mut bytes = Vec::new();
    Page { title: format!("about {caption}"), sections }.write(&mut bytes).map_err(|error| error.to_string())?;
    Ok(String::from_utf8(bytes).expect("well formed"))
}

/// The text between two marks.
fn between<'a>(text: &'a str, from: &str, to: &str) -> &'a str {
    let (_, rest) = text.split_once(from).unwrap_or_else(|| panic!("no `{from}`"));
    rest.split_once(to).unwrap_or_else(|| panic!("no `{to}`")).0
}

fn data(page: &str) -> Value {
    serde_json::from_str(between(page, "id=\"motions\">", "</script>")).expect("well formed")
}

#[test]
fn positions_come_back_to_half_a_step() {
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let near = motion();
    // A walk of more than 6.5 m needs larger steps.
    let far: Vec<f32> =
        near.iter().enumerate().map(|(i, v)| v + if i % 3 == 2 { i as f32 * 3e-3 } else { 0.0 }).collect();
    for joints in [near, far] {
        let told = [Waypoint { frame: 3, joint: 20, position: [0.5, 1.0, 0.25] }];
        let data = data(&page("x", &body, &joints, &told).unwrap());
        let motion = &data["motions"][1];
        assert_eq!(motion["waypoints"], serde_json::json!([[3, 20, 0.5, 1.0, 0.25]]));
        assert_eq!(motion["frames"], joints.len() / 66);
        assert_eq!(data["bodies"].as_array().unwrap().len(), 1, "the same body once");
        let step = motion["step"].as_f64().unwrap();
        let extent = (0..3).map(|k| {
            let values = || joints.iter().skip(k).step_by(3).copied().map(f64::from);
            values().fold(f64::MIN, f64::max) - values().fold(f64::MAX, f64::min)
        });
        let extent = extent.fold(0.0, f64::max);
        assert!((step - STEP.max(extent / 65534.0)).abs() < 1e-9, "{step} for {extent} m");
        let bytes = decoded(motion["joints"].as_str().unwrap());
        assert_eq!(bytes.len(), 2 * joints.len());
        for (i, (pair, joint)) in bytes.chunks(2).zip(&joints).enumerate() {
            let number = f64::from(i16::from_le_bytes([pair[0], pair[1]]));
            let found = motion["origin"][i % 3].as_f64().unwrap() + step * number;
            assert!((found - f64::from(*joint)).abs() <= 0.5 * step + 1e-6, "{found} for {joint}");
        }
    }
}

#[test]
fn a_caption_stays_text() {
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let hostile = "</script><script>alert(1)</script><img src=x onerror='alert(2)'>\" & \u{202e}\u{1b}[2J</title>走";
    let page = page(hostile, &body, &motion(), &[]).unwrap();
    assert_eq!(page.matches("<script").count(), 2, "data and viewer");
    assert_eq!(page.matches("</script>").count(), 2);
    assert!(!page.contains("<img") && !page.contains('\u{202e}') && !page.contains('\u{1b}'));
    let shown = "&lt;img src=x onerror=&#39;alert(2)&#39;&gt;&quot; &amp; \\u202e\\u001b[2J&lt;/title&gt;走";
    assert_eq!(page.matches(shown).count(), 7, "title, heading, section, two captions with their notes");
    assert_eq!(page.matches("<title>").count(), 1);

    let (body, joints) = (Body::of(Skeleton::of(DataFormat::Humanml3d)), motion());
    let panel = Panel { caption: "walks".into(), note: "seed 1".into(), body: &body, joints: &joints, waypoints: &[] };
    let sections = vec![Section { title: "walks".into(), panels: vec![panel] }];
    let mut bytes = Vec::new();
    Page { title: "x".into(), sections }.write(&mut bytes).unwrap();
    assert_eq!(String::from_utf8(bytes).unwrap().matches(">walks<").count(), 1, "a title is not said twice");
}

#[test]
fn nothing_is_fetched_and_nothing_else_runs() {
    let body = Body::of(Skeleton::of(DataFormat::Kit));
    let page = page("x", &body, &[100.0; 2 * 63], &[]).unwrap();
    let policy = between(&page, "Content-Security-Policy\" content=\"", "\"");
    assert!(policy.starts_with("default-src 'none'; script-src 'sha256-"), "{policy}");
    let digests: Vec<Vec<u8>> =
        policy.split('\'').filter_map(|word| word.strip_prefix("sha256-")).map(decoded).collect();
    let named = [("<script type=\"module\">", "</script>"), ("<style>", "</style>")].map(|(from, to)| {
        let text = between(&page, from, to);
        Digest::of(text.as_bytes()).as_bytes().to_vec()
    });
    assert_eq!(digests, named);
    for word in ["http:", "https:", "//cdn", " src=", "@import", "url(", "fetch(", "XMLHttp", "innerHTML", "style=\""] {
        assert!(!page.contains(word), "`{word}`");
    }
    for word in [
        "\"aria-label\": \"Time\"",
        "aria-labelledby=\"c1\"",
        "tabindex=\"0\"",
        "prefers-color-scheme: dark",
        "<noscript>",
    ] {
        assert!(page.contains(word), "`{word}`");
    }
}

#[test]
fn what_is_no_motion_is_refused() {
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let refused = |joints: &[f32]| page("x", &body, joints, &[]).unwrap_err();
    assert!(refused(&[0.0; 65]).contains("motion 1 has 65 coordinates"));
    assert!(refused(&[]).contains("0 coordinates"));
    let mut broken = motion();
    broken[5 * 66 + 2] = f32::NAN;
    assert!(refused(&broken).contains("frame 5 of motion 1"), "{}", refused(&broken));
    broken[5 * 66 + 2] = 2e4;
    assert!(refused(&broken).contains("20000"));
    let joints = motion();
    let panel = Panel { caption: String::new(), note: String::new(), body: &body, joints: &joints, waypoints: &[] };
    let section = Section { title: String::new(), panels: vec![panel; MOST_PANELS + 1] };
    let many = Page { title: String::new(), sections: vec![section] };
    assert!(many.write(Vec::new()).unwrap_err().to_string().contains("513 motions"));
    assert!(Page::default().write(Vec::new()).unwrap_err().to_string().contains("at least one"));
}
