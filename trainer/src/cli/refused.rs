//! Explains a refused command line.

use clap::CommandFactory as _;

use super::sentences;
use super::verbs::Cli;
use crate::report::problem::Problem;

/// Explains a refused command line that has a more probable reading than that of its grammar.
pub(super) fn explained(error: &clap::Error) -> Option<Problem> {
    let words = || std::env::args_os().skip(1);
    if error.kind() == clap::error::ErrorKind::MissingRequiredArgument && words().eq(["worker", "join"]) {
        let problem = Problem::usage("`trainer worker join` needs the address of a coordinator");
        return Some(problem.hint(
            "`trainer serve` starts one and prints the command with its address and token; `trainer run` starts its \
             own workers",
        ));
    }
    let text = || words().map(|word| word.to_string_lossy().into_owned());
    unknown_command(error, text()).or_else(|| sentences::without_quotes(error, words()))
}

/// Names the command that an unknown word probably means, where the parser knows none.
fn unknown_command(error: &clap::Error, words: impl Iterator<Item = String>) -> Option<Problem> {
    use clap::error::{ContextKind, ErrorKind};

    if error.kind() != ErrorKind::InvalidSubcommand || error.get(ContextKind::SuggestedSubcommand).is_some() {
        return None;
    }
    let mut command = Cli::command();
    for word in words.filter(|word| !word.starts_with('-')) {
        let Some(known) = command.find_subcommand(&word).cloned() else {
            let near = protocol::spelling::nearest(&word, command.get_subcommands().map(clap::Command::get_name))?;
            let problem = Problem::usage(format!("there is no command `{word}`"));
            return Some(problem.hint(format!("did you mean `{near}`? `trainer --help` lists the commands")));
        };
        command = known;
    }
    None
}
