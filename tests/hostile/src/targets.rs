//! The parsers of all kinds of files, with the uses that the program makes of their results.

use std::path::Path;
use std::sync::Once;

use mocap::bvh::Bvh;
use mocap::html::{Page, Panel, Section};
use mocap::joint_map::JointMap;
use mocap::rig::Rig;
use mocap::take::{Reading, Take, resample};
use mocap::{Body, arrays, captions, glb, requests};
use motion::text::Caption;
use motion::{DataPath, Skeleton, npy, text, waypoints};
use protocol::stage::DataFormat;
use text_models::{EncoderFolder, Kind, ReadAt, Request, Rules, TokenIds, Tokenizer, WeightsFile};

use crate::{Target, canary, named, scratch, seeds};

/// A pickle reader copies values that a pickle references repeatedly, up to a million values. Its own limit is
/// therefore far above [`crate::MEMORY`].
pub const PICKLE_MEMORY: usize = 512 << 20;

/// All targets of this crate.
pub const TARGETS: [Target; 16] = [
    Target::new("bvh", bvh, seeds::bvh)
        .named(named::bvh)
        .words("HIERARCHY¦ROOT x\n{\n¦JOINT j\n{\n¦OFFSET 0 1 0\n¦CHANNELS 3 ¦Zrotation ¦End Site\n{¦}\n¦MOTION\n¦Frames: ¦Frame Time: ¦0 "),
    Target::new("joint_map", joint_map, seeds::joint_map)
        .named(named::yaml)
        .words("joints:¦name: ¦pelvis: ¦{from: a, towards: b, fraction: 1}¦&a ¦*a¦[*a, *a]¦- ¦? ¦!!binary ¦|\n ¦%YAML 1.2\n---\n"),
    Target::new("npy", npy, seeds::npy)
        .named(named::npy)
        .words("'descr'¦'<f4'¦'fortran_order': True¦'shape': (¦1,¦((¦'|O'¦'>f4'"),
    Target::new("npz", npz, seeds::npz)
        .named(named::npz)
        .words("PK\u{1}\u{2}¦PK\u{3}\u{4}¦PK\u{5}\u{6}¦PK\u{6}\u{6}¦joints.npy¦fps.npy¦'<i4'"),
    Target::new("captions", captions, seeds::captions)
        .named(named::json)
        .words("clip¦caption¦\"\"¦,¦\r\n¦from¦[[¦{\"a\":¦\\ud800¦left¦counter-clockwise "),
    Target::new("texts", texts, seeds::texts_of_clips).words("#¦/¦a/DET ¦#0.0#0.0\n¦nan¦\u{130}¦\u{2028}¦left "),
    Target::new("sentences", sentences, seeds::sentences)
        .words("#¦#120\n¦#4.5s\n¦#NA¦{\"caption\": \"¦\"frames\": ¦\"seconds\": ¦\u{feff}"),
    Target::new("pipeline", pipeline, seeds::pipeline)
        .named(named::yaml)
        .words("stages:¦kind: ¦train.vae¦&a ¦*a¦<<: *a¦[*a, *a]¦- ¦? ¦: ¦|\n ¦sweep: ¦${¦--- \n¦!!str ¦{a: "),
    Target::new("waypoints", waypoints, seeds::waypoints)
        .named(named::json)
        .words("t,x,y,z\n¦joint¦pelvis¦,¦[[0,0,0,0]]¦{\"head\":¦3600"),
    Target::new("safetensors", safetensors, seeds::safetensors)
        .named(named::safetensors)
        .words("\"dtype\":\"F32\"¦\"shape\":[¦\"data_offsets\":[¦__metadata__¦\"F64\"¦\"BOOL\"¦\"a\":{"),
    Target::new("tokenizer", tokenizer, seeds::tokenizer)
        .named(named::tokenizer)
        .words("\"BPE\"¦\"Unigram\"¦\"WordPiece\"¦\"WordLevel\"¦\"Regex\":\"(a*)*b\"¦\"Replace\"¦\"Precompiled\",\"precompiled_charsmap\":\"AAAA\"¦\"vocab\":{¦\"merges\":[¦null¦\"type\":\"Sequence\",\"normalizers\":[¦\"ids\":[0]"),
    Target::new("encoder", encoder, seeds::encoder)
        .within(PICKLE_MEMORY)
        .words("\"path\":\"..\"¦\"vocab_size\":¦\"hidden_size\":¦\"num_hidden_layers\":¦\"d_model\":¦\"weight_map\":{¦sentence_transformers.models.Dense¦model_max_length¦null¦a b</w>\n"),
    Target::new("torch", torch, seeds::torch)
        .named(named::torch)
        .within(PICKLE_MEMORY)
        .words("cposix\nsystem\n¦ctorch\nHalfStorage\n¦h\0¦q\0¦2¦(¦t¦R¦}¦]¦b¦Q¦.¦]r\0\0\0\0¦X\u{4}\0\0\0aaaa¦PK\u{1}\u{2}"),
    Target::new("bvh_out", bvh_out, seeds::motions),
    Target::new("glb", glb, seeds::motions),
    Target::new("html", html, seeds::motions),
];

/// Runs a target by name, for `fuzz/`.
///
/// # Panics
/// If there is no such target.
pub fn run(name: &str, bytes: &[u8]) -> bool {
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of that name");
    (target.run)(bytes)
}

/// Longest error in bytes: a list of many mistakes, each a line or two.
const ERROR: usize = 64 << 10;

/// Returns the parsed value, and checks that an error is short and quotes nothing.
fn read<T, E: ToString>(result: Result<T, E>) -> Option<T> {
    match result {
        Ok(value) => Some(value),
        Err(error) => {
            let error = error.to_string();
            canary::expect_absent(&error);
            let length = error.len();
            assert!(length <= ERROR, "an error of {length} bytes");
            None
        }
    }
}

fn bvh(bytes: &[u8]) -> bool {
    let Some(bvh) = read(Bvh::parse(Path::new("x.bvh"), bytes)) else { return false };
    assert_eq!(bvh.values.len(), bvh.frames * bvh.channels());
    assert!(bvh.rate > 0.0 && bvh.values.iter().all(|value| value.is_finite()));
    if let Some(take) = read(Take::of_bvh(&bvh, &Reading::default())) {
        let skeleton = Skeleton::of(DataFormat::Humanml3d);
        assert_eq!(take.joints.len(), 66 * bvh.frames);
        assert!(!resample(&take.joints, 66, take.rate, skeleton.fps).is_empty());
    }
    true
}

fn joint_map(bytes: &[u8]) -> bool {
    let Some(map) = read(JointMap::parse(Path::new("x.yaml"), &String::from_utf8_lossy(bytes))) else { return false };
    assert_eq!(JointMap::parse(Path::new("x.yaml"), &map.to_yaml()).ok().as_ref(), Some(&map), "{}", map.to_yaml());
    // Our own recording has all joints by their names.
    let recording = Bvh::parse(Path::new("x.bvh"), &seeds::bvh()[2]).expect("one of ours");
    if let Some(places) = read(map.resolve(&recording)) {
        assert_eq!(places.joints(&recording.placed(0), 0.01).len(), 22);
    }
    true
}

fn npy(bytes: &[u8]) -> bool {
    let file = Path::new("x.npy");
    let strict = read(npy::parse(file, bytes, false));
    let Some(array) = read(npy::parse(file, bytes, true)) else {
        assert!(strict.is_none());
        return false;
    };
    assert_eq!(array.shape.iter().product::<usize>(), array.data.len());
    true
}

fn npz(bytes: &[u8]) -> bool {
    let Some(found) = read(arrays::parse(Path::new("x.npz"), bytes)) else { return false };
    assert!(found.data.len().is_multiple_of(3 * found.joints) && found.data.iter().all(|v| v.is_finite()));
    assert!(found.rate.is_none_or(|rate| rate >= 1.0));
    true
}

/// Checks that writing a caption and parsing it again returns the same caption.
fn survives(caption: &Caption) {
    assert_eq!(Caption::parse(&caption.to_line()).as_ref(), Ok(caption));
    let mirrored = captions::mirrored(caption);
    assert_eq!(mirrored.tokens.len(), caption.tokens.len());
}

fn captions(bytes: &[u8]) -> bool {
    let Ok(content) = std::str::from_utf8(bytes) else { return false };
    let Some(rows) = read(captions::of_table(Path::new("x.csv"), content)) else { return false };
    rows.iter().flat_map(|row| &row.captions).for_each(survives);
    true
}

fn texts(bytes: &[u8]) -> bool {
    let Ok(content) = std::str::from_utf8(bytes) else { return false };
    let file = Path::new("x.txt");
    let beside = read(captions::of_text(file, content));
    if let Some(captions) = &beside {
        captions.iter().for_each(survives);
    }
    let errors = |errors: Vec<text::TextError>| errors.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
    if let Some(found) = read(text::parse_file(file, content).map_err(errors)) {
        for (_, caption) in &found.captions {
            if let Some((from, to)) = caption.frames(20.0) {
                assert!(from <= to);
            }
            text::padded_tokens(&caption.tokens).0.iter().for_each(|token| {
                text::pos_class(token);
            });
            assert_eq!(text::hashed_embedding(&caption.text).len(), text::EMBEDDING_WIDTH);
        }
    }
    beside.is_some()
}

fn sentences(bytes: &[u8]) -> bool {
    let Ok(content) = std::str::from_utf8(bytes) else { return false };
    let read = [false, true].map(|json| read(requests::parse("x", content, json)));
    for request in read.iter().flatten().flatten() {
        assert!(request.length.is_none_or(|length| length.frames(20.0) > 0));
    }
    read.iter().any(Option::is_some)
}

fn pipeline(bytes: &[u8]) -> bool {
    let Ok(content) = std::str::from_utf8(bytes) else { return false };
    read(pipeline::read("x.yaml", content, &[])).is_some()
}

fn waypoints(bytes: &[u8]) -> bool {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let read = ["x.csv", "x.json", "x.npy"].map(|name| read(waypoints::parse(Path::new(name), bytes, skeleton, &[])));
    for waypoint in read.iter().flatten().flatten() {
        assert!(waypoint.joint < 22 && waypoint.position.iter().all(|v| v.is_finite()));
    }
    read.iter().any(Option::is_some)
}

/// Bytes in memory, read in place.
struct Slice<'a>(&'a [u8]);

impl ReadAt for Slice<'_> {
    fn bytes(&self) -> u64 {
        self.0.len() as u64
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> Result<(), String> {
        self.0.read_at(offset, out)
    }
}

fn safetensors(bytes: &[u8]) -> bool {
    let Some(file) = read(WeightsFile::open(Slice(bytes))) else { return false };
    for (name, tensor) in &file.tensors {
        let count: usize = tensor.shape.iter().product();
        // The caller knows the expected size, never the file; here it is at most the size of the file.
        if tensor.element.is_some() && count <= bytes.len() {
            file.read(name, &mut vec![0.0; count]).expect("its place was held against the file");
        }
    }
    true
}

fn tokenizer(bytes: &[u8]) -> bool {
    let clip = Rules { repair: true, strip: false, lower: false, first: Some(4), end: 5, pad: 5, most: 6 };
    let t5 = Rules { repair: false, strip: true, lower: false, first: None, end: 1, pad: 0, most: 6 };
    let mut accepted = false;
    for rules in [clip, t5] {
        let Some(tokenizer) = read(Tokenizer::new("x", bytes, &rules, 7)) else { continue };
        accepted = true;
        for caption in ["ab a b \u{1f600}", "", "a person walks forward, turns around & sits\u{2028}down"] {
            if let Some(ids) = read(tokenizer.ids(caption)) {
                assert!(ids.len() <= rules.most && ids.iter().all(|id| *id < 7), "{ids:?}");
            }
        }
    }
    accepted
}

/// Opens an encoder's folder and reads all of it.
fn opened(root: &str, kind: Kind) -> bool {
    let request = Request { kind, ids: TokenIds::HuggingFace, most: 0 };
    let Some(folder) = read(EncoderFolder::open(&DataPath::local(scratch::folder().join(root)), &request)) else {
        return false;
    };
    folder.description.check().expect("it was checked");
    // Any result is fine.
    let _ = folder.tokenizer().expect("it was made").ids("ab a b");
    let _ = folder.weights().map(|weights| (folder.digest(&weights), folder.skipped_line()));
    true
}

fn encoder(bytes: &[u8]) -> bool {
    static WRITTEN: Once = Once::new();
    let folders = [("clip", Kind::Clip), ("sentence", Kind::SentenceT5)];
    let files: Vec<(String, Kind, Vec<u8>)> = folders
        .into_iter()
        .flat_map(|(root, kind)| {
            let files = seeds::encoder_folder(kind == Kind::SentenceT5);
            files.into_iter().map(move |(name, whole)| (format!("{root}/{name}"), kind, whole))
        })
        .collect();
    WRITTEN.call_once(|| {
        for (name, _, whole) in &files {
            scratch::file(name, whole);
        }
    });
    let Some((which, bytes)) = bytes.split_first() else { return false };
    let (name, kind, whole) = &files[usize::from(*which) % files.len()];
    scratch::file(name, bytes);
    let accepted = opened(name.split('/').next().unwrap_or_default(), *kind);
    scratch::file(name, whole);
    accepted
}

/// Uses the bytes as the dense layer of an otherwise valid Sentence-T5.
fn torch(bytes: &[u8]) -> bool {
    static WRITTEN: Once = Once::new();
    WRITTEN.call_once(|| {
        for (name, whole) in seeds::encoder_folder(true) {
            if name != "2_Dense/model.safetensors" {
                scratch::file(&format!("torch/{name}"), &whole);
            }
        }
    });
    scratch::file("torch/2_Dense/pytorch_model.bin", bytes);
    opened("torch", Kind::SentenceT5)
}

/// Reads the joints of a motion from bytes; the motion may be empty.
fn rig(bytes: &[u8]) -> Option<(Vec<f32>, Rig)> {
    let joints: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let whole = joints.len() / 66 * 66;
    let joints = joints[..whole].to_vec();
    let rig = Rig::fit(&joints, Skeleton::of(DataFormat::Humanml3d)).ok()?;
    Some((joints, rig))
}

/// Checks that our parser reads our own output.
fn bvh_out(bytes: &[u8]) -> bool {
    let Some((joints, rig)) = rig(bytes) else { return false };
    if joints.iter().any(|v| v.abs() > 1e4) {
        return false;
    }
    let file = rig.to_bvh(20.0, 100.0).to_text();
    let read = Bvh::parse(Path::new("x.bvh"), file.as_bytes()).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(read.frames, rig.frames());
    true
}

/// Checks that the result is no file, or a file with correct chunk lengths and valid JSON of finite numbers.
fn glb(bytes: &[u8]) -> bool {
    let Some((_, rig)) = rig(bytes) else { return false };
    let name = String::from_utf8_lossy(&bytes[..bytes.len().min(100)]).into_owned();
    let Ok(file) = glb::to_bytes(&rig, 20.0, 1.0, &name) else { return false };
    let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().expect("four bytes")) as usize;
    assert_eq!((&file[..4], number(4), number(8)), (&b"glTF"[..], 2, file.len()));
    let text = number(12);
    let document: serde_json::Value = serde_json::from_slice(&file[20..20 + text]).expect("JSON");
    let data = file.len() - 28 - text;
    assert_eq!((number(20 + text), document["buffers"][0]["byteLength"].as_u64()), (data, Some(data as u64)));
    for view in document["bufferViews"].as_array().expect("views") {
        let part = |key: &str| view[key].as_u64().expect("a number");
        assert!(part("byteOffset") + part("byteLength") <= data as u64);
    }
    for accessor in document["accessors"].as_array().expect("accessors") {
        for bound in ["min", "max"] {
            assert!(
                accessor[bound].as_array().is_none_or(|all| all.iter().all(serde_json::Value::is_number)),
                "{accessor}"
            );
        }
    }
    true
}

/// Checks that the result is no page, or a page that escapes its caption.
fn html(bytes: &[u8]) -> bool {
    let Some((joints, _)) = rig(bytes) else { return false };
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let caption = format!("<script>{}</script>", String::from_utf8_lossy(&bytes[..bytes.len().min(100)]));
    let panel = Panel { caption: caption.clone(), note: caption.clone(), body: &body, joints: &joints, waypoints: &[] };
    let page = Page { title: caption.clone(), sections: vec![Section { title: caption, panels: vec![panel] }] };
    let mut out = Vec::new();
    if page.write(&mut out).is_err() {
        return false;
    }
    let page = String::from_utf8(out).expect("text");
    assert_eq!(page.matches("<script").count(), 2, "data and viewer");
    true
}
