//! Commands: arguments of a command line, and requests to the process that holds the store.

use access::Scope;
use clap::{ArgAction, Subcommand};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::leaderboard::Style;
use crate::versions::Expect;

/// A request to a registry. Clients send it as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Subcommand)]
#[serde(tag = "command", rename_all = "kebab-case")]
pub enum Command {
    /// Lists models with their versions and aliases
    #[command(after_help = "Example:\n  registry list")]
    List,
    /// Shows a model with its versions, or one version with its files
    #[command(after_help = "Example:\n  registry show quickstart@staging")]
    Show {
        /// MODEL, MODEL@ALIAS, MODEL@best or MODEL:VERSION
        #[arg(value_name = "MODEL")]
        reference: String,
    },
    /// Shows the moves of a model's aliases: who, when, why, from and to which version
    #[command(after_help = "Example:\n  registry history quickstart")]
    History {
        /// The model
        model: String,
        /// Only this alias
        #[arg(long)]
        alias: Option<String>,
    },
    /// Points an alias at a version, if every gate holds
    #[command(
        after_help = "Example:\n  registry promote quickstart@best --to prod --require 'latent_fid <= 100' --reason 'looked at it'"
    )]
    Promote {
        /// MODEL@best, MODEL@ALIAS or MODEL:VERSION
        #[arg(value_name = "MODEL")]
        reference: String,
        /// The alias to move
        #[arg(long, value_name = "ALIAS")]
        to: String,
        /// Refuse unless the alias points at this version now (`none`: does not exist yet)
        #[arg(long, value_name = "VERSION|none")]
        expect: Option<Expect>,
        /// A gate such as 'latent_fid<=0.2' or 'latent_fid <= staging - 0.01'; may be repeated
        #[arg(long, value_name = "GATE")]
        require: Vec<String>,
        /// Reason for the log
        #[arg(long)]
        reason: String,
    },
    /// Points an alias back at the version before its last promotion
    #[command(after_help = "Example:\n  registry rollback quickstart --alias staging")]
    Rollback {
        /// The model
        model: String,
        /// The alias to move
        #[arg(long)]
        alias: String,
        /// Move to this version instead
        #[arg(long, value_name = "VERSION")]
        to: Option<u64>,
        /// Refuse unless the alias points at this version now
        #[arg(long, value_name = "VERSION")]
        expect: Option<Expect>,
        /// Reason for the log
        #[arg(long, default_value = "rollback")]
        reason: String,
    },
    /// Compares two versions metric by metric and marks differences beyond noise
    #[command(after_help = "Example:\n  registry compare quickstart:1 quickstart@best")]
    Compare {
        /// MODEL (its best version), MODEL@ALIAS or MODEL:VERSION
        left: String,
        /// The other version, in the same form
        right: String,
        /// Format of the table
        #[arg(long, value_enum, default_value_t)]
        style: Style,
    },
    /// Shows the metrics of every version in the papers' order, with the papers' rows
    #[command(after_help = "Example:\n  registry leaderboard quickstart")]
    Leaderboard {
        /// A model, or `humanml3d` or `kit` for all models of that data format
        of: String,
        /// Leave out the papers' rows
        #[arg(long = "no-published", action = ArgAction::SetFalse)]
        published: bool,
        /// Format of the table: `markdown` and `latex` give rows to paste
        #[arg(long, value_enum, default_value_t)]
        style: Style,
    },
    /// Shows the artifacts that a version or an artifact was made from
    #[command(after_help = "Example:\n  registry lineage quickstart@best")]
    Lineage {
        /// A model version or a digest
        #[arg(value_name = "ARTIFACT")]
        reference: String,
    },
    /// Shows the audit log of a server: who called what, from where, with what result; needs the scope `admin`
    #[command(after_help = "Example:\n  registry audit --limit 20")]
    Audit {
        /// Number of newest lines to show
        #[arg(long, value_name = "LINES", default_value_t = 100)]
        limit: usize,
    },
    /// Hashes every blob again and checks every reference
    #[command(after_help = "Example:\n  registry fsck")]
    Fsck,
    /// Removes blobs that are no longer needed
    #[command(after_help = "Example:\n  registry gc --dry-run")]
    Gc {
        /// Only show the blobs that would be removed
        #[arg(long)]
        dry_run: bool,
        /// Keep blobs that were stored in the last MINUTES minutes
        #[arg(long = "grace", value_name = "MINUTES", default_value = "60")]
        grace_minutes: Option<u32>,
    },
    /// Deletes ended runs, except data that models or other runs need; `gc` then frees the space
    #[command(after_help = "Example:\n  registry forget --ended-before 30d")]
    Forget {
        /// The run
        #[arg(required_unless_present_any = ["ended_before", "leftovers_before"])]
        run: Option<String>,
        /// All runs that ended longer ago than AGE, such as `30d`, `12h` or `90m`
        // On the wire a moment, in milliseconds since 1970.
        #[arg(long, value_name = "AGE", value_parser = before, conflicts_with = "run")]
        ended_before: Option<i64>,
        /// Only leftovers of runs that ended longer ago than AGE: sweep trials other than the best, and checkpoints of
        /// unfinished stages. Resuming such a run computes them again
        #[arg(long, value_name = "AGE", value_parser = before, conflicts_with_all = ["run", "ended_before"])]
        leftovers_before: Option<i64>,
    },
}

impl Command {
    /// Returns the scope that a token needs, whether the command changes nothing, and its words for a log.
    fn terms(&self) -> (Scope, bool, String) {
        use Scope::{Admin, Promote, Read};
        match self {
            Self::List => (Read, true, "list".into()),
            Self::Show { reference } => (Read, true, format!("show {reference}")),
            Self::History { model, .. } => (Read, true, format!("history {model}")),
            Self::Promote { reference, to, .. } => (Promote, false, format!("promote {reference} to {to}")),
            Self::Rollback { model, alias, .. } => (Promote, false, format!("rollback {model}@{alias}")),
            Self::Compare { left, right, .. } => (Read, true, format!("compare {left} {right}")),
            Self::Leaderboard { of, .. } => (Read, true, format!("leaderboard {of}")),
            Self::Lineage { reference } => (Read, true, format!("lineage {reference}")),
            Self::Audit { limit } => (Admin, true, format!("audit {limit}")),
            // Reads every byte of the store.
            Self::Fsck => (Admin, true, "fsck".into()),
            Self::Gc { dry_run: true, .. } => (Admin, true, "gc --dry-run".into()),
            Self::Gc { dry_run: false, .. } => (Admin, false, "gc".into()),
            Self::Forget { run: Some(run), .. } => (Admin, false, format!("forget {run}")),
            Self::Forget { leftovers_before: Some(at), .. } => {
                (Admin, false, format!("forget --leftovers-before {at}"))
            }
            Self::Forget { ended_before, .. } => {
                (Admin, false, format!("forget --ended-before {}", ended_before.unwrap_or_default()))
            }
        }
    }

    /// Returns the scope that a token needs for the command.
    pub fn scope(&self) -> Scope {
        self.terms().0
    }

    /// Returns true if the command changes nothing in the store and therefore needs no holder.
    pub fn only_reads(&self) -> bool {
        self.terms().1
    }

    /// Formats the command and its object for a log.
    pub fn in_short(&self) -> String {
        self.terms().2
    }

    /// Returns the model and alias that the command moves.
    pub fn moves(&self) -> Option<(&str, &str)> {
        match self {
            Self::Promote { reference, to, .. } => Some((reference, to)),
            Self::Rollback { model, alias, .. } => Some((model, alias)),
            _ => None,
        }
    }
}

/// Parses an age such as `30d` into the moment that long ago, in milliseconds since 1970.
fn before(text: &str) -> Result<i64, String> {
    let wrong = || {
        format!(
            "`{text}` is not an age: expected a whole number of days, hours or minutes, such as `30d`, `12h` or `90m`"
        )
    };
    let unit = match text.chars().last() {
        Some('d') => 24 * 60 * 60 * 1000,
        Some('h') => 60 * 60 * 1000,
        Some('m') => 60 * 1000,
        _ => return Err(wrong()),
    };
    let number: u32 = text[..text.len() - 1].parse().map_err(|_| wrong())?;
    Ok(crate::clock::now_ms().saturating_sub(i64::from(number) * unit))
}
