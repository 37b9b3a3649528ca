//! Text encoders that a pipeline names by their Hugging Face hub id. The folder in the hub's cache replaces the id
//! before anything is digested, so that later code sees only folders.

use std::path::Path;

use hub::{Encoder, Hub, HubError, Name, Settings};
use pipeline::Pipeline;
use protocol::stage::{StageSettings, TextEmbed, TextEncoder};

use crate::local::missing::Missing;
use crate::report::print;
use crate::report::problem::{Problem, Result};

/// The encoder that `settings` name on the hub; `None` if they name a folder or need none.
fn named(settings: &TextEmbed) -> Option<(Name, Encoder)> {
    let encoder = match settings.encoder {
        TextEncoder::Hashed => return None,
        TextEncoder::Clip => Encoder::Clip,
        TextEncoder::T5 => Encoder::T5,
        TextEncoder::SentenceT5 => Encoder::SentenceT5,
    };
    // A link with a missing target is a missing folder.
    if Path::new(&settings.path).symlink_metadata().is_ok() {
        return None;
    }
    Some((Name::of(&settings.path, &settings.revision)?, encoder))
}

/// Replaces the name by the folder and clears the revision, which is no longer needed.
fn place(settings: &mut TextEmbed, folder: &Path) {
    settings.path = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned()).display().to_string();
    settings.revision.clear();
}

fn encoders(pipeline: &mut Pipeline) -> impl Iterator<Item = (String, &mut TextEmbed)> {
    pipeline.stages.iter_mut().filter_map(|stage| match &mut stage.settings {
        StageSettings::TextEmbed(settings) => Some((stage.name.to_string(), settings)),
        _ => None,
    })
}

/// Refuses a revision of a folder, which has none.
fn check_revision(stage: &str, settings: &TextEmbed) -> Result<()> {
    if settings.revision.is_empty() || settings.encoder == TextEncoder::Hashed {
        return Ok(());
    }
    let message = format!(
        "stage `{stage}`: `revision` is set, but `path` is the folder `{}`; a folder has no revision",
        settings.path
    );
    Err(Problem::usage(message)
        .hint("remove `revision`, or set `path` to a name on huggingface.co, such as `openai/clip-vit-base-patch32`"))
}

/// Replaces names on the hub by folders of the cache, and downloads missing ones.
pub(crate) fn resolve(pipeline: &mut Pipeline) -> Result<()> {
    for (stage, settings) in encoders(pipeline) {
        let Some((name, encoder)) = named(settings) else {
            check_revision(&stage, settings)?;
            continue;
        };
        let hub = Hub::new(Settings::of_environment());
        // The client drives its own runtime, and this thread may already drive one.
        let found = std::thread::scope(|scope| {
            let fetching = scope.spawn(|| hub.folder(&name, encoder, &mut print::note));
            fetching.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        });
        let found = found.map_err(|error| refused(&stage, &error))?;
        if let Some(note) = &found.note {
            print::note(&format!("stage `{stage}`: {note}"));
        }
        place(settings, &found.folder);
    }
    Ok(())
}

fn refused(stage: &str, error: &HubError) -> Problem {
    Problem::usage(format!("stage `{stage}`: {error}")).hint(error.advice())
}

/// Like [`resolve`], but without fetching. Returns the names that are not in the cache, with reasons.
pub(crate) fn resolve_cached(pipeline: &mut Pipeline) -> Result<Vec<(String, String)>> {
    let mut absent = Vec::new();
    for (stage, settings) in encoders(pipeline) {
        let Some((name, encoder)) = named(settings) else {
            check_revision(&stage, settings)?;
            continue;
        };
        let read = Settings::of_environment();
        let todo = if read.offline { "HF_HUB_OFFLINE is set" } else { "`trainer run` fetches it" };
        match Hub::new(read).cached(&name, encoder) {
            Ok(found) => place(settings, &found.folder),
            Err(HubError::NotHere { .. }) => {
                absent.push((settings.path.clone(), format!("not in the hub's cache; {todo}")))
            }
            Err(error) => return Err(refused(&stage, &error)),
        }
    }
    Ok(absent)
}

/// Replaces the reason of missing paths that are hub names.
pub(crate) fn explain(missing: &mut [Missing], absent: &[(String, String)]) {
    for one in missing {
        if let Some((_, why)) = absent.iter().find(|(path, _)| *path == one.path) {
            one.what.clone_from(why);
        }
    }
}
