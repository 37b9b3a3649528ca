//! The command line, parsed into a [`Command`].

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Subcommand, ValueEnum};

use checkpoint::published::Layout;

use super::Command;
use crate::Place;
use crate::bundle::SUFFIX;
use crate::leaderboard::Style;
use crate::versions::Expect;

/// Output format of answers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Output {
    /// Tables for people
    #[default]
    Table,
    /// One JSON object on stdout; errors as one object on stderr
    Json,
}

/// File layout of exported weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LayoutName {
    /// One file of MLD and MotionLCM: VAE, denoiser, control parts under `state_dict`
    Motionlcm,
    /// Three files: tokenizer, masked and residual transformer
    Momask,
    /// Two files: tokenizer and transformer
    T2mgpt,
    /// One file: the network
    Mdm,
    /// One safetensors file of any model, with the role before each name
    Safetensors,
}

impl From<LayoutName> for Layout {
    fn from(name: LayoutName) -> Self {
        match name {
            LayoutName::Motionlcm => Self::MotionLcm,
            LayoutName::Momask => Self::Momask,
            LayoutName::T2mgpt => Self::T2mGpt,
            LayoutName::Mdm => Self::Mdm,
            LayoutName::Safetensors => Self::Safetensors,
        }
    }
}

/// Value of `-o`: an output format, or for `export` a bundle's file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum OutputArg {
    /// Same as [`Output::Table`].
    #[default]
    Table,
    /// Same as [`Output::Json`].
    Json,
    /// The path of a bundle.
    Bundle(PathBuf),
}

impl FromStr for OutputArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "table" => Ok(Self::Table),
            "json" => Ok(Self::Json),
            file if file.ends_with(SUFFIX) => Ok(Self::Bundle(file.into())),
            _ => Err(format!("expected `table`, `json`, or for `export` a file whose name ends in `{SUFFIX}`")),
        }
    }
}

impl OutputArg {
    /// Returns the output format and the bundle's file.
    pub(super) fn split(self) -> (Output, Option<PathBuf>) {
        match self {
            Self::Table => (Output::Table, None),
            Self::Json => (Output::Json, None),
            Self::Bundle(file) => (Output::Table, Some(file)),
        }
    }
}

/// A verb with its arguments.
#[derive(Debug, Clone, Subcommand)]
pub enum Verb {
    /// Lists models with their versions and aliases
    List,
    /// Shows a model with its versions, or one version with its files
    Show {
        /// MODEL, MODEL@ALIAS, MODEL@best or MODEL:VERSION
        model: String,
    },
    /// Shows the moves of a model's aliases: who, when, why, from and to which version
    History {
        /// The model
        model: String,
        /// Only this alias
        #[arg(long)]
        alias: Option<String>,
    },
    /// Points an alias at a version, if every gate holds
    Promote {
        /// MODEL@best, MODEL@ALIAS or MODEL:VERSION
        model: String,
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
    Leaderboard {
        /// A model, or `humanml3d` or `kit` for all models of that data format
        of: String,
        /// Leave out the papers' rows
        #[arg(long)]
        no_published: bool,
        /// Format of the table: `markdown` and `latex` give rows to paste
        #[arg(long, value_enum, default_value_t)]
        style: Style,
    },
    /// Shows the artifacts that a version or an artifact was made from
    Lineage {
        /// A model version or a digest
        artifact: String,
    },
    /// Shows the audit log of a server: who called what, from where, with what result; needs the scope `admin`
    Audit {
        /// Number of newest lines to show
        #[arg(long, value_name = "LINES", default_value_t = 100)]
        limit: usize,
    },
    /// Hashes every blob again and checks every reference
    Fsck,
    /// Removes blobs that are no longer needed
    Gc {
        /// Only show the blobs that would be removed
        #[arg(long)]
        dry_run: bool,
        /// Keep blobs that were stored in the last MINUTES minutes
        #[arg(long, value_name = "MINUTES", default_value_t = 60)]
        grace: u32,
    },
    /// Repairs a store whose blobs are missing or were moved, or whose database is older than its blobs
    Adopt {
        /// New location of the blobs: a folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX
        #[arg(long, value_name = "PLACE")]
        blobs: Option<Place>,
    },
    /// Deletes ended runs, except data that models or other runs need; `gc` then frees the space
    Forget {
        /// The run
        #[arg(required_unless_present_any = ["ended_before", "leftovers_before"])]
        run: Option<String>,
        /// All runs that ended longer ago than AGE, such as `30d`, `12h` or `90m`
        #[arg(long, value_name = "AGE", value_parser = age, conflicts_with = "run")]
        ended_before: Option<i64>,
        /// Only leftovers of runs that ended longer ago than AGE: sweep trials other than the best, and checkpoints of
        /// unfinished stages. Resuming such a run computes them again
        #[arg(long, value_name = "AGE", value_parser = age, conflicts_with_all = ["run", "ended_before"])]
        leftovers_before: Option<i64>,
    },
    /// Makes or renews a backup of the store in a folder of this machine; runs continue meanwhile
    Backup {
        /// The folder: empty, missing, or an older backup of this store
        dir: PathBuf,
    },
    /// Restores a store from a backup after verifying all of it
    Restore {
        /// The backup's folder
        backup: PathBuf,
        /// The store's folder; it must be empty or missing
        #[arg(long, value_name = "DIR")]
        to: PathBuf,
        /// Location of the blobs, instead of that folder: another folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or
        /// az://CONTAINER/PREFIX. Blobs that are already there are kept
        #[arg(long, value_name = "PLACE")]
        blobs: Option<Place>,
    },
    /// Copies a version's files to a folder, or to one file for `import` on another machine
    Export {
        /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
        model: String,
        /// The folder, which must be empty or missing; or with `-o` a bundle's file, FILE.tar.zst
        dir: Option<PathBuf>,
        /// Export only the weights, in the files and names of the code that published such models. For a layout with
        /// one file, DIR is that file and must not exist
        #[arg(long, value_enum)]
        layout: Option<LayoutName>,
    },
    /// Registers the version in a bundle's file that `export -o FILE.tar.zst` wrote
    Import {
        /// The bundle's file
        file: PathBuf,
        /// Register it as a version of this model instead of its original name
        #[arg(long, value_name = "NAME")]
        model: Option<String>,
    },
}

/// Operation that a verb requests.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Operation {
    /// A command for the holder of the store.
    Command(Command),
    /// Writes files on this machine.
    Export { model: String, dir: PathBuf, layout: Option<Layout> },
    /// Writes one file on this machine.
    Bundle { model: String, file: PathBuf },
    /// Imports a file of this machine into a store, which is created if missing.
    Import { file: PathBuf, model: Option<String> },
    /// Needs the store's folder on this machine.
    Backup { dir: PathBuf },
    /// Creates a store from a backup on this machine.
    Restore { backup: PathBuf, to: PathBuf, blobs: Option<Place> },
    /// Needs a store that no process holds.
    Adopt { blobs: Option<Place> },
}

impl Verb {
    /// Returns the requested operation; `file` is the bundle's file of `-o`.
    ///
    /// # Errors
    /// Describes the conflict if the verb cannot use `file`.
    pub(super) fn operation(self, file: Option<PathBuf>) -> Result<Operation, String> {
        let is_bundle = |path: &PathBuf| path.to_string_lossy().ends_with(SUFFIX);
        match (&self, file) {
            (Self::Export { layout: Some(_), .. }, Some(_)) => {
                return Err("a bundle holds the whole version; use a layout or a bundle's file, not both".into());
            }
            (Self::Export { model, dir: None, .. }, Some(file)) => {
                return Ok(Operation::Bundle { model: model.clone(), file });
            }
            (Self::Export { dir: Some(_), .. }, Some(_)) => {
                return Err("both a folder and a bundle's file are given; use one of them".into());
            }
            (Self::Export { dir: None, .. }, None) => {
                return Err(format!("`export` writes to a folder, or with `-o FILE{SUFFIX}` to one file; name one"));
            }
            (Self::Export { model, dir: Some(file), layout: None }, None) if is_bundle(file) => {
                return Ok(Operation::Bundle { model: model.clone(), file: file.clone() });
            }
            (_, Some(file)) => {
                return Err(format!("`-o {}` is for `export`; expected `table` or `json`", file.display()));
            }
            (_, None) => {}
        }
        Ok(self.other())
    }

    /// Returns the operation of a verb that writes no bundle.
    fn other(self) -> Operation {
        Operation::Command(match self {
            Self::List => Command::List,
            Self::Show { model } => Command::Show { reference: model },
            Self::History { model, alias } => Command::History { model, alias },
            Self::Promote { model, to, expect, require, reason } => {
                Command::Promote { reference: model, to, expect, require, reason }
            }
            Self::Rollback { model, alias, to, expect, reason } => {
                Command::Rollback { model, alias, to, expect, reason }
            }
            Self::Compare { left, right, style } => Command::Compare { left, right, style },
            Self::Leaderboard { of, no_published, style } => {
                Command::Leaderboard { of, published: !no_published, style }
            }
            Self::Lineage { artifact } => Command::Lineage { reference: artifact },
            Self::Audit { limit } => Command::Audit { limit },
            Self::Fsck => Command::Fsck,
            Self::Gc { dry_run, grace } => Command::Gc { dry_run, grace_minutes: Some(grace) },
            Self::Forget { run: Some(run), .. } => Command::Forget { run },
            Self::Forget { leftovers_before: Some(age_ms), .. } => {
                Command::ForgetLeftovers { before_ms: crate::clock::now_ms().saturating_sub(age_ms) }
            }
            Self::Forget { ended_before, .. } => {
                let age_ms = ended_before.unwrap_or(i64::MAX);
                Command::ForgetEnded { before_ms: crate::clock::now_ms().saturating_sub(age_ms) }
            }
            Self::Backup { dir } => return Operation::Backup { dir },
            Self::Restore { backup, to, blobs } => return Operation::Restore { backup, to, blobs },
            Self::Adopt { blobs } => return Operation::Adopt { blobs },
            Self::Export { model, dir, layout } => {
                let (dir, layout) = (dir.unwrap_or_default(), layout.map(Layout::from));
                return Operation::Export { model, dir, layout };
            }
            Self::Import { file, model } => return Operation::Import { file, model },
        })
    }
}

/// Parses an age such as `30d` into milliseconds.
fn age(text: &str) -> Result<i64, String> {
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
    Ok(i64::from(number) * unit)
}
