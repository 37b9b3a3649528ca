//! `trainer explain`: sections of the book's troubleshooting page, by code.

use clap::Args;

use crate::report::print;
use crate::report::problem::{Problem, Result, exit};

/// The page. Each heading of the third level is a code.
const PAGE: &str = include_str!("../../../docs/book/src/troubleshooting.md");

#[derive(Debug, Args)]
pub(crate) struct ExplainArgs {
    /// The code of a message, or an exit code [default: lists all codes]
    code: Option<String>,
}

/// The codes of the page with their texts.
fn sections() -> impl Iterator<Item = (&'static str, &'static str)> {
    PAGE.split("\n### ").skip(1).filter_map(|section| {
        let (code, rest) = section.split_once('\n')?;
        Some((code, rest.split("\n## ").next().unwrap_or(rest).trim()))
    })
}

/// Removes the addresses of links: `[clusters](clusters.md)` becomes `clusters`.
fn plain(text: &str) -> String {
    let mut parts = text.split("](");
    let mut plain = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // A bracket that opens a link is the last one before it.
        if let Some(at) = plain.rfind('[') {
            plain.remove(at);
        }
        plain.push_str(part.split_once(')').map_or(part, |(_, rest)| rest));
    }
    plain
}

pub(crate) fn explain(args: &ExplainArgs) -> Result<u8> {
    let Some(asked) = &args.code else {
        let first = |text: &str| plain(text).split(". ").next().unwrap_or_default().replace('\n', " ");
        let rows = sections().map(|(code, text)| vec![code.to_owned(), first(text)]).collect();
        print::out(&print::table(&["CODE", "MEANS"], rows));
        return Ok(0);
    };
    let code = asked.parse().ok().and_then(exit::word).unwrap_or(asked);
    let Some((_, text)) = sections().find(|(known, _)| *known == code) else {
        let meant = protocol::spelling::question(asked, sections().map(|(code, _)| code));
        let problem = Problem::usage(format!("there is no code `{asked}`{meant}"));
        return Err(problem.hint("`trainer explain` lists all codes"));
    };
    print::out(&format!("{code}\n\n{}", plain(text)));
    Ok(0)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use protocol::message::{CODES, FailureClass};

    use super::*;

    /// Every class, by a match that a new one breaks.
    fn classes() -> Vec<String> {
        use FailureClass::{Damaged, Diverged, Fault, Infrastructure, Input, OutOfMemory, Refused, Storage};
        let all = [Input, Diverged, OutOfMemory, Refused, Storage, Damaged, Fault, Infrastructure];
        for class in all {
            match class {
                Input | Diverged | OutOfMemory | Refused | Storage | Damaged | Fault | Infrastructure => {}
            }
        }
        all.iter().map(|class| serde_json::to_value(class).unwrap().as_str().unwrap().to_owned()).collect()
    }

    #[test]
    fn the_page_explains_every_code_and_no_other() {
        let exits = exit::WORDS.iter().map(|(_, word)| (*word).to_owned());
        let api = CODES.iter().map(|(code, _)| (*code).to_owned());
        // The one code that `registry` has besides those of the API.
        let all: BTreeSet<String> = exits.chain(api).chain(classes()).chain(["store".to_owned()]).collect();
        let explained: Vec<String> = sections().map(|(code, _)| code.to_owned()).collect();
        assert!(explained.is_sorted(), "{explained:?}");
        assert_eq!(explained.iter().cloned().collect::<BTreeSet<_>>(), all);
        assert_eq!(explained.len(), all.len(), "each code once");
        let listed: BTreeSet<u8> =
            exit::HELP.lines().skip(1).filter_map(|line| line.split_whitespace().next()?.parse().ok()).collect();
        let words: BTreeSet<u8> = exit::WORDS.iter().map(|(code, _)| *code).chain([0]).collect();
        assert_eq!(listed, words, "exit codes of `--help`");
        for (code, text) in sections() {
            assert!(text.split_whitespace().count() >= 8, "{code}: {text}");
        }
    }

    #[test]
    fn links_lose_their_addresses() {
        assert_eq!(plain("see [the page](a.md#b) and [c](d)."), "see the page and c.");
        assert_eq!(plain("`[a, b]` is [one](x)"), "`[a, b]` is one");
    }
}
