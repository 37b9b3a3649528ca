//! `trainer files`: the files that a run's stages made, as a list, as copies in a folder, or one of them on stdout.

use std::fs;
use std::io::Write as _;
use std::path::{Component, Path, PathBuf};

use clap::Args;
use protocol::artifact::FileEntry;
use protocol::message::RunView;
use protocol::{printable, units};
use serde_json::json;

use super::model::{manifest, verified};
use super::remote::check_parent;
use crate::client::Target;
use crate::reader::Reader;
use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

#[derive(Debug, Args)]
pub(crate) struct FilesArgs {
    /// The run, a unique beginning of its name, or `@last`
    #[arg(default_value = "@last")]
    run: String,
    /// Only this stage
    #[arg(long)]
    stage: Option<String>,
    /// Only files of this name
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Copies the files to a new folder, below STAGE/OUTPUT
    #[arg(long, value_name = "DIR")]
    copy: Option<PathBuf>,
    /// Writes the content of the one file that fits to stdout
    #[arg(long, conflicts_with_all = ["copy", "output"])]
    print: bool,
    #[command(flatten)]
    target: Target,
    /// Format of the list
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

/// A file of a stage's output.
struct Made {
    stage: String,
    output: String,
    name: String,
    entry: FileEntry,
}

pub(crate) async fn files(args: FilesArgs) -> Result<u8> {
    if let Some(dir) = &args.copy {
        check_parent(dir)?;
        if fs::symlink_metadata(dir).is_ok() {
            return Err(Problem::usage(format!("`{}` exists already", dir.display())).hint("name a new folder"));
        }
    }
    let reader = Reader::open(&args.target).await?;
    let run = reader.find(&args.run).await?;
    let made = made(&reader, &run, args.stage.as_deref(), args.name.as_deref()).await?;
    if args.print {
        print_one(&reader, &made).await?;
    } else if let Some(dir) = &args.copy {
        copy(&reader, &made, dir).await?;
        let bytes = made.iter().map(|file| file.entry.bytes).sum();
        print::out(&format!("{}: {} of {}", dir.display(), units::counted(made.len(), "file"), units::size(bytes)));
    } else {
        list(&run, &made, args.output);
    }
    reader.close().await;
    Ok(0)
}

/// The files of the outputs of a run's stages, or of one stage. A file that is part of several outputs is listed for
/// each.
async fn made(reader: &Reader, run: &RunView, stage: Option<&str>, name: Option<&str>) -> Result<Vec<Made>> {
    let not_found = |what: String| Problem::new(exit::NOT_FOUND, anyhow::anyhow!("run `{}` {what}", run.run));
    if let Some(stage) = stage.filter(|stage| run.stages.iter().all(|other| other.name.as_str() != *stage)) {
        let names = run.stages.iter().map(|stage| stage.name.as_str());
        let meant = protocol::spelling::question(stage, names);
        return Err(not_found(format!("has no stage `{stage}`{meant}")).hint("`trainer status` lists its stages"));
    }
    let mut made = Vec::new();
    for view in run.stages.iter().filter(|view| stage.is_none_or(|stage| view.name.as_str() == stage)) {
        for (output, artifact) in &view.outputs {
            let manifest = manifest(reader, *artifact).await?;
            made.extend(manifest.files.into_iter().map(|(name, entry)| Made {
                stage: view.name.to_string(),
                output: output.clone(),
                name,
                entry,
            }));
        }
    }
    made.retain(|file| name.is_none_or(|name| file.name == name));
    if made.is_empty() {
        let named = name.map(|name| format!(" named `{name}`")).unwrap_or_default();
        return Err(
            not_found(format!("has no files{named} yet")).hint("`trainer files` lists the files of finished stages")
        );
    }
    Ok(made)
}

fn list(run: &RunView, made: &[Made], output: Output) {
    match output {
        Output::Json => {
            let file = |file: &Made| {
                let Made { stage, output, name, entry } = file;
                json!({"stage": stage, "output": output, "name": name, "bytes": entry.bytes, "digest": entry.digest})
            };
            let files: Vec<_> = made.iter().map(file).collect();
            print::json(&json!({"schema_version": 1, "run": run.run, "files": files}));
        }
        Output::Table => {
            let row = |file: &Made| {
                let name = printable(&file.name).into_owned();
                vec![file.stage.clone(), file.output.clone(), name, units::size(file.entry.bytes)]
            };
            print::out(&print::table(&["STAGE", "OUTPUT", "FILE", "SIZE"], made.iter().map(row).collect()));
        }
    }
}

/// Writes the only file to stdout as it is.
async fn print_one(reader: &Reader, made: &[Made]) -> Result<()> {
    let [file] = made else {
        let problem = Problem::usage(format!("{} fit; `--print` writes one", units::counted(made.len(), "file")));
        return Err(problem.hint("`--stage` and `--name` choose it, such as `--stage fid --name report.json`"));
    };
    for blob in file.entry.blobs() {
        let bytes = verified(reader, blob.digest).await?;
        // A reader that has seen enough closes the pipe.
        let _ = std::io::stdout().lock().write_all(&bytes);
    }
    Ok(())
}

/// Copies the files to a folder that does not exist. It appears under its name once it is complete.
async fn copy(reader: &Reader, made: &[Made], dir: &Path) -> Result<()> {
    let name = dir.file_name().ok_or_else(|| Problem::usage(format!("`{}` is no name of a folder", dir.display())))?;
    let part = dir.with_file_name(format!(".{}.{}.part", name.to_string_lossy(), std::process::id()));
    let written = copy_into(reader, made, &part).await;
    let moved = written.and_then(|()| fs::rename(&part, dir).map_err(|error| unwritten(dir, &error)));
    if moved.is_err() {
        // What was copied is of no use; the error matters more than a rest.
        let _ = fs::remove_dir_all(&part);
    }
    moved
}

async fn copy_into(reader: &Reader, made: &[Made], dir: &Path) -> Result<()> {
    for file in made {
        let path = dir.join(&file.stage).join(&file.output).join(&file.name);
        if !Path::new(&file.name).components().all(|part| matches!(part, Component::Normal(_))) {
            let (stage, name) = (&file.stage, printable(&file.name));
            return Err(Problem::failed(format!("stage `{stage}` lists a file `{name}` outside its folder"))
                .hint("`trainer registry fsck` checks the store"));
        }
        let unwritten = |error| unwritten(&path, &error);
        let parent = path.parent().unwrap_or(dir);
        let mut copied = fs::create_dir_all(parent).and_then(|()| fs::File::create(&path)).map_err(unwritten)?;
        for blob in file.entry.blobs() {
            copied.write_all(&verified(reader, blob.digest).await?).map_err(unwritten)?;
        }
    }
    Ok(())
}

fn unwritten(path: &Path, error: &std::io::Error) -> Problem {
    Problem::failed(format!("cannot write `{}`: {error}", path.display()))
}
