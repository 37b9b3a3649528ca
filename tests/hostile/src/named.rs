//! Hostile files that mutation would hardly find. Each is refused.

use std::fmt::Write as _;

use serde_json::json;

use crate::seeds;

/// Description and content of a file.
pub type Named = (&'static str, Vec<u8>);

/// No hostile files.
pub fn none() -> Vec<Named> {
    Vec::new()
}

/// Recordings with excessive counts.
pub fn bvh() -> Vec<Named> {
    let head = "HIERARCHY\nROOT r\n{\n";
    let motion = |frames: &str, time: &str| {
        format!("{head}OFFSET 0 0 0\nCHANNELS 1 Yrotation\n}}\nMOTION\nFrames: {frames}\nFrame Time: {time}\n1\n")
            .into_bytes()
    };
    let joints = |count: usize, end: &str| {
        let joint = |mut text: String, i| {
            writeln!(text, "JOINT j{i} {{ {end}").expect("a text");
            text
        };
        (0..count).fold(head.to_owned(), joint).into_bytes()
    };
    vec![
        ("a million channels", format!("{head}CHANNELS 1000000 {}", "Xrotation ".repeat(1_000_000)).into_bytes()),
        ("joints nested 100,000 deep", joints(100_000, "")),
        ("half a million joints", joints(500_000, "}")),
        ("2^60 frames", motion("1152921504606846976", "0.01")),
        ("frames of a century", motion("1", "3e9")),
        ("a name of ten megabytes", format!("HIERARCHY\nROOT {}\n{{", "x".repeat(10 << 20)).into_bytes()),
        ("a number of ten megabytes", format!("{head}OFFSET {} 0 0", "1".repeat(10 << 20)).into_bytes()),
    ]
}

/// Deeply nested and exponentially expanding YAML.
pub fn yaml() -> Vec<Named> {
    let mut laughs = "a: &a [x, x, x, x, x, x, x, x, x]\n".to_owned();
    for (before, name) in
        ["a", "b", "c", "d", "e", "f", "g", "h", "i"].iter().zip(["b", "c", "d", "e", "f", "g", "h", "i", "j"])
    {
        let aliases = vec![format!("*{before}"); 9].join(", ");
        writeln!(laughs, "{name}: &{name} [{aliases}]").expect("a text");
    }
    vec![
        ("aliases of aliases", laughs.into_bytes()),
        ("lists nested 100,000 deep", "[".repeat(100_000).into_bytes()),
        ("mappings nested 100,000 deep", "{a: ".repeat(100_000).into_bytes()),
        (
            "blocks nested deep",
            (0..1_000).fold(String::new(), |text, i| format!("{text}{}a:\n", " ".repeat(i))).into_bytes(),
        ),
        (
            "a hundred thousand keys",
            (0..100_000).fold(String::new(), |text, i| text + &format!("k{i}: 1\n")).into_bytes(),
        ),
    ]
}

/// Arrays whose headers claim enormous sizes.
pub fn npy() -> Vec<Named> {
    let array = |shape: &str| {
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n");
        [b"\x93NUMPY\x01\x00", &(header.len() as u16).to_le_bytes()[..], header.as_bytes()].concat()
    };
    vec![
        ("2^60 numbers", array("(1152921504606846976,)")),
        ("2^62 rows of 66", array("(4611686018427387904, 22, 3)")),
        ("a header of four gigabytes", [&b"\x93NUMPY\x02\x00"[..], &u32::MAX.to_le_bytes(), b"{}"].concat()),
        ("a header of brackets", array(&"(".repeat(900))),
    ]
}

/// Archives that unpack to far more than their size.
pub fn npz() -> Vec<Named> {
    vec![
        ("zeros packed a thousandfold", seeds::zip_bomb(&["joints.npy"], 90 << 20)),
        ("a rate packed a thousandfold", seeds::zip_bomb(&["fps.npy", "joints.npy"], 70 << 20)),
    ]
}

/// Deeply nested JSON and long lines.
pub fn json() -> Vec<Named> {
    vec![
        ("lists nested 100,000 deep", "[".repeat(100_000).into_bytes()),
        ("objects nested 100,000 deep", "{\"a\":".repeat(100_000).into_bytes()),
        ("a quote that is never closed", format!("clip,text\na,\"{}", "x\n".repeat(1 << 20)).into_bytes()),
    ]
}

/// Headers with false lengths and offsets.
pub fn safetensors() -> Vec<Named> {
    let file = |length: u64, header: &str| [&length.to_le_bytes()[..], header.as_bytes()].concat();
    let shaped = |shape: &str| {
        let header = format!("{{\"a\":{{\"dtype\":\"F32\",\"shape\":{shape},\"data_offsets\":[0,4]}}}}");
        [file(header.len() as u64, &header), vec![0; 4]].concat()
    };
    vec![
        ("a header of 2^60 bytes", file(1 << 60, "{}")),
        ("a header of 2^64 - 1 bytes", file(u64::MAX, "{}")),
        ("2^62 numbers", shaped("[4611686018427387904]")),
        ("more numbers than can be counted", shaped("[4611686018427387904, 8]")),
        ("a header of brackets", file(100_000, &"[".repeat(100_000))),
    ]
}

/// Tokenizers that grow during parsing, or expand a short text to a long one.
pub fn tokenizer() -> Vec<Named> {
    let with = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut file: serde_json::Value = serde_json::from_slice(&seeds::tokenizer()[0]).expect("one of ours");
        change(&mut file);
        file.to_string().into_bytes()
    };
    let many = |count: usize| -> serde_json::Map<String, serde_json::Value> {
        (0..count).map(|i| (format!("t{i}"), json!(i))).collect()
    };
    let step = json!({"type": "Replace", "pattern": {"String": "a"}, "content": "aaaaaaaa"});
    vec![
        ("six hundred thousand tokens", with(&|file| file["model"]["vocab"] = many(600_000).into())),
        (
            "six hundred thousand merges",
            with(&|file| file["model"]["merges"] = vec![json!(["a", "b"]); 600_000].into()),
        ),
        ("six hundred thousand added tokens", with(&|file| file["added_tokens"] = vec![json!({}); 600_000].into())),
        ("a token of sixty thousand letters", long_token()),
        (
            "one letter to eight, a hundred times",
            with(&|file| file["normalizer"] = json!({"type": "Sequence", "normalizers": vec![step.clone(); 100]})),
        ),
        ("steps nested deep", "{\"normalizer\":{\"type\":\"Sequence\",\"normalizers\":[".repeat(20_000).into_bytes()),
        ("lists nested 100,000 deep", "[".repeat(100_000).into_bytes()),
    ]
}

/// A token so long that a tree with one level per byte overflows the stack.
fn long_token() -> Vec<u8> {
    let mut file: serde_json::Value = serde_json::from_slice(&seeds::tokenizer()[1]).expect("one of ours");
    file["model"]["vocab"][4] = json!(["a".repeat(60_000), -1.5]);
    file.to_string().into_bytes()
}

/// Pickles that run a command in Python, archives that unpack to far more than their size, and structures that multiply
/// themselves.
pub fn torch() -> Vec<Named> {
    let ran = crate::scratch::folder().join("ran");
    let command = format!("touch {}", ran.display());
    // A list of lists of lists, each referenced ten times.
    let mut copies = b"\x80\x02]q\x00".to_vec();
    for i in 0..20_u8 {
        copies.extend([b"]q", &[i + 1][..], b"("].concat());
        copies.extend([b'h', i].repeat(10));
        copies.push(b'e');
    }
    copies.push(b'.');
    vec![
        ("a pickle that runs a command", seeds::pickle_that_runs(&command)),
        ("an archive that runs a command", seeds::archive_that_runs(&command)),
        ("zeros packed a thousandfold", seeds::zip_bomb(&["archive/data.pkl", "archive/data/0"], 40 << 20)),
        ("copies of copies", copies),
        ("lists nested 100,000 deep", [&b"\x80\x02"[..], &b"]".repeat(100_000), &b"a".repeat(99_999), b"."].concat()),
        ("a text of four gigabytes", [&b"\x80\x02X"[..], &u32::MAX.to_le_bytes(), b"x."].concat()),
        ("bytes of 2^60", [&b"\x80\x04\x8e"[..], &(1_u64 << 60).to_le_bytes(), b"x."].concat()),
    ]
}
