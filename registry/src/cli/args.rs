//! The command line, parsed into a [`Command`].

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Subcommand, ValueEnum};

use checkpoint::published::Layout;

use super::Command;
use crate::Place;
use crate::bundle::SUFFIX;
use crate::catalog::CatalogPlace;

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
    #[command(flatten)]
    Command(Command),
    /// Repairs a store whose blobs are missing or were moved, or whose database is older than its blobs
    #[command(after_help = "Example:\n  registry adopt")]
    Adopt {
        /// New location of the blobs: a folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX
        #[arg(long, value_name = "PLACE")]
        blobs: Option<Place>,
    },
    /// Makes or renews a backup of the store in a folder of this machine; runs continue meanwhile
    #[command(after_help = "Example:\n  registry backup /backups/stride")]
    Backup {
        /// The folder: empty, missing, or an older backup of this store
        dir: PathBuf,
    },
    /// Restores a store from a backup after verifying all of it
    #[command(after_help = "Example:\n  registry restore /backups/stride --to restored")]
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
    /// Moves a store's catalog between its folder (SQLite) and PostgreSQL, and verifies every row; the blobs stay
    #[command(
        after_help = "Example:\n  registry migrate --from .stride --to 'postgres://stride@db/stride?password-file=catalog'"
    )]
    Migrate {
        /// The store's folder, or postgres://USER@HOST/DATABASE?password-file=FILE
        #[arg(long, value_name = "CATALOG")]
        from: CatalogPlace,
        /// An empty database, or the folder that shall have the database
        #[arg(long, value_name = "CATALOG")]
        to: CatalogPlace,
    },
    /// Copies a version's files to a folder, or to one file for `import` on another machine
    #[command(after_help = "Example:\n  registry export quickstart@best -o quickstart.tar.zst")]
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
    #[command(after_help = "Example:\n  registry import quickstart.tar.zst --model quickstart")]
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
    /// Needs a store that no process holds, and its folder on this machine.
    Migrate { from: CatalogPlace, to: CatalogPlace },
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
                return Err("a bundle contains the whole version; use a layout or a bundle file, not both".into());
            }
            (Self::Export { model, dir: None, .. }, Some(file)) => {
                return Ok(Operation::Bundle { model: model.clone(), file });
            }
            (Self::Export { dir: Some(_), .. }, Some(_)) => {
                return Err("a folder and a bundle file are both given; use one of them".into());
            }
            (Self::Export { dir: None, .. }, None) => {
                return Err(format!("`export` needs a folder, or one file with `-o FILE{SUFFIX}`"));
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
        match self {
            Self::Command(command) => Operation::Command(command),
            Self::Backup { dir } => Operation::Backup { dir },
            Self::Restore { backup, to, blobs } => Operation::Restore { backup, to, blobs },
            Self::Adopt { blobs } => Operation::Adopt { blobs },
            Self::Migrate { from, to } => Operation::Migrate { from, to },
            Self::Export { model, dir, layout } => {
                Operation::Export { model, dir: dir.unwrap_or_default(), layout: layout.map(Layout::from) }
            }
            Self::Import { file, model } => Operation::Import { file, model },
        }
    }
}
