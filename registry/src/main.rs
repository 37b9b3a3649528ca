//! The `registry` command, on a store's folder or through the server that holds it. All logic is in `registry::cli`.

use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use access::ServerOptions;
use clap::Parser;
use registry::cli::{OutputArg, Verb, execute};

/// Models, their versions, and the aliases that point at them
#[derive(Debug, Parser)]
#[command(name = "registry", version = env!("STRIDE_VERSION"), after_help = registry::cli::EXIT_CODES)]
struct Cli {
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", global = true)]
    store: PathBuf,
    #[command(flatten)]
    server: ServerOptions,
    /// Output format of the answer; for `export` also the file of a bundle, FILE.tar.zst
    #[arg(short, long, default_value = "table", value_name = "table|json", global = true)]
    output: OutputArg,
    #[command(subcommand)]
    verb: Verb,
}

fn main() -> ExitCode {
    registry::failpoints::arm_from_env();
    let cli = Cli::parse();
    if !matches!(cli.verb, Verb::Export { .. }) {
        // Files of a store belong to its user alone.
        nix::sys::stat::umask(nix::sys::stat::Mode::from_bits_truncate(0o077));
    }
    let runtime = match tokio::runtime::Runtime::new() {
        Ok(runtime) => runtime,
        Err(e) => {
            // The error is lost if stderr is closed.
            let _ = writeln!(std::io::stderr(), "error: no runtime: {e}");
            return ExitCode::FAILURE;
        }
    };
    ExitCode::from(runtime.block_on(execute(cli.verb, &cli.store, &cli.server, cli.output)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commands_of_the_documents_parse() {
        let commands = cluster_tests::documented::commands(&cluster_tests::Bench::repository(), "registry");
        assert!(commands.len() >= 8, "{commands:#?}");
        for words in commands {
            if let Err(error) = Cli::try_parse_from(&words) {
                panic!("{}: {error}", words.join(" "));
            }
        }
    }
}
