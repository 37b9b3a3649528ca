//! Patterns of names: `nodes-*`, or several with commas between them.

use std::fmt;
use std::str::FromStr;

/// Names that a token may use. A `*` matches any text, including the empty one; each pattern has at most one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Names(Vec<String>);

impl Names {
    /// Returns true if a pattern matches the whole name.
    pub fn allow(&self, name: &str) -> bool {
        self.0.iter().any(|pattern| match pattern.split_once('*') {
            None => pattern == name,
            Some((start, end)) => {
                name.len() >= start.len() + end.len() && name.starts_with(start) && name.ends_with(end)
            }
        })
    }
}

impl fmt::Display for Names {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0.join(","))
    }
}

impl FromStr for Names {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let one = |pattern: &str| {
            // A pattern is valid if replacing its star by a letter makes a valid name.
            if protocol::id::is_name(&pattern.replacen('*', "a", 1)) {
                return Ok(pattern.to_owned());
            }
            Err(format!("`{pattern}` is not a name pattern; expected a name with at most one `*`, such as `nodes-*`"))
        };
        text.split(',').map(one).collect::<Result<_, _>>().map(Self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(text: &str) -> Result<Names, String> {
        text.parse()
    }

    #[test]
    fn a_pattern_fits_the_whole_name() {
        for (pattern, fits, others) in [
            ("nodes-*", vec!["nodes-1", "nodes-", "nodes-a-b"], vec!["nodes", "my-nodes-1", "Nodes-1", ""]),
            ("gpu1", vec!["gpu1"], vec!["gpu", "gpu11", "agpu1"]),
            ("*", vec!["a", "nodes-1"], vec![]),
            ("a*a", vec!["aa", "aba"], vec!["a", "ab", "ba"]),
            ("*.lab,gpu1", vec!["n.lab", "gpu1"], vec!["n.lab.evil", "gpu2"]),
        ] {
            let names = names(pattern).expect("a pattern");
            assert!(fits.iter().all(|name| names.allow(name)), "{pattern} fits {fits:?}");
            assert!(!others.iter().any(|name| names.allow(name)), "{pattern} fits none of {others:?}");
            assert_eq!(names.to_string(), pattern);
        }
    }

    #[test]
    fn what_is_no_pattern_is_refused() {
        for text in ["", ",", "a,", "a**", "*a*", "a b", "-*", "a/b", &"a".repeat(65)] {
            assert!(names(text).is_err_and(|error| error.contains("not a name pattern")), "{text}");
        }
    }
}
