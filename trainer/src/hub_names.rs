//! Text encoders that a pipeline names as the Hugging Face hub does: the folder in the hub's cache takes the name's place before anything is digested, so that all else
//! sees a folder.

use std::path::Path;

use hub::{Encoder, Hub, HubError, Name, Settings};
use protocol::pipeline::Pipeline;
use protocol::stage::{StageSettings, TextEmbed, TextEncoder};

use crate::missing::Missing;
use crate::print;
use crate::problem::{Problem, Result};

/// The encoder that `settings` name on the hub; none if they name a folder or need none.
fn named(settings: &TextEmbed) -> Option<(Name, Encoder)> {
    let encoder = match settings.encoder {
        TextEncoder::Hashed => return None,
        TextEncoder::Clip => Encoder::Clip,
        TextEncoder::T5 => Encoder::T5,
        TextEncoder::SentenceT5 => Encoder::SentenceT5,
    };
    // A link that leads nowhere is a folder that is missing.
    if Path::new(&settings.path).symlink_metadata().is_ok() {
        return None;
    }
    Some((Name::of(&settings.path, &settings.revision)?, encoder))
}

/// Puts the folder in the name's place; the revision has done its work.
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

/// Refuses a revision of what has none.
fn check_revision(stage: &str, settings: &TextEmbed) -> Result<()> {
    if settings.revision.is_empty() || settings.encoder == TextEncoder::Hashed {
        return Ok(());
    }
    let message =
        format!("stage `{stage}`: `revision` is given, but `path` is the folder `{}`, which has none", settings.path);
    Err(Problem::usage(message)
        .hint("leave it out, or name the encoder as on huggingface.co, such as `openai/clip-vit-base-patch32`"))
}

/// Puts folders in the place of names, and fetches what is not in the cache.
pub(crate) fn resolve(pipeline: &mut Pipeline) -> Result<()> {
    for (stage, settings) in encoders(pipeline) {
        let Some((name, encoder)) = named(settings) else {
            check_revision(&stage, settings)?;
            continue;
        };
        let hub = Hub::new(Settings::of_environment());
        // The client drives a runtime of its own, which this thread may do already.
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

/// The same with what is in the cache alone. Gives the names that are not in it, and why.
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

/// Says of names that they are no folders that are missing.
pub(crate) fn explain(missing: &mut [Missing], absent: &[(String, String)]) {
    for one in missing {
        if let Some((_, why)) = absent.iter().find(|(path, _)| *path == one.path) {
            one.what.clone_from(why);
        }
    }
}
