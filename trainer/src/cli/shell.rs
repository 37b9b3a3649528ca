//! Completions for shells and manual pages, generated from the declared arguments. Names of runs, models and stages are
//! asked for while the user types: the scripts call `trainer names`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Command};
use clap_complete::Shell;
use registry::RunListQuery;
use registry::cli::{Command as RegistryCommand, Data};

use crate::client::Target;
use crate::reader::Reader;
use crate::report::print;
use crate::report::problem::{Problem, Result};

/// Longest wait for names; a shell waits too.
const PATIENCE: Duration = Duration::from_secs(2);
/// Number of newest runs that are completed.
const RUNS: u32 = 50;

/// Adds names to the generated script. Bash splits words at `@`, `:` and `=`, so only the rest of a word is completed.
const BASH: &str = r#"
_trainer_with_names() {
    _trainer "$@"
    local line="${COMP_LINE:0:COMP_POINT}"
    local word="${line##* }"
    case "$word" in -*) return ;; esac
    local found
    found=$(compgen -W "$(trainer names -- "${line%"$word"}" 2>/dev/null)" -- "$word")
    [ -n "$found" ] || return
    COMPREPLY=()
    local head="${word%"${word##*[@:=]}"}" name
    while IFS= read -r name; do COMPREPLY+=("${name#"$head"}"); done <<<"$found"
}
complete -F _trainer_with_names -o nosort -o bashdefault -o default trainer
"#;
const FISH: &str = r#"
complete -c trainer -f -n "test -n \"(trainer names -- (commandline -cp) 2>/dev/null)\"" -a "(trainer names -- (commandline -cp) 2>/dev/null)"
"#;
/// Parts of the script for zsh that name runs and models, each with its replacement.
const ZSH: [(&str, &str); 3] = [
    (":run -- ", r#"{compadd -- ${(f)"$(trainer names -- "status ")"}}"#),
    (":MODEL:", r#"{compadd -- ${(f)"$(trainer names -- "time ")"}}"#),
    (":RUN:", r#"{compadd -- ${(f)"$(trainer names -- "status ")"}}"#),
];

#[derive(Debug, Args)]
#[command(after_help = "\
Names of runs, models and stages are completed too, from the store in `.stride` or STRIDE_STORE.

Examples:
  trainer completions bash > ~/.local/share/bash-completion/completions/trainer
  trainer completions zsh > \"${fpath[1]}/_trainer\"
  trainer completions fish > ~/.config/fish/completions/trainer.fish")]
pub(crate) struct CompletionsArgs {
    /// The shell that completes
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(Debug, Args)]
#[command(after_help = "\
Example:
  trainer man ~/.local/share/man/man1")]
pub(crate) struct ManArgs {
    /// The folder for the pages, one per command
    #[arg(value_name = "FOLDER")]
    folder: PathBuf,
}

#[derive(Debug, Args)]
pub(crate) struct NamesArgs {
    /// The line before the word, as one argument or as its words
    #[arg(last = true)]
    line: Vec<String>,
}

pub(crate) fn completions(args: &CompletionsArgs, mut command: Command) -> u8 {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, "trainer", &mut script);
    let mut script = String::from_utf8_lossy(&script).into_owned();
    match args.shell {
        Shell::Bash => script += BASH,
        Shell::Fish => script += FISH,
        Shell::Zsh => script = with_names_of_zsh(&script),
        _ => {}
    }
    print::raw(script.as_bytes());
    0
}

/// Replaces the completion by files where an argument is a run or a model.
fn with_names_of_zsh(script: &str) -> String {
    let line = |line: &str| match ZSH.iter().find(|(part, _)| line.contains(part)) {
        // An apostrophe would end the quoted argument of `_arguments`; the replacement has none.
        Some((_, names)) => line.replace(":_default'", &format!(":{names}'")),
        None => line.to_owned(),
    };
    script.lines().map(|text| line(text) + "\n").collect()
}

pub(crate) fn man(args: &ManArgs, command: Command) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot write to `{}`: {error}", args.folder.display()));
    std::fs::create_dir_all(&args.folder).map_err(failed)?;
    clap_mangen::generate_to(command, &args.folder).map_err(failed)?;
    print::note(&format!("the pages are in `{}`", args.folder.display()));
    Ok(0)
}

/// A kind of names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Runs,
    Models,
    Stages,
}

/// The kind of names that the next word of a command line may be.
fn kind(words: &[&str]) -> Option<Kind> {
    match words.last() {
        Some(&("--model" | "-m" | "--control-from" | "--control-part")) => return Some(Kind::Models),
        Some(&"--run") => return Some(Kind::Runs),
        Some(&("--stage" | "--until")) => return Some(Kind::Stages),
        // The value of another option.
        Some(last) if last.starts_with("--") && !["--follow", "--all", "--plot"].contains(last) => return None,
        _ => {}
    }
    let mut words = words.iter().filter(|word| !word.starts_with('-') && **word != "trainer");
    match *words.next()? {
        "status" | "logs" | "metrics" | "cancel" | "pause" | "resume" | "gallery" => Some(Kind::Runs),
        "sweep" => words.next().map(|_| Kind::Runs),
        "time" => Some(Kind::Models),
        "registry" => match *words.next()? {
            "forget" => Some(Kind::Runs),
            "show" | "history" | "promote" | "rollback" | "compare" | "leaderboard" | "lineage" | "export" => {
                Some(Kind::Models)
            }
            _ => None,
        },
        _ => None,
    }
}

/// Prints the names that may follow, one per line. An unreadable store has none, because a shell shows no errors.
pub(crate) async fn names(args: &NamesArgs) -> Result<u8> {
    let line = args.line.join(" ");
    let words: Vec<&str> = line.split_whitespace().collect();
    let Some(kind) = kind(&words) else { return Ok(0) };
    let store = words.iter().position(|word| *word == "--store").and_then(|at| words.get(at + 1)).map(PathBuf::from);
    let store = store.or_else(|| std::env::var_os("STRIDE_STORE").map(PathBuf::from));
    let target = Target { store: store.unwrap_or_else(|| ".stride".into()), server: Default::default() };
    if let Ok(Ok(names)) = tokio::time::timeout(PATIENCE, list(kind, &target)).await {
        print::raw(names.into_iter().map(|name| name + "\n").collect::<String>().as_bytes());
    }
    Ok(0)
}

async fn list(kind: Kind, target: &Target) -> Result<Vec<String>> {
    let reader = Reader::open(target).await?;
    let names = match kind {
        Kind::Runs => {
            let asked = RunListQuery { limit: RUNS, ..RunListQuery::default() };
            let runs = reader.run_list(&asked).await?.items;
            let last = (!runs.is_empty()).then(|| "@last".to_owned());
            last.into_iter().chain(runs.into_iter().map(|row| row.run.to_string())).collect()
        }
        Kind::Stages => {
            let newest = reader.newest(None).await?;
            let stages = newest.iter().flat_map(|run| &run.stages).filter(|stage| stage.of.is_none());
            stages.map(|stage| stage.name.to_string()).collect()
        }
        Kind::Models => match reader.registry(&RegistryCommand::List).await?.data {
            Some(Data::Models { models }) => models
                .iter()
                .flat_map(|model| {
                    let best = model.best.map(|_| "best".to_owned());
                    let aliases = best.into_iter().chain(model.aliases.keys().cloned());
                    let of = |alias: String| format!("{}@{alias}", model.model);
                    aliases.map(of).chain([model.model.to_string()]).collect::<Vec<_>>()
                })
                .collect(),
            _ => Vec::new(),
        },
    };
    reader.close().await;
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_word_is_a_name_of_its_kind() {
        let of = |line: &str| kind(&line.split_whitespace().collect::<Vec<_>>());
        for line in ["trainer status ", "trainer logs --follow ", "trainer sweep best ", "trainer generate --run "] {
            assert_eq!(of(line), Some(Kind::Runs), "{line}");
        }
        for line in ["trainer generate walk -m ", "trainer registry compare a@best ", "trainer time "] {
            assert_eq!(of(line), Some(Kind::Models), "{line}");
        }
        assert_eq!(of("trainer logs --stage "), Some(Kind::Stages));
        for line in ["trainer ", "trainer run ", "trainer status --store ", "trainer registry ", ""] {
            assert_eq!(of(line), None, "{line}");
        }
    }
}
