//! Decoder of base64, for tests of pages that hold bytes.

/// Decodes base64 `text`.
///
/// # Panics
///
/// If it is none.
#[must_use]
pub fn decoded(text: &str) -> Vec<u8> {
    let value = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        _ => panic!("`{c}` in base64"),
    };
    let letters: Vec<u32> = text.trim_end_matches('=').bytes().map(|c| u32::from(value(c))).collect();
    let group = |four: &[u32]| {
        let bits: u32 = (0..4).fold(0, |n, k| n << 6 | four.get(k).copied().unwrap_or_default());
        bits.to_be_bytes()[1..four.len()].to_vec()
    };
    letters.chunks(4).flat_map(group).collect()
}
