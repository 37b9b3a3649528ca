//! Facts about published sets of motion.

use crate::dataset::list::PublicSet;

/// Commit of the Bandai-Namco Research Motion Dataset.
const COMMIT: &str = "74ead3ba1ae4696404e6086233779f60de8bf9ef";
/// Digests of the files of `bandai`.
const FILES: &str = include_str!("../../datasets/bandai.sha256");
/// Text beside the files of `bandai`.
const NOTICE: &str = include_str!("../../datasets/bandai.txt");

/// A published set.
#[derive(Debug, Clone, Copy)]
pub struct Known {
    pub name: &'static str,
    pub title: &'static str,
    /// Address of its page.
    pub home: &'static str,
    pub licence: &'static str,
    /// Address of the licence; empty if its page has it.
    pub licence_text: &'static str,
    /// Number of recordings that are published; 0 if it is not stated here.
    pub recordings: usize,
    /// Joint map that fits; empty if none is shipped.
    pub map: &'static str,
    /// True if `data fetch` fetches it.
    pub fetched: bool,
    /// How it is obtained and read.
    pub how: &'static str,
}

/// The sets that `data list` shows.
pub const KNOWN: [Known; 1] = [Known {
    name: "bandai",
    title: "Bandai-Namco Research Motion Dataset",
    home: "https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset",
    licence: "CC BY-NC 4.0",
    licence_text: "https://creativecommons.org/licenses/by-nc/4.0/",
    recordings: 3_077,
    map: "bandai",
    fetched: true,
    how: "trainer data fetch bandai",
}];

/// The 2,642 takes of the Bandai-Namco Research Motion Dataset that are used.
///
/// # Panics
/// If the list of this build is damaged.
#[expect(clippy::expect_used, reason = "a test reads the list")]
pub fn bandai() -> PublicSet {
    let repository = "BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset";
    let archive = format!("https://codeload.github.com/{repository}/tar.gz/{COMMIT}");
    PublicSet::new("bandai", &archive, NOTICE, FILES).expect("the shipped list is a list")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_of_bandai_has_its_files() {
        let set = bandai();
        assert_eq!((set.files.len(), set.bytes()), (2_642, 474_300_623));
        assert!(set.archive.ends_with(COMMIT) && set.notice.contains(COMMIT) && set.notice.contains("CC BY-NC 4.0"));
    }
}
