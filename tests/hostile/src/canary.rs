//! Files with a word in them that no error may repeat: what a worker says of a file, others read who may not read the file.

use crate::Target;

/// The word.
pub const CANARY: &str = "qzcanaryzq";

/// Refuses an error that repeats what stands in the file.
///
/// # Panics
/// If it does.
pub fn expect_absent(error: &str) {
    assert!(!error.to_ascii_lowercase().contains(CANARY), "an error quotes the file: {error}");
}

/// Files that are the word, or lines and structures of it.
fn alone() -> Vec<Vec<u8>> {
    let texts = [
        "%",
        "%\n%\n",
        "% % %\n",
        "%:%:%\n",
        "%=%\n",
        "%,%\n%,%\n",
        "clip,caption,%\n%,%,%\n",
        "clip,caption\n%,%\n%,%#\n",
        "clip,caption,from,to\n%,%,%,%\n",
        "a#%#0#0\n",
        "a %#a/DET#%#%\n",
        "%#%#%#%\n",
        "{\"%\": \"%\"}",
        "{\"%\": 3}",
        "[\"%\"]",
        "[{\"clip\": \"%\", \"caption\": \"%#\"}]",
        "[{\"clip\": \"a\", \"caption\": \"a\", \"from\": \"%\"}]",
        "%: %\n",
        "- %\n",
        "name: %\njoints: {%: %}\n",
        "HIERARCHY\nROOT %\n{\n%",
        "HIERARCHY\nROOT a\n{\nOFFSET % 0 0",
    ];
    texts.iter().map(|text| text.replace('%', CANARY).into_bytes()).collect()
}

/// `seed` with the word at many places: between two bytes, and instead of what stands there.
fn within(seed: &[u8], places: usize) -> impl Iterator<Item = Vec<u8>> + '_ {
    let step = seed.len().div_ceil(places).max(1);
    (0..=seed.len()).step_by(step).flat_map(move |at| {
        let word = seed[at..].iter().take_while(|byte| byte.is_ascii_alphanumeric() || **byte == b'_').count();
        let long = seed[at..].len().min(CANARY.len());
        // As long as what it takes the place of, so that lengths that are written before it stay right.
        [0, word, long].map(|gone| [&seed[..at], CANARY.as_bytes(), &seed[at + gone..]].concat())
    })
}

/// Runs a target on all such files, with the word at so many `places` of each seed; it refuses errors that repeat the word.
pub fn run(target: &Target, places: usize) {
    for file in alone() {
        (target.run)(&file);
    }
    for seed in (target.seeds)() {
        for file in within(&seed, places) {
            (target.run)(&file);
        }
    }
}
