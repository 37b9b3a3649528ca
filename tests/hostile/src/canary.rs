//! Files that contain a secret word that no error may repeat. Users who may not read a file can read a worker's errors
//! about it.

use crate::Target;

/// The secret word.
pub const CANARY: &str = "qzcanaryzq";

/// Checks that an error does not quote the file.
///
/// # Panics
/// If it contains the word.
pub fn expect_absent(error: &str) {
    assert!(!error.to_ascii_lowercase().contains(CANARY), "an error quotes the file: {error}");
}

/// Files that consist of the word, or of lines and structures of it.
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

/// Copies of `seed` with the word at many places: inserted between two bytes, or replacing bytes.
fn within(seed: &[u8], places: usize) -> impl Iterator<Item = Vec<u8>> + '_ {
    let step = seed.len().div_ceil(places).max(1);
    (0..=seed.len()).step_by(step).flat_map(move |at| {
        let word = seed[at..].iter().take_while(|byte| byte.is_ascii_alphanumeric() || **byte == b'_').count();
        let long = seed[at..].len().min(CANARY.len());
        // One variant has the length of the replaced bytes, so that lengths written before it stay right.
        [0, word, long].map(|gone| [&seed[..at], CANARY.as_bytes(), &seed[at + gone..]].concat())
    })
}

/// Runs a target on all such files, with the word at `places` positions of each seed. It refuses errors that repeat the
/// word.
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
