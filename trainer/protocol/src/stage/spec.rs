//! The description of a stage kind: [`StageSpec`], implemented by its settings struct in the kind's file in `kinds/`.
//!
//! References are declared once, by [`StageSpec::refs`]. These follow from them: the edges of the DAG, the blank fields
//! of a stage's key, the evaluation of a sweep's trials, the digested files outside the store, the schema and the
//! reference of keys.

use std::any::Any;
use std::borrow::Cow;
use std::collections::BTreeSet;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{DataFormat, Family, LatentShape, Neighbours, Problems, Sampler, Training};
use crate::{ArtifactKind, Steps};

/// Distribution of a stage's work over workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Data parallel: all members step together.
    Gang,
    /// Divided into shards, each computed once by any worker, then merged.
    Map,
    /// Computed once by one worker.
    Plain,
    /// Run by the coordinator, because it changes the registry.
    Registry,
}

/// The only output of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Output {
    /// Name among the stage's results.
    pub name: &'static str,
    /// Kind of artifact.
    pub kind: ArtifactKind,
}

/// A stage kind. Its `Default` is the published recipe, if there is one, and the schema of its keys.
pub trait StageSpec:
    Default + Clone + PartialEq + std::fmt::Debug + Serialize + DeserializeOwned + JsonSchema + 'static
{
    /// Name in YAML, such as `train.vae`.
    const KIND: &'static str;
    /// Code version. It grows with each change of the kind's results, so that an old result is not reused as a new one.
    const VERSION: u32 = 1;
    /// Distribution of its work over workers.
    const SHAPE: Shape;
    /// Kind and name of its output.
    const OUTPUT: Output;

    /// Output with these settings, if it depends on them.
    fn output(&self) -> Output {
        Self::OUTPUT
    }

    /// Stages and files that it refers to.
    fn refs(&mut self) -> Vec<Ref<'_>>;

    /// Checks rules of the settings beyond their types.
    fn check(&self, _problems: &mut Problems) {}

    /// Checks rules between the settings and their referenced stages. Called once references are valid.
    fn check_neighbours(&self, _stages: &Neighbours<'_>, _problems: &mut Problems) {}

    /// Number of shards of a map stage.
    fn shards(&self) -> usize {
        1
    }

    /// Common settings of training stages. A kind that has them can be swept.
    fn training(&mut self) -> Option<&mut Training> {
        None
    }

    /// Shape of the latents that it outputs or uses, if it decides that.
    fn latent(&self) -> Option<LatentShape> {
        None
    }

    /// Skeleton of its output, if this stage decides it and none of its inputs.
    fn format(&self) -> Option<DataFormat> {
        None
    }

    /// Family of the model that it trains, which decides its samplers.
    fn family(&self) -> Option<Family> {
        None
    }

    /// Sampler for the model that it measures.
    fn sampler(&self) -> Option<&Sampler> {
        None
    }

    /// Names of the values that an evaluation may return, for any data; `None` if unknown.
    fn metrics(&self) -> Option<BTreeSet<String>> {
        None
    }

    /// Values that a training records after each step besides its gradient's norm and its learning rate. Retention can
    /// rank by them.
    fn recorded(&self) -> &'static [&'static str] {
        &[]
    }

    /// Steps at which the loss becomes another sum, so that its values before and after do not compare.
    fn loss_changes(&self) -> Vec<LossChange> {
        Vec::new()
    }
}

/// A step at which a training's loss becomes another sum.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LossChange {
    /// The first step with the new loss, counted from 0.
    pub at: u64,
    /// A sentence on the new loss, such as `the terms on joints join the loss`.
    pub what: &'static str,
    /// The setting that says when.
    pub setting: &'static str,
}

impl LossChange {
    /// The change behind `share` of `steps`, if it lies within them.
    pub(super) fn behind(share: f64, steps: Steps, what: &'static str, setting: &'static str) -> Option<Self> {
        let at = (steps.0 as f64 * share).round() as u64;
        (0 < at && at < steps.0).then_some(Self { at, what, setting })
    }
}

/// Target of a reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// A stage with an output of this kind.
    Stage(ArtifactKind),
    /// A folder of a dataset; only the files that a dataset of this format reads are digested.
    Dataset(DataFormat),
    /// A folder whose files are all digested.
    Folder,
    /// A file that is digested.
    File,
}

/// A reference in a stage's settings, with the place that holds the name.
#[derive(Debug)]
pub struct Ref<'a> {
    /// Field, such as `vae` or `from[0]`.
    pub field: Cow<'static, str>,
    /// Name of the stage, or a path.
    pub name: &'a mut String,
    /// Required target of the reference.
    pub target: Target,
    /// True if it is read with these settings. The place is blank in keys in either case.
    pub read: bool,
    /// True if an evaluation measures it.
    pub measured: bool,
    /// Files that the folder must have; `|` separates alternatives.
    pub files: &'static [&'static str],
    /// Description of the folder, and its source.
    pub origin: &'static str,
    /// Part of the model that is read, if it is not the whole model.
    pub part: Option<ArtifactKind>,
}

impl<'a> Ref<'a> {
    /// Reference to a stage with output `kind`.
    pub fn stage(field: impl Into<Cow<'static, str>>, name: &'a mut String, kind: ArtifactKind) -> Self {
        Self {
            field: field.into(),
            name,
            target: Target::Stage(kind),
            read: true,
            measured: false,
            files: &[],
            origin: "",
            part: None,
        }
    }

    /// Reference to the source of initial weights, a stage with output `kind` or with a model that has `part`. An empty
    /// name means random weights.
    pub fn init(name: &'a mut String, kind: ArtifactKind, part: ArtifactKind) -> Self {
        Self { part: Some(part), ..Self::stage("init", name, kind).optional() }
    }

    /// Reference to a dataset's folder.
    pub fn dataset(field: &'static str, path: &'a mut String, format: DataFormat) -> Self {
        let read = !path.is_empty();
        let target = Target::Dataset(format);
        let origin = match format {
            DataFormat::Humanml3d => "HumanML3D, built from AMASS as described in github.com/EricGuo5513/HumanML3D",
            DataFormat::Kit => "KIT-ML, linked in github.com/EricGuo5513/HumanML3D",
        };
        Self { field: field.into(), name: path, target, read, measured: false, files: &[], origin, part: None }
    }

    /// Reference to a folder; an empty path is no reference.
    pub fn folder(field: &'static str, path: &'a mut String) -> Self {
        let read = !path.is_empty();
        let target = Target::Folder;
        Self { field: field.into(), name: path, target, read, measured: false, files: &[], origin: "", part: None }
    }

    /// Reference to a file; an empty path is no reference.
    pub fn file(field: &'static str, path: &'a mut String) -> Self {
        Self { target: Target::File, ..Self::folder(field, path) }
    }

    /// Requires these files in the folder; `origin` describes the folder and its source.
    #[must_use]
    pub fn holding(self, files: &'static [&'static str], origin: &'static str) -> Self {
        Self { files, origin, ..self }
    }

    /// Reads it only if `condition` holds.
    #[must_use]
    pub fn only_if(self, condition: bool) -> Self {
        Self { read: self.read && condition, ..self }
    }

    /// Treats an empty name as no reference.
    #[must_use]
    pub fn optional(self) -> Self {
        let given = !self.name.is_empty();
        self.only_if(given)
    }

    /// Marks it as the subject of the evaluation, if `condition` holds.
    #[must_use]
    pub fn measured_if(self, condition: bool) -> Self {
        Self { measured: condition, ..self }
    }
}

/// Object-safe form of [`StageSpec`], for [`StageSettings`](super::StageSettings).
pub(super) trait AnySpec: Any {
    fn kind(&self) -> &'static str;
    fn version(&self) -> u32;
    fn shape(&self) -> Shape;
    fn output(&self) -> Output;
    fn schema(&self, generator: &mut SchemaGenerator) -> Schema;
    fn refs(&mut self) -> Vec<Ref<'_>>;
    fn check(&self, problems: &mut Problems);
    fn check_neighbours(&self, stages: &Neighbours<'_>, problems: &mut Problems);
    fn shards(&self) -> usize;
    fn training(&mut self) -> Option<&mut Training>;
    fn latent(&self) -> Option<LatentShape>;
    fn format(&self) -> Option<DataFormat>;
    fn family(&self) -> Option<Family>;
    fn sampler(&self) -> Option<&Sampler>;
    fn metrics(&self) -> Option<BTreeSet<String>>;
    fn recorded(&self) -> &'static [&'static str];
    fn loss_changes(&self) -> Vec<LossChange>;
}

impl<S: StageSpec> AnySpec for S {
    fn kind(&self) -> &'static str {
        S::KIND
    }

    fn version(&self) -> u32 {
        S::VERSION
    }

    fn shape(&self) -> Shape {
        S::SHAPE
    }

    fn output(&self) -> Output {
        StageSpec::output(self)
    }

    fn schema(&self, generator: &mut SchemaGenerator) -> Schema {
        S::json_schema(generator)
    }

    fn refs(&mut self) -> Vec<Ref<'_>> {
        StageSpec::refs(self)
    }

    fn check(&self, problems: &mut Problems) {
        StageSpec::check(self, problems);
    }

    fn check_neighbours(&self, stages: &Neighbours<'_>, problems: &mut Problems) {
        StageSpec::check_neighbours(self, stages, problems);
    }

    fn shards(&self) -> usize {
        StageSpec::shards(self)
    }

    fn training(&mut self) -> Option<&mut Training> {
        StageSpec::training(self)
    }

    fn latent(&self) -> Option<LatentShape> {
        StageSpec::latent(self)
    }

    fn format(&self) -> Option<DataFormat> {
        StageSpec::format(self)
    }

    fn family(&self) -> Option<Family> {
        StageSpec::family(self)
    }

    fn sampler(&self) -> Option<&Sampler> {
        StageSpec::sampler(self)
    }

    fn metrics(&self) -> Option<BTreeSet<String>> {
        StageSpec::metrics(self)
    }

    fn recorded(&self) -> &'static [&'static str] {
        StageSpec::recorded(self)
    }

    fn loss_changes(&self) -> Vec<LossChange> {
        StageSpec::loss_changes(self)
    }
}

/// Generates [`StageSettings`] from the list of kinds. The kind's own file holds everything else.
macro_rules! stage_kinds {
    ($($file:ident: $name:ident,)*) => {
        $(pub use $file::*;)*

        /// Settings of a stage of any kind. The kind's name is beside them as `kind`, in YAML as in JSON.
        #[derive(Debug, Clone, PartialEq)]
        pub enum StageSettings {
            $(#[doc = concat!("See [`", stringify!($name), "`].")] $name($name),)*
        }

        impl StageSettings {
            /// Every kind with default settings: the table from which the pipeline reader derives kinds, keys and
            /// types.
            pub fn all() -> Vec<Self> {
                vec![$(Self::$name($name::default()),)*]
            }

            pub(super) fn spec(&self) -> &dyn $crate::stage::spec::AnySpec {
                match self {
                    $(Self::$name(settings) => settings,)*
                }
            }

            pub(super) fn spec_mut(&mut self) -> &mut dyn $crate::stage::spec::AnySpec {
                match self {
                    $(Self::$name(settings) => settings,)*
                }
            }
        }

        $(
            impl From<$name> for StageSettings {
                fn from(settings: $name) -> Self {
                    Self::$name(settings)
                }
            }
        )*

        impl schemars::JsonSchema for StageSettings {
            fn schema_name() -> std::borrow::Cow<'static, str> {
                "StageSettings".into()
            }

            fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
                schemars::json_schema!({
                    "description": "Settings of a stage of any kind; `trainer schema` describes those of each.",
                    "type": "object",
                    "properties": {"kind": {"enum": [$($name::KIND),*]}},
                    "required": ["kind"],
                })
            }
        }

        impl serde::Serialize for StageSettings {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                #[derive(serde::Serialize)]
                struct Tagged<'a, T> {
                    kind: &'static str,
                    #[serde(flatten)]
                    settings: &'a T,
                }
                match self {
                    $(Self::$name(settings) => Tagged { kind: $name::KIND, settings }.serialize(serializer),)*
                }
            }
        }

        impl<'de> serde::Deserialize<'de> for StageSettings {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                use serde::de::Error;
                #[derive(serde::Deserialize)]
                struct Tagged {
                    kind: String,
                    #[serde(flatten)]
                    settings: serde_json::Map<String, serde_json::Value>,
                }
                let Tagged { kind, settings } = Tagged::deserialize(deserializer)?;
                $(if kind == $name::KIND {
                    return serde_json::from_value(settings.into()).map(Self::$name).map_err(D::Error::custom);
                })*
                Err(D::Error::unknown_variant(&kind, &[$($name::KIND,)*]))
            }
        }
    };
}
pub(super) use stage_kinds;
