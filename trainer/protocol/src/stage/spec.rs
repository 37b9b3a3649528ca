//! What a stage kind says of itself: [`StageSpec`], implemented by its settings struct in the kind's file in `kinds/`.
//!
//! References are declared once, by [`StageSpec::refs`]. The edges of the DAG, what is blank in a stage's key, how a sweep makes a judge
//! look at its trials, which files outside the store are digested, the schema and the reference of all keys follow from them.

use std::any::Any;
use std::borrow::Cow;
use std::collections::BTreeSet;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{DataFormat, Family, LatentShape, Neighbours, Problems, Sampler, Training};
use crate::ArtifactKind;

/// How a stage's work is laid over workers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Data parallel: all members step together.
    Gang,
    /// Cut into shards, each done once by anybody, then merged.
    Map,
    /// Done once by one worker.
    Plain,
    /// Done by the coordinator, because it changes the registry.
    Registry,
}

/// A stage's one output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Output {
    /// What it is called among the stage's results.
    pub name: &'static str,
    /// What it is.
    pub kind: ArtifactKind,
}

/// A stage kind. Its `Default` is the published recipe where there is one, and the schema of its keys.
pub trait StageSpec:
    Default + Clone + PartialEq + std::fmt::Debug + Serialize + DeserializeOwned + JsonSchema + 'static
{
    /// Its name in YAML, such as `train.vae`.
    const KIND: &'static str;
    /// Grows when a change of ours changes what the kind computes, so that an old result is not mistaken for a new one.
    const VERSION: u32 = 1;
    /// How its work is laid over workers.
    const SHAPE: Shape;
    /// What it gives.
    const OUTPUT: Output;

    /// What it gives with these settings, where that depends on them.
    fn output(&self) -> Output {
        Self::OUTPUT
    }

    /// The stages and files that it refers to.
    fn refs(&mut self) -> Vec<Ref<'_>>;

    /// What must hold of the settings beyond their types.
    fn check(&self, _problems: &mut Problems) {}

    /// What must hold between the settings and the stages that they refer to. Asked when references are sound.
    fn check_neighbours(&self, _stages: &Neighbours<'_>, _problems: &mut Problems) {}

    /// Shards of a map stage.
    fn shards(&self) -> usize {
        1
    }

    /// What every training stage shares. A kind that has it can be swept.
    fn training(&mut self) -> Option<&mut Training> {
        None
    }

    /// The shape of the latents that it gives or works on, if it decides that.
    fn latent(&self) -> Option<LatentShape> {
        None
    }

    /// The skeleton of what it gives, if it decides that rather than a stage that it reads.
    fn format(&self) -> Option<DataFormat> {
        None
    }

    /// What the model that it trains can do, and so which samplers it has.
    fn family(&self) -> Option<Family> {
        None
    }

    /// How it draws from the model that it measures.
    fn sampler(&self) -> Option<&Sampler> {
        None
    }

    /// The values that an evaluation may give, by name: all of them, whatever the data has. None says that it is not known.
    fn metrics(&self) -> Option<BTreeSet<String>> {
        None
    }

    /// What a training records after each step besides its gradient's norm and its learning rate, which checkpoints are kept by.
    fn recorded(&self) -> &'static [&'static str] {
        &[]
    }
}

/// What a reference leads to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// A stage that gives this.
    Stage(ArtifactKind),
    /// A dataset's folder, of which only what a dataset of this format reads is digested.
    Dataset(DataFormat),
    /// A folder whose files are all digested.
    Folder,
    /// A file.
    File,
}

/// A reference of a stage's settings, with the place that holds the name.
#[derive(Debug)]
pub struct Ref<'a> {
    /// The field, such as `vae` or `from[0]`.
    pub field: Cow<'static, str>,
    /// The stage's name, or a path.
    pub name: &'a mut String,
    /// What it must lead to.
    pub target: Target,
    /// Whether anything is read there. The place is blank in keys either way.
    pub read: bool,
    /// Whether it is this that an evaluation measures.
    pub measured: bool,
    /// Files that the folder must have; of several with `|` between them, one.
    pub files: &'static [&'static str],
    /// What the folder is and where to get it.
    pub origin: &'static str,
    /// The part of a model that is read of it, if one is.
    pub part: Option<ArtifactKind>,
}

impl<'a> Ref<'a> {
    /// A stage that must give `kind`.
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

    /// A stage that must give `kind`, with whose weights a training begins: those of its `part`, if it gives a model. An empty name
    /// begins with random ones.
    pub fn init(name: &'a mut String, kind: ArtifactKind, part: ArtifactKind) -> Self {
        Self { part: Some(part), ..Self::stage("init", name, kind).optional() }
    }

    /// A dataset's folder.
    pub fn dataset(field: &'static str, path: &'a mut String, format: DataFormat) -> Self {
        let (read, target) = (!path.is_empty(), Target::Dataset(format));
        let origin = match format {
            DataFormat::Humanml3d => "HumanML3D, made from AMASS as github.com/EricGuo5513/HumanML3D says",
            DataFormat::Kit => "KIT-ML, linked in github.com/EricGuo5513/HumanML3D",
        };
        Self { field: field.into(), name: path, target, read, measured: false, files: &[], origin, part: None }
    }

    /// A folder; none if the path is empty.
    pub fn folder(field: &'static str, path: &'a mut String) -> Self {
        let read = !path.is_empty();
        let target = Target::Folder;
        Self { field: field.into(), name: path, target, read, measured: false, files: &[], origin: "", part: None }
    }

    /// A file; none if the path is empty.
    pub fn file(field: &'static str, path: &'a mut String) -> Self {
        Self { target: Target::File, ..Self::folder(field, path) }
    }

    /// The folder must have these files; `origin` says what it is and where to get it.
    #[must_use]
    pub fn holding(self, files: &'static [&'static str], origin: &'static str) -> Self {
        Self { files, origin, ..self }
    }

    /// Nothing is read unless `condition` holds.
    #[must_use]
    pub fn only_if(self, condition: bool) -> Self {
        Self { read: self.read && condition, ..self }
    }

    /// An empty name is no reference.
    #[must_use]
    pub fn optional(self) -> Self {
        let given = !self.name.is_empty();
        self.only_if(given)
    }

    /// This is what the evaluation measures, if `condition` holds.
    #[must_use]
    pub fn measured_if(self, condition: bool) -> Self {
        Self { measured: condition, ..self }
    }
}

/// [`StageSpec`] without its type, as [`StageSettings`](super::StageSettings) asks it.
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
}

/// Makes [`StageSettings`](super::StageSettings) of the list of kinds. All else that is said of a kind is in its file.
macro_rules! stage_kinds {
    ($($name:ident,)*) => {
        /// A stage's settings, resolved. The kind's name stands beside them as `kind`, in YAML as in JSON.
        #[derive(Debug, Clone, PartialEq)]
        pub enum StageSettings {
            $(#[doc = concat!("See [`", stringify!($name), "`].")] $name($name),)*
        }

        impl StageSettings {
            /// Every kind, with default settings: the table from which the pipeline reader learns kinds, keys and types.
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
