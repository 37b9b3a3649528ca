//! Identity of a store, and its row in the catalog.

use std::fmt;
use std::fs::File;
use std::io::{self, Read as _};
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The random name of a store: 32 hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct StoreId(String);

impl StoreId {
    /// Draws a new random name.
    pub(crate) fn random() -> io::Result<Self> {
        let mut bytes = [0_u8; 16];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Self(hex::encode(bytes)))
    }

    /// Returns the digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for StoreId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for StoreId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let hex = |c: char| c.is_ascii_digit() || ('a'..='f').contains(&c);
        if text.len() == 32 && text.chars().all(hex) {
            return Ok(Self(text.to_owned()));
        }
        Err(format!("`{text}` does not name a store: expected 32 hexadecimal digits"))
    }
}

impl TryFrom<String> for StoreId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<StoreId> for String {
    fn from(id: StoreId) -> Self {
        id.0
    }
}

/// The store's row in its database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stored {
    pub id: StoreId,
    /// Number of openings for writing; a commit under an older number is refused.
    pub epoch: u64,
    /// Number of committed transactions.
    pub commits: u64,
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn names_of_stores_differ_and_read_back() {
        let one = StoreId::random().unwrap();
        let other = StoreId::random().unwrap();
        assert_ne!(one, other);
        assert_eq!(one.to_string().parse(), Ok(one));
        assert!("../../a".parse::<StoreId>().is_err());
    }
}
