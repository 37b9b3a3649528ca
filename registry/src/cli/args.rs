//! The command line: what users type, turned into a [`Command`].

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Subcommand, ValueEnum};

use checkpoint::published::Layout;

use super::Command;
use crate::Place;
use crate::bundle::SUFFIX;
use crate::leaderboard::Style;
use crate::versions::Expect;

/// How answers are printed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum Output {
    /// For people.
    #[default]
    Table,
    /// For programs: one object on stdout; errors as one object on stderr.
    Json,
}

/// In whose files weights are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LayoutName {
    /// A file of MLD's and MotionLCM's: VAE, denoiser, control parts under `state_dict`
    Motionlcm,
    /// Three files: tokenizer, masked and residual transformer
    Momask,
    /// Two files: tokenizer and transformer
    T2mgpt,
    /// A file: the network
    Mdm,
    /// One safetensors file of any model, each part's names behind its role
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

/// What stands behind `-o`: how the answer is printed, or where `export` writes a bundle.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum OutputArg {
    /// As [`Output::Table`].
    #[default]
    Table,
    /// As [`Output::Json`].
    Json,
    /// A bundle's file.
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
    /// How the answer is printed, and the bundle's file.
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
    /// Shows who moved an alias, when, why, from where and to where
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
        /// Why, for the log
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
        /// To this version instead
        #[arg(long, value_name = "VERSION")]
        to: Option<u64>,
        /// Refuse unless the alias points at this version now
        #[arg(long, value_name = "VERSION")]
        expect: Option<Expect>,
        /// Why, for the log
        #[arg(long, default_value = "rollback")]
        reason: String,
    },
    /// Compares two versions metric by metric, and says which differences are beyond noise
    Compare {
        /// MODEL (its best version), MODEL@ALIAS or MODEL:VERSION
        left: String,
        /// Likewise
        right: String,
        /// How the table is written
        #[arg(long, value_enum, default_value_t)]
        style: Style,
    },
    /// Shows every version's metrics in the papers' order, beside the papers' own
    Leaderboard {
        /// A model, or `humanml3d` or `kit` for all models of that data format
        of: String,
        /// Leave the papers' rows out
        #[arg(long)]
        no_published: bool,
        /// How the table is written: `markdown` and `latex` give rows to paste
        #[arg(long, value_enum, default_value_t)]
        style: Style,
    },
    /// Shows what a version or an artifact was made of
    Lineage {
        /// A model version or a digest
        artifact: String,
    },
    /// Shows who called what of the server, from where, and what came of it; of a server for tokens with the scope `admin`
    Audit {
        /// The newest lines
        #[arg(long, value_name = "LINES", default_value_t = 100)]
        limit: usize,
    },
    /// Hashes every blob again and follows every reference
    Fsck,
    /// Removes blobs that nothing needs
    Gc {
        /// Only show what would be removed
        #[arg(long)]
        dry_run: bool,
        /// Keep blobs that were stored in the last so many minutes
        #[arg(long, value_name = "MINUTES", default_value_t = 60)]
        grace: u32,
    },
    /// Goes on with what is left of a store whose blobs are missing or were moved, or whose database has gone back
    Adopt {
        /// Where the blobs are now: a folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX
        #[arg(long, value_name = "PLACE")]
        blobs: Option<Place>,
    },
    /// Forgets runs that have ended, but not what models are made of or other runs need; `gc` then frees the space
    Forget {
        /// The run
        #[arg(required_unless_present_any = ["ended_before", "leftovers_before"])]
        run: Option<String>,
        /// All runs that ended longer ago than this, such as `30d`, `12h` or `90m`
        #[arg(long, value_name = "AGE", value_parser = age, conflicts_with = "run")]
        ended_before: Option<i64>,
        /// Of all runs that ended longer ago than this only what nobody needs to look at them: trials of sweeps that are not the
        /// best, and checkpoints of stages that were never finished. To resume such a run is to compute that anew
        #[arg(long, value_name = "AGE", value_parser = age, conflicts_with_all = ["run", "ended_before"])]
        leftovers_before: Option<i64>,
    },
    /// Makes or renews a backup of the store in a folder of this machine, while runs go on
    Backup {
        /// The folder: empty, missing, or an older backup of this store
        dir: PathBuf,
    },
    /// Makes a store of a backup, once all of it was verified
    Restore {
        /// The backup's folder
        backup: PathBuf,
        /// The store's folder; it must be empty or missing
        #[arg(long, value_name = "DIR")]
        to: PathBuf,
        /// Where its blobs are to lie, instead of in that folder: another one, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or
        /// az://CONTAINER/PREFIX. They may be there already
        #[arg(long, value_name = "PLACE")]
        blobs: Option<Place>,
    },
    /// Copies a version's files to a folder, or to one file that `import` reads on another machine
    Export {
        /// MODEL@ALIAS, MODEL@best or MODEL:VERSION
        model: String,
        /// The folder, which must be empty or missing; or with `-o`, a bundle's file, FILE.tar.zst
        dir: Option<PathBuf>,
        /// The weights alone, in the files and under the names of the code that published such models; of a layout of one file, `DIR` is the file, which must be missing
        #[arg(long, value_enum)]
        layout: Option<LayoutName>,
    },
    /// Registers the version in a bundle's file that `export -o FILE.tar.zst` wrote
    Import {
        /// The bundle
        file: PathBuf,
        /// Register it as a version of this model instead of what it was called there
        #[arg(long, value_name = "NAME")]
        model: Option<String>,
    },
}

/// What a verb comes to.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Asked {
    /// A command for the holder of the store.
    Command(Command),
    /// Something that ends in this machine's files.
    Export { model: String, dir: PathBuf, layout: Option<Layout> },
    /// Likewise, in one file.
    Bundle { model: String, file: PathBuf },
    /// A file of this machine, into a store that need not be there yet.
    Import { file: PathBuf, model: Option<String> },
    /// Likewise, and only of a store whose folder this machine has.
    Backup { dir: PathBuf },
    /// Likewise, of no store yet.
    Restore { backup: PathBuf, to: PathBuf, blobs: Option<Place> },
    /// Only of a store that no process holds.
    Adopt { blobs: Option<Place> },
}

impl Verb {
    /// What is asked, and whether it is of the store's holder alone.
    ///
    /// # Errors
    /// What `file` behind `-o` has to do with it, if that is nothing.
    pub(super) fn asks(self, file: Option<PathBuf>) -> Result<Asked, String> {
        let is_bundle = |path: &PathBuf| path.to_string_lossy().ends_with(SUFFIX);
        match (&self, file) {
            (Self::Export { layout: Some(_), .. }, Some(_)) => {
                return Err("a bundle holds the whole version; name a layout, or a bundle's file".into());
            }
            (Self::Export { model, dir: None, .. }, Some(file)) => {
                return Ok(Asked::Bundle { model: model.clone(), file });
            }
            (Self::Export { dir: Some(_), .. }, Some(_)) => {
                return Err("a folder and a bundle's file are named; name one of them".into());
            }
            (Self::Export { dir: None, .. }, None) => {
                return Err(format!("`export` writes to a folder, or with `-o FILE{SUFFIX}` to one file; name one"));
            }
            (Self::Export { model, dir: Some(file), layout: None }, None) if is_bundle(file) => {
                return Ok(Asked::Bundle { model: model.clone(), file: file.clone() });
            }
            (_, Some(file)) => {
                return Err(format!("`-o {}` is for `export`; expected `table` or `json`", file.display()));
            }
            (_, None) => {}
        }
        Ok(self.other())
    }

    /// What is asked by a verb that writes no bundle.
    fn other(self) -> Asked {
        Asked::Command(match self {
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
            Self::Backup { dir } => return Asked::Backup { dir },
            Self::Restore { backup, to, blobs } => return Asked::Restore { backup, to, blobs },
            Self::Adopt { blobs } => return Asked::Adopt { blobs },
            Self::Export { model, dir, layout } => {
                let (dir, layout) = (dir.unwrap_or_default(), layout.map(Layout::from));
                return Asked::Export { model, dir, layout };
            }
            Self::Import { file, model } => return Asked::Import { file, model },
        })
    }
}

/// A time as people write it, in milliseconds.
fn age(text: &str) -> Result<i64, String> {
    let wrong = || {
        format!("`{text}` is no age: expected a whole number of days, hours or minutes, such as `30d`, `12h` or `90m`")
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
