//! The list of a set's files: one line each, `SHA-256 BYTES FRAMES NAME`.

use std::collections::BTreeMap;

/// A set of files in one archive.
#[derive(Debug, Clone)]
pub struct PublicSet {
    pub name: String,
    /// Address of the archive, a `.tar.gz`.
    pub archive: String,
    /// Text that accompanies the files: source, licence, citation.
    pub notice: String,
    /// The files by name.
    pub files: BTreeMap<String, Listed>,
}

/// A file of a set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Listed {
    /// SHA-256 in hexadecimal.
    pub sha256: String,
    pub bytes: u64,
    /// Number of frames of the recording.
    pub frames: usize,
}

impl PublicSet {
    /// Reads a list.
    ///
    /// # Errors
    /// The number of the first wrong line, and the expectation.
    pub fn new(name: &str, archive: &str, notice: &str, list: &str) -> Result<Self, String> {
        let mut files = BTreeMap::new();
        for (number, line) in list.lines().enumerate() {
            let wrong = || format!("{name}:{}: expected `SHA-256 BYTES FRAMES NAME`, each name once", number + 1);
            let (file, listed) = parse(line).ok_or_else(wrong)?;
            if files.insert(file, listed).is_some() {
                return Err(wrong());
            }
        }
        Ok(Self { name: name.into(), archive: archive.into(), notice: notice.into(), files })
    }

    /// Size of all files, in bytes.
    pub fn bytes(&self) -> u64 {
        self.files.values().map(|listed| listed.bytes).sum()
    }
}

fn parse(line: &str) -> Option<(String, Listed)> {
    let fields: Vec<&str> = line.split(' ').collect();
    let [sha256, bytes, frames, name] = fields[..] else { return None };
    let is_digest = sha256.len() == 64 && sha256.bytes().all(|c| c.is_ascii_digit() || (b'a'..=b'f').contains(&c));
    let is_name = !name.is_empty()
        && !name.starts_with('.')
        && name.bytes().all(|c| c.is_ascii_alphanumeric() || b"-_.".contains(&c));
    let listed = Listed { sha256: sha256.into(), bytes: bytes.parse().ok()?, frames: frames.parse().ok()? };
    (is_digest && is_name).then(|| (name.to_owned(), listed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_has_plain_names_and_no_name_twice() {
        let digest = "0a".repeat(32);
        let good = format!("{digest} 12 3 a_b-1.bvh\n");
        let set = PublicSet::new("x", "", "", &good).unwrap();
        assert_eq!((set.files["a_b-1.bvh"].frames, set.bytes()), (3, 12));
        let lines = [
            format!("{good}{good}"),
            good.replace("a_b", "../a"),
            good.replace("a_b", "."),
            good.replace("12", "x"),
            good.replace("0a0a", "0a0G"),
            good.replace(" 3", ""),
        ];
        for line in lines {
            assert!(PublicSet::new("x", "", "", &line).unwrap_err().starts_with("x:"), "{line}");
        }
    }
}
