//! Completions for shells and manual pages, generated from the declared arguments.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;

use crate::report::print;
use crate::report::problem::{Problem, Result};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  bash:  trainer completions bash > ~/.local/share/bash-completion/completions/trainer
  zsh:   trainer completions zsh > \"${fpath[1]}/_trainer\"
  fish:  trainer completions fish > ~/.config/fish/completions/trainer.fish")]
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

pub(crate) fn completions(args: &CompletionsArgs, mut command: Command) -> u8 {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, "trainer", &mut script);
    print::raw(&script);
    0
}

pub(crate) fn man(args: &ManArgs, command: Command) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot write to `{}`: {error}", args.folder.display()));
    std::fs::create_dir_all(&args.folder).map_err(failed)?;
    clap_mangen::generate_to(command, &args.folder).map_err(failed)?;
    print::note(&format!("the pages are in `{}`", args.folder.display()));
    Ok(0)
}
