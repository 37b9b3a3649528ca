//! Mutates files. The result is a function of a key, so that an input can be found again by its number.

use motion::random::Stream;
use protocol::Seed;

/// Largest size of most inputs; one in [`LARGE_ONE_IN`] may be larger.
const USUAL: usize = 64 << 10;
/// Largest size of any input.
const LARGEST: usize = 2 << 20;
/// Rate of large inputs. Only they reveal quadratic behaviour.
const LARGE_ONE_IN: usize = 400;
/// Changes per input.
const CHANGES: usize = 5;

/// Numbers at which parsers count, allocate, divide or convert.
const NUMBERS: [&str; 24] = [
    "0",
    "-1",
    "1",
    "-0.0",
    "2147483647",
    "2147483648",
    "4294967295",
    "4294967296",
    "9007199254740993",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
    "1152921504606846976",
    "99999999999999999999999999999999",
    "1e308",
    "1e309",
    "-1e-320",
    "nan",
    "inf",
    "0.000000001",
    "1000000",
    "65536",
    "255",
];

/// Bytes with a special meaning for some parser.
const BYTES: &[u8] = b"\x00\xff\x7f\x80\x01\n\r\t \"'{}[](),:;#-+.eE0129/\\<>&%|*?!~^PK\xfe\xef\xbb\xbf";

/// Words of files of all kinds.
const WORDS: [&str; 12] =
    ["\"", "{", "}", "[", "]", "\n", "\0", "..", "/etc/passwd", "\u{202e}", "\u{1b}[31m", "\u{1f600}"];

/// Input number `index` of `purpose` under `seed`, made of `seeds` and `words`.
pub fn input(seed: u64, purpose: &str, index: u64, seeds: &[Vec<u8>], words: &[&str]) -> Vec<u8> {
    let mut draw = Stream::new(Seed(seed), purpose, 0, index);
    let mut bytes = seeds.get(draw.below(seeds.len())).cloned().unwrap_or_default();
    let most = if draw.below(LARGE_ONE_IN) == 0 { LARGEST } else { USUAL };
    let most = most.max(2 * bytes.len());
    for _ in 0..=draw.below(CHANGES) {
        change(&mut bytes, &mut draw, seeds, words, most);
        bytes.truncate(most);
    }
    bytes
}

/// Draws a range of at most `longest` bytes.
fn range(draw: &mut Stream, length: usize, longest: usize) -> std::ops::Range<usize> {
    let begin = draw.below(length + 1);
    let end = begin + draw.below((length - begin).min(longest) + 1);
    begin..end
}

/// Draws a length; short ones are likelier.
fn short(draw: &mut Stream) -> usize {
    1 << draw.below(12)
}

fn insert(bytes: &mut Vec<u8>, at: usize, what: &[u8], times: usize, most: usize) {
    let room = most.saturating_sub(bytes.len());
    let times = times.min(room / what.len().max(1));
    bytes.splice(at..at, what.repeat(times)).for_each(drop);
}

/// Digits with sign, point and exponent near a random position.
fn number_near(bytes: &[u8], draw: &mut Stream) -> Option<std::ops::Range<usize>> {
    let is_part = |byte: &u8| byte.is_ascii_digit() || b"+-.eE".contains(byte);
    let from = draw.below(bytes.len());
    let begin = from + bytes.get(from..)?.iter().position(u8::is_ascii_digit)?;
    let before = bytes[..begin].iter().rev().take_while(|byte| is_part(byte)).count();
    let after = bytes[begin..].iter().take_while(|byte| is_part(byte)).count();
    Some(begin - before..begin + after)
}

fn change(bytes: &mut Vec<u8>, draw: &mut Stream, seeds: &[Vec<u8>], words: &[&str], most: usize) {
    let length = bytes.len();
    let word = |draw: &mut Stream| -> &[u8] {
        let all = words.len() + WORDS.len();
        let at = draw.below(all);
        words.get(at).unwrap_or_else(|| &WORDS[at - words.len()]).as_bytes()
    };
    match draw.below(14) {
        0 if length > 0 => bytes[draw.below(length)] ^= 1 << draw.below(8),
        1 if length > 0 => bytes[draw.below(length)] = BYTES[draw.below(BYTES.len())],
        2 => bytes.truncate(draw.below(length + 1)),
        3 => {
            let longest = short(draw);
            bytes.drain(range(draw, length, longest)).for_each(drop);
        }
        // Repeat a part, once or very often.
        4 => {
            let longest = short(draw);
            let part = bytes[range(draw, length, longest)].to_vec();
            let (at, times) = (draw.below(length + 1), short(draw) * draw.below(5));
            insert(bytes, at, &part, times, most);
        }
        // Join the beginning of this file and the end of another.
        5 => {
            let Some(other) = seeds.get(draw.below(seeds.len())) else { return };
            let (here, there) = (draw.below(length + 1), draw.below(other.len() + 1));
            bytes.truncate(here);
            bytes.extend_from_slice(&other[there..]);
        }
        6 | 7 => {
            let Some(place) = number_near(bytes, draw) else { return };
            let with = NUMBERS[draw.below(NUMBERS.len())];
            bytes.splice(place, with.bytes()).for_each(drop);
        }
        // Overwrite bytes with a binary length or count.
        8 if length >= 8 => {
            let width = [1, 2, 4, 8][draw.below(4)];
            let value = [0, 1, u64::MAX, 1 << 31, 1 << 60, 1 << 62, length as u64, 1 << 16][draw.below(8)];
            let at = draw.below(length - width + 1);
            bytes[at..at + width].copy_from_slice(&value.to_le_bytes()[..width]);
        }
        9 | 10 => {
            let (at, what) = (draw.below(length + 1), word(draw).to_vec());
            insert(bytes, at, &what, 1, most);
        }
        // Nest deeply, or repeat a word very often.
        11 => {
            let (at, what) = (draw.below(length + 1), word(draw).to_vec());
            let times = short(draw) * (1 + draw.below(32));
            insert(bytes, at, &what, times, most);
        }
        12 => {
            let (one, other) = (range(draw, length, 64), draw.below(length + 1));
            let part = bytes[one].to_vec();
            let end = (other + part.len()).min(length);
            bytes[other..end].copy_from_slice(&part[..end - other]);
        }
        _ => {
            let longest = short(draw);
            let place = range(draw, length, longest);
            bytes[place].fill_with(|| draw.bits() as u8);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_input_is_its_number() {
        let seeds = vec![b"HIERARCHY 1.5".to_vec(), b"other".to_vec()];
        let all: Vec<Vec<u8>> = (0..500).map(|i| input(1, "x", i, &seeds, &["ROOT"])).collect();
        assert_eq!(all, (0..500).map(|i| input(1, "x", i, &seeds, &["ROOT"])).collect::<Vec<_>>());
        assert_ne!(all[..10], (0..10).map(|i| input(2, "x", i, &seeds, &["ROOT"])).collect::<Vec<_>>());
        let distinct: std::collections::BTreeSet<&Vec<u8>> = all.iter().collect();
        assert!(distinct.len() > 350, "{} of 500 differ", distinct.len());
        let has = |part: &[u8]| all.iter().any(|bytes| bytes.windows(part.len()).any(|found| found == part));
        assert!(has(b"ROOT") && has(b"ROOTROOT") && has(b"18446744073709551615") && has(&[0xff; 8]));
        assert!(all.iter().any(Vec::is_empty) && all.iter().any(|bytes| bytes.len() > 30_000));
        assert!(all.iter().all(|bytes| bytes.len() <= LARGEST));
        assert_eq!(input(1, "x", 0, &[], &[]), input(1, "x", 0, &[], &[]), "nothing to begin with");
    }
}
