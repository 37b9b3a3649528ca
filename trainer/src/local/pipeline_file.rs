//! A pipeline file on disk: reads and checks it and its dataset folders, before a store is opened.

use std::io::Read as _;
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Path, PathBuf};

use motion::folder_digest::{files_digest, folder_digest};
use motion::{DataPath, Dataset};
use pipeline::{Pipeline, PipelineStage};
use protocol::stage::{DataFormat, ExternalFolder};
use protocol::units::counted;
use protocol::{Digest, StageName, limits, spelling};
use registry::ReadStore;

use crate::local::hub_names;
use crate::local::missing::{Missing, check_backend, check_format, missing};
use crate::report::problem::{Problem, Result};

/// A pipeline with its source text.
#[derive(Debug)]
pub(crate) struct PipelineFile {
    pub(crate) pipeline: Pipeline,
    pub(crate) source: String,
}

/// Reads and validates only the file.
pub(crate) fn read(path: &Path, sets: &[String]) -> Result<PipelineFile> {
    let name = path.display().to_string();
    let source = read_text(path).map_err(|error| {
        let problem = Problem::usage(format!("cannot read the pipeline `{name}`: {error}"));
        match error.kind() {
            std::io::ErrorKind::NotFound => problem.hint(instead_of(path)),
            std::io::ErrorKind::IsADirectory => problem.hint(inside(path)),
            _ if path.exists() && !path.is_file() => problem.hint("write it to a file, or pass it as <(COMMAND)"),
            _ => problem,
        }
    })?;
    of_text(&name, source, sets)
}

/// The pipelines in a folder, by name.
fn pipelines_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let is_yaml = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "yaml" || ending == "yml");
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(is_yaml).collect();
    found.sort();
    found
}

/// Suggests an existing pipeline for a path that does not exist.
fn instead_of(path: &Path) -> String {
    let beside = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let known: Vec<PathBuf> = [beside, Path::new("configs")].into_iter().flat_map(pipelines_in).collect();
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let stems: Vec<String> = known.iter().map(|path| stem(path)).collect();
    let near = spelling::nearest(&stem(path), stems.iter().map(String::as_str));
    let near = near.and_then(|near| known.iter().find(|path| stem(path) == near));
    near.map_or_else(
        || "example pipelines are in `configs/`; `trainer run configs/quickstart.yaml` needs no data".to_owned(),
        |near| format!("did you mean `{}`?", near.strip_prefix(".").unwrap_or(near).display()),
    )
}

/// Suggests a pipeline inside a folder.
fn inside(folder: &Path) -> String {
    match pipelines_in(folder).as_slice() {
        [] => "the folder has no pipelines; name a pipeline file, such as `configs/quickstart.yaml`".to_owned(),
        found => {
            let names: Vec<String> = found.iter().take(8).map(|path| path.display().to_string()).collect();
            let more = if found.len() > names.len() { ", ..." } else { "" };
            format!("name one of its pipelines: {}{more}", names.join(", "))
        }
    }
}

/// Validates the text of a file called `name`.
pub(crate) fn of_text(name: &str, source: String, sets: &[String]) -> Result<PipelineFile> {
    let pipeline = pipeline::read(name, &source, sets).map_err(|mistakes| {
        let count = counted(mistakes.0.len(), "mistake");
        let problem = Problem::usage(format!("{count} in the pipeline\n\n{mistakes}"));
        problem.hint("nothing was run or stored")
    })?;
    Ok(PipelineFile { pipeline, source })
}

/// Reads a pipeline. It may come through a pipe of the shell (`<(...)`), so its length is unknown until the end. A
/// named pipe in a folder is refused, because it may never have a writer.
fn read_text(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    let of_the_shell = path.starts_with("/dev") || path.starts_with("/proc");
    let found = std::fs::metadata(path)?.file_type();
    if found.is_dir() {
        return Err(std::io::Error::new(std::io::ErrorKind::IsADirectory, "it is a folder; expected a file"));
    }
    if found.is_fifo() && !of_the_shell {
        return Err(std::io::Error::other("it is a named pipe; expected a file"));
    }
    std::fs::File::open(path)?.take(limits::PIPELINE_BYTES + 1).read_to_end(&mut bytes)?;
    let refuse = |what: String| std::io::Error::new(std::io::ErrorKind::InvalidData, what);
    if bytes.len() as u64 > limits::PIPELINE_BYTES {
        return Err(refuse(format!("it has more than {} bytes", limits::PIPELINE_BYTES)));
    }
    String::from_utf8(bytes).map_err(|error| refuse(format!("it is not UTF-8 text: {}", error.utf8_error())))
}

/// Reads the file and digests the folders that it names, which must all exist. Folders that it names by hub id are
/// fetched.
pub(crate) fn read_with_data(path: &Path, sets: &[String]) -> Result<PipelineFile> {
    with_data(read(path, sets)?)
}

/// Digests the folders that a pipeline names, which must all exist.
pub(crate) fn with_data(mut file: PipelineFile) -> Result<PipelineFile> {
    hub_names::resolve(&mut file.pipeline)?;
    let missing = missing(&file.pipeline);
    if !missing.is_empty() {
        let lines: Vec<String> = missing.iter().map(|one| format!("\n  {}", one.line())).collect();
        let problem = Problem::usage(format!("the pipeline needs data that is not on this machine{}", lines.concat()));
        let hint = match missing.iter().find_map(Missing::fetch_command) {
            Some(command) => format!("`{command}` fetches it; `trainer plan` shows the rest"),
            None => "set a folder with, for example, `--set dataset.path=FOLDER`; `trainer plan` shows the rest; \
                     `dataset: {format: synthetic}` needs no data"
                .to_owned(),
        };
        return Err(problem.hint(hint));
    }
    digest_folders(&mut file.pipeline)?;
    Ok(file)
}

/// Like [`read_with_data`], but also returns the missing data instead of refusing it.
pub(crate) fn read_to_plan(path: &Path, sets: &[String]) -> Result<(PipelineFile, Vec<Missing>)> {
    let mut file = read(path, sets)?;
    check_backend(file.pipeline.backend)?;
    let absent = hub_names::resolve_cached(&mut file.pipeline)?;
    let mut missing = missing(&file.pipeline);
    hub_names::explain(&mut missing, &absent);
    digest_folders(&mut file.pipeline)?;
    Ok((file, missing))
}

/// Digests the folders that exist.
fn digest_folders(pipeline: &mut Pipeline) -> Result<()> {
    let absent: Vec<String> = missing(pipeline).into_iter().map(|one| one.path).collect();
    for stage in &mut pipeline.stages {
        for ExternalFolder { field, path, format, .. } in stage.settings.folders() {
            if absent.contains(&path) {
                continue;
            }
            let content = match format {
                Some(format) => {
                    check_format(Path::new(&path), format)?;
                    folder_digest(&DataPath::local(&path), format).map_err(bad_folder)?
                }
                None => files_digest(&DataPath::local(&path))
                    .map_err(|e| Problem::usage(format!("stage `{}`: {path}: {e}", stage.name)))?,
            };
            stage.external.insert(field, content);
        }
    }
    Ok(())
}

/// Fills in the registry versions that the pipeline names; `None` is a store that does not exist yet.
pub(crate) async fn resolve_versions(pipeline: &mut Pipeline, store: Option<&ReadStore>) -> Result<()> {
    let named = || pipeline.stages.iter().find_map(|stage| Some((stage, stage.versions().into_iter().next()?)));
    match (store, named()) {
        (_, None) => Ok(()),
        (Some(store), Some(_)) => coordinator::resolve_versions(pipeline, store).await.map_err(Problem::from),
        (None, Some((stage, input))) => {
            let (name, field, version) = (&stage.name, input.field, input.version);
            let text =
                format!("stage `{name}`: `{field}` is `{version}`, a version of a registry, but there is no store");
            Err(Problem::usage(text).hint("select the store with `--store DIR`; `registry list` shows its models"))
        }
    }
}

/// Checks that the stage of `--until` exists.
pub(crate) fn check_stage(pipeline: &Pipeline, until: Option<&StageName>) -> Result<()> {
    match until {
        Some(until) if pipeline.named(until).next().is_none() => {
            let names: Vec<&str> = pipeline.stages.iter().map(|stage| stage.name.as_str()).collect();
            let meant = spelling::question(until.as_str(), names.iter().copied());
            Err(Problem::usage(format!("`--until {until}`: the pipeline has no such stage{meant}"))
                .hint(format!("its stages are {}", names.join(", "))))
        }
        _ => Ok(()),
    }
}

/// Opens the dataset folders whose content is new to this store, so that their defects are reported before anything is
/// stored.
pub(crate) fn check_data(pipeline: &Pipeline, store: &Path) -> Result<()> {
    for (stage, folder, format) in dataset_folders(pipeline) {
        let seen = |digest: &Digest| store.join("seen").join(digest.hex()).exists();
        if !stage.external.get(&folder.field).is_some_and(seen) {
            Dataset::open(&DataPath::local(&folder.path), format).map_err(bad_folder)?;
        }
    }
    Ok(())
}

/// Remembers which folders were valid, so that they are not opened twice. Only a hint: `data.open` checks again.
pub(crate) fn remember_data(pipeline: &Pipeline, store: &Path) {
    for digest in dataset_folders(pipeline).filter_map(|(stage, folder, _)| stage.external.get(&folder.field)) {
        let seen = store.join("seen");
        // If the note is lost, the folder is merely opened once more.
        let _ = std::fs::create_dir_all(&seen).and_then(|()| std::fs::write(seen.join(digest.hex()), b""));
    }
}

fn dataset_folders(pipeline: &Pipeline) -> impl Iterator<Item = (&PipelineStage, ExternalFolder, DataFormat)> {
    pipeline.stages.iter().flat_map(|stage| {
        let folders = stage.settings.folders().into_iter();
        folders.filter_map(move |folder| folder.format.map(|format| (stage, folder, format)))
    })
}

fn bad_folder(error: motion::dataset::OpenError) -> Problem {
    Problem::usage(error)
        .hint("set the folder with `--set dataset.path=FOLDER`; `dataset: {format: synthetic}` needs no folder")
}
