//! Checks that the data which a pipeline reads from outside the store is on this machine, before it is digested.

use std::path::Path;

use motion::{DataPath, Skeleton, npy};
use pipeline::Pipeline;
use protocol::StageName;
use protocol::stage::{Backend, DataFormat, ExternalFolder};
use serde::Serialize;

use crate::report::problem::{Problem, Result};

/// A folder that does not exist or lacks a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Missing {
    /// The stage that reads it.
    pub(crate) stage: StageName,
    /// The setting that names it.
    pub(crate) field: String,
    pub(crate) path: String,
    /// The missing part.
    pub(crate) what: String,
    /// Description of the data and its source.
    pub(crate) origin: &'static str,
}

impl Missing {
    /// Names the folder, the missing part and the stage that reads it.
    pub(crate) fn place(&self) -> String {
        let Self { stage, field, path, what, .. } = self;
        let named = if field == "path" { stage.to_string() } else { format!("{stage}.{field}") };
        format!("{path}: {what}, for `{named}`")
    }

    /// The command that fetches a folder with the name of a published set.
    pub(crate) fn fetch_command(&self) -> Option<String> {
        let name = Path::new(&self.path).file_name()?.to_str()?;
        let known = hub::dataset::KNOWN.iter().find(|known| known.fetched && known.name == name)?;
        Some(format!("trainer data fetch {} {}", known.name, self.path))
    }

    /// Describes the missing data in one line.
    pub(crate) fn line(&self) -> String {
        format!("{}: {}", self.place(), self.origin)
    }
}

/// All missing data, in the order of the pipeline; a folder that several stages read appears once.
pub(crate) fn missing(pipeline: &Pipeline) -> Vec<Missing> {
    let mut found: Vec<Missing> = Vec::new();
    for stage in &pipeline.stages {
        for folder in stage.settings.folders() {
            let Some(what) = lacks(&folder) else { continue };
            let ExternalFolder { field, path, origin, .. } = folder;
            if !found.iter().any(|known| known.path == path && known.what == what) {
                found.push(Missing { stage: stage.name.clone(), field, path, what, origin });
            }
        }
    }
    found
}

/// Describes the missing part of a folder.
fn lacks(folder: &ExternalFolder) -> Option<String> {
    let path = Path::new(&folder.path);
    if !path.exists() {
        let file = path.extension().is_some() && folder.format.is_none() && folder.files.is_empty();
        return Some(if file { "no such file" } else { "no such folder" }.into());
    }
    // Opening a dataset's folder reports all its defects at once.
    if folder.format.is_some() || !path.is_dir() {
        return None;
    }
    let absent = folder.files.iter().find(|file| !file.split('|').any(|one| path.join(one).exists()));
    absent.map(|file| format!("the folder has no `{}`", file.split('|').collect::<Vec<_>>().join("` or `")))
}

/// Refuses a folder whose features have the width of another format, according to its statistics.
pub(crate) fn check_format(path: &Path, format: DataFormat) -> Result<()> {
    // Opening the folder reports other defects of the file.
    let Ok(mean) = npy::read_any_float(&DataPath::local(path.join("Mean.npy"))) else { return Ok(()) };
    let width = |format| Skeleton::of(format).features;
    let found = mean.data.len();
    if found == width(format) {
        return Ok(());
    }
    let other = [DataFormat::Humanml3d, DataFormat::Kit].into_iter().find(|other| width(*other) == found);
    let is = other.map_or_else(String::new, |other| format!(", like `{}`", other.name()));
    let problem = Problem::usage(format!(
        "{}: Mean.npy has {found} features{is}, but `format: {}` has {}",
        path.display(),
        format.name(),
        width(format)
    ));
    Err(problem.hint(other.map_or_else(
        || "use the folder with the published features".to_owned(),
        |other| {
            format!(
                "use `--set dataset.format={}`, or choose another folder with `--set dataset.path=FOLDER`",
                other.name()
            )
        },
    )))
}

/// Refuses a backend that this program lacks or that has no device here.
pub(crate) fn check_backend(backend: Backend) -> Result<()> {
    let problem = |error| Problem::usage(format!("`backend: {}`: {error}", backend.name()));
    models::device::open(backend, 0).map(drop).map_err(|error| {
        problem(error).hint(
            "`trainer devices` lists the backends of this program and machine; `--set backend=flex` runs everywhere",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_there_is_named_once_with_where_it_comes_from() {
        let dir = tempfile::tempdir().expect("a folder");
        let glove = dir.path().join("glove");
        std::fs::create_dir(&glove).expect("a folder");
        std::fs::write(glove.join("our_vab_data.npy"), "x").expect("a file");
        let text = format!(
            "name: p\ndataset: {{format: humanml3d, path: {0}/data}}\nstages:\n  judge: {{kind: import.evaluator, path: {0}/t2m, words: {0}/glove}}\n  other: {{kind: import.evaluator, path: {0}/t2m}}\n",
            dir.path().display()
        );
        let pipeline = pipeline::read("p.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
        let found = missing(&pipeline);
        let shown: Vec<(&str, &str, &str)> =
            found.iter().map(|one| (one.stage.as_str(), &*one.field, &*one.what)).collect();
        let expected = [
            ("dataset", "path", "no such folder"),
            ("judge", "path", "no such folder"),
            ("judge", "words", "the folder has no `our_vab_words.pkl`"),
        ];
        assert_eq!(shown, expected);
        assert!(found[0].line().contains("AMASS") && found[1].line().contains("text-to-motion"), "{found:#?}");
        let model = dir.path().join("t2m/text_mot_match/model");
        std::fs::create_dir_all(&model).expect("a folder");
        assert!(missing(&pipeline)[1].what.contains("`text_mot_match/model/finest.tar` or"), "{found:#?}");
        std::fs::write(model.join("finest.safetensors"), "x").expect("a file");
        assert_eq!(missing(&pipeline).len(), 2);
    }

    #[test]
    fn a_published_set_is_named_with_its_command() {
        let text = "name: p\nstages:\n  dataset: {kind: data.features, path: none/bandai}\n";
        let pipeline = pipeline::read("p.yaml", text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
        let found = missing(&pipeline);
        assert_eq!(found[0].fetch_command().as_deref(), Some("trainer data fetch bandai none/bandai"));
        let pipeline = pipeline::read("p.yaml", &text.replace("bandai", "mine"), &[]).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(missing(&pipeline)[0].fetch_command(), None);
    }

    #[test]
    fn a_folder_of_the_other_format_is_told_by_its_statistics() {
        let dir = tempfile::tempdir().expect("a folder");
        check_format(dir.path(), DataFormat::Kit).expect("nothing is said of what is not there");
        npy::write(&dir.path().join("Mean.npy"), &[251], &[0.0; 251]).expect("a file");
        check_format(dir.path(), DataFormat::Kit).expect("its own");
        let refused = check_format(dir.path(), DataFormat::Humanml3d).expect_err("another");
        assert!(refused.error.to_string().contains("251 features, like `kit`"), "{refused:?}");
        assert!(refused.hint.is_some_and(|hint| hint.contains("dataset.format=kit")));
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_backend_that_is_not_built_is_refused() {
        check_backend(Backend::Flex).expect("it is built in");
        let refused = check_backend(Backend::Cuda).expect_err("not built");
        assert!(refused.error.to_string().contains("--features cuda"), "{refused:?}");
    }
}
