//! Every command of a document or of a help parses.

use clap::{CommandFactory as _, Parser as _};

use super::verbs::Cli;

#[test]
fn the_commands_of_the_documents_parse() {
    let commands = cluster_tests::documented::commands(&cluster_tests::Bench::repository(), "trainer");
    assert!(commands.len() >= 10, "{commands:#?}");
    for words in commands {
        if let Err(error) = Cli::try_parse_from(&words) {
            panic!("{}: {error}", words.join(" "));
        }
    }
}

/// The examples in the `--help` of a command and its subcommands. Each command that runs has one.
fn examples(command: &clap::Command, path: &str) -> Vec<String> {
    let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let own: Vec<String> = match help.split_once("Example") {
        None => Vec::new(),
        Some((_, listed)) => listed.lines().filter_map(|line| line.strip_prefix("  ").map(str::to_owned)).collect(),
    };
    let below: Vec<&clap::Command> = command.get_subcommands().filter(|command| !command.is_hide_set()).collect();
    assert!(!below.is_empty() || !own.is_empty(), "`{path}` has no example in its help");
    let below = below.into_iter().flat_map(|below| examples(below, &format!("{path} {}", below.get_name())));
    own.into_iter().chain(below).collect()
}

#[test]
fn the_examples_of_every_help_parse() {
    let command = Cli::command();
    let examples = examples(&command, "trainer");
    assert!(examples.len() >= 60, "{examples:#?}");
    for example in examples {
        let mut words = cluster_tests::documented::words(&example);
        if words[0] == "registry" {
            words.insert(0, "trainer".to_owned());
        }
        assert_eq!(words[0], "trainer", "{example}");
        let words: Vec<&String> = words.iter().take_while(|word| *word != ">").collect();
        if let Err(error) = Cli::try_parse_from(words) {
            panic!("{example}: {error}");
        }
    }
}

#[test]
fn options_are_consistent() {
    Cli::command().debug_assert();
}

#[test]
fn a_blank_token_is_refused_by_every_command() {
    for line in ["serve --token", "status --token", "worker join http://h:1 --token", "registry list --token"] {
        for token in ["", " ", "short"] {
            let words = ["trainer"].into_iter().chain(line.split(' ')).chain([token]);
            let error = Cli::try_parse_from(words).expect_err("no token").to_string();
            assert!(error.contains("the token"), "{line} {token:?}: {error}");
        }
    }
}
