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
}

/// The sets that `data list` shows. The book has instructions for sets that are not fetched.
pub const KNOWN: [Known; 5] = [
    Known {
        name: "bandai",
        title: "Bandai-Namco Research Motion Dataset",
        home: "https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset",
        licence: "CC BY-NC 4.0",
        licence_text: "https://creativecommons.org/licenses/by-nc/4.0/",
        recordings: 3_077,
        map: "bandai",
        fetched: true,
    },
    Known {
        name: "lafan1",
        title: "Ubisoft La Forge Animation Dataset",
        home: "https://github.com/ubisoft/ubisoft-laforge-animation-dataset",
        licence: "CC BY-NC-ND 4.0",
        licence_text: "",
        recordings: 77,
        map: "lafan1",
        fetched: false,
    },
    Known {
        name: "cmu",
        title: "CMU Graphics Lab Motion Capture Database, as BVH",
        home: "https://sites.google.com/a/cgspeed.com/cgspeed/motion-capture",
        licence: "see its page",
        licence_text: "",
        recordings: 0,
        map: "cmu",
        fetched: false,
    },
    Known {
        name: "snapmogen",
        title: "SnapMoGen",
        home: "https://huggingface.co/datasets/Ericguo5513/SnapMoGen",
        licence: "see its page",
        licence_text: "",
        recordings: 0,
        map: "",
        fetched: false,
    },
    Known {
        name: "bones-seed",
        title: "BONES-SEED",
        home: "https://nvlabs.github.io/ProtoMotions/getting_started/seed_bvh_preparation.html",
        licence: "see its page",
        licence_text: "",
        recordings: 0,
        map: "",
        fetched: false,
    },
];

impl Known {
    /// The command that fetches the set, or the address of its page.
    pub fn how(&self) -> String {
        if self.fetched { format!("trainer data fetch {}", self.name) } else { self.home.to_owned() }
    }
}

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
