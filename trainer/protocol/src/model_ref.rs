//! References to a version of a registered model: `motionlcm@prod`, `motionlcm@best`, `motionlcm@3`, `motionlcm:3`.

use std::fmt;
use std::str::FromStr;

use crate::id::ParseNameError;
use crate::{Alias, ModelName};

/// An alias that is a query: the best version by the model's metric. No version can be promoted to it.
pub const BEST: &str = "best";
/// An alias that is a query: the newest version, by number.
pub const LATEST: &str = "latest";

/// A user's reference to a model version: `quickstart@staging`, `quickstart@best`, `quickstart:3` or `quickstart@3`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelRef {
    pub model: ModelName,
    /// Selected version; `None` means the model as a whole.
    pub pick: Option<Pick>,
}

/// Selection of one version of a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Pick {
    /// The best version by the model's metric.
    Best,
    /// The newest version, by number.
    Latest,
    /// The version that an alias names.
    Alias(Alias),
    /// The version with this number.
    Number(u64),
}

/// Returns true if a name in a pipeline is that of a version. A stage's name has neither `@` nor `:`.
pub fn names_version(name: &str) -> bool {
    name.contains(['@', ':'])
}

/// Returns true if a text after `@` is a version's number, so that no alias may have it as name.
pub fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit())
}

impl FromStr for ModelRef {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad = |why: String| {
            format!("`{text}` is not a model version: {why}; expected `MODEL@ALIAS`, `MODEL@best` or `MODEL:VERSION`")
        };
        let name = |model: &str| model.parse::<ModelName>().map_err(|e| bad(e.to_string()));
        let number = |text: &str| text.parse().map(Pick::Number).map_err(|_| bad(format!("`{text}` is not a number")));
        if let Some((model, alias)) = text.split_once('@') {
            let pick = match alias {
                BEST => Pick::Best,
                LATEST => Pick::Latest,
                digits if is_number(digits) => number(digits)?,
                alias => Pick::Alias(alias.parse().map_err(|e: ParseNameError| bad(e.to_string()))?),
            };
            Ok(Self { model: name(model)?, pick: Some(pick) })
        } else if let Some((model, version)) = text.split_once(':') {
            Ok(Self { model: name(model)?, pick: Some(number(version.trim_start_matches('v'))?) })
        } else {
            Ok(Self { model: name(text)?, pick: None })
        }
    }
}

impl fmt::Display for ModelRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let model = &self.model;
        match &self.pick {
            None => write!(f, "{model}"),
            Some(Pick::Best) => write!(f, "{model}@{BEST}"),
            Some(Pick::Latest) => write!(f, "{model}@{LATEST}"),
            Some(Pick::Alias(alias)) => write!(f, "{model}@{alias}"),
            Some(Pick::Number(number)) => write!(f, "{model}:{number}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_read_as_they_are_written() {
        for text in ["m@staging", "m@best", "m@latest", "m:3", "m"] {
            assert_eq!(text.parse::<ModelRef>().unwrap().to_string(), text);
        }
        assert_eq!("m@3".parse::<ModelRef>(), "m:3".parse());
        for text in ["", "@x", "m@", "m:", "m:x", "a/b@x", "m@99999999999999999999"] {
            let error = text.parse::<ModelRef>().unwrap_err();
            assert!(error.contains("expected"), "{error}");
        }
    }
}
