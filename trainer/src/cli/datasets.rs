//! `trainer data list` and `trainer data fetch`: published sets of motion.

use std::io::{BufRead as _, IsTerminal as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use hub::dataset::{Arrived, Fetch, FetchError, Fetched, KNOWN, Known, Progress, PublicSet, Source, Table};
use indicatif::{ProgressBar, ProgressStyle};
use mocap::bandai;
use protocol::spelling;
use serde_json::json;

use crate::report::print::{self, Output};
use crate::report::problem::{Problem, Result, exit};

/// Folder in which the sets have their folders.
const FOLDER: &str = "data";
/// Pause after the first failed attempt of a transfer.
const PAUSE: Duration = Duration::from_secs(2);

#[derive(Debug, Args)]
pub(crate) struct ListArgs {
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

#[derive(Debug, Args)]
pub(crate) struct FetchArgs {
    /// Name of the set, as in `trainer data list`
    name: String,
    /// The folder to write to, which must be empty or not exist [default: data/NAME]
    folder: Option<PathBuf>,
    /// Accept the licence without being asked
    #[arg(long, visible_alias = "accept-license")]
    accept_licence: bool,
    /// Read the files from a folder, such as a clone, or from a .tar.gz, instead of the network
    #[arg(long, value_name = "PATH", conflicts_with = "url")]
    from: Option<PathBuf>,
    /// With --from: complete the set without the files that are missing there
    #[arg(long, requires = "from")]
    partial: bool,
    /// Address of the .tar.gz, for a mirror
    #[arg(long, value_name = "URL")]
    url: Option<String>,
    /// Format of the answer
    #[arg(short, long, value_enum, default_value_t)]
    pub(super) output: Output,
}

pub(super) fn list(args: &ListArgs) -> u8 {
    if args.output == Output::Json {
        let sets = KNOWN.iter().map(|known| {
            json!({
                "name": known.name, "title": known.title, "home": known.home, "licence": known.licence,
                "recordings": (known.recordings > 0).then_some(known.recordings), "fetched": known.fetched,
                "map": (!known.map.is_empty()).then_some(known.map), "how": known.how(),
            })
        });
        print::json(&sets.collect::<Vec<_>>());
        return 0;
    }
    let rows = KNOWN.iter().map(|known| {
        let map = if known.map.is_empty() { "-" } else { known.map };
        [known.name, known.title, known.licence, map, &known.how()].map(str::to_owned).to_vec()
    });
    print::out(&print::table(&["NAME", "SET", "LICENCE", "JOINT MAP", "HOW"], rows.collect()));
    print::note("\nthe chapter \"Public data\" of the book says how the others are read");
    0
}

pub(super) fn fetch(args: &FetchArgs) -> Result<u8> {
    let known = known(&args.name)?;
    let set = hub::dataset::bandai();
    let folder = args.folder.clone().unwrap_or_else(|| Path::new(FOLDER).join(known.name));
    if folder.file_name().is_none() {
        return Err(Problem::usage(format!("{}: expected the name of a new folder", folder.display())));
    }
    let source = match (&args.from, &args.url) {
        (Some(path), _) => Source::Local(path),
        (None, Some(url)) => Source::Address(url),
        (None, None) => Source::Address(&set.archive),
    };
    let fetch = Fetch { set: &set, folder: &folder, source, partial: args.partial, pause: PAUSE };
    if !fetch.is_accepted() {
        accept(known, args.accept_licence)?;
    }
    let all: Vec<&str> = set.files.keys().map(String::as_str).collect();
    let tables = |there: &[&str]| {
        let made = bandai::tables(&all, there)?;
        Ok(made.into_iter().map(|(name, text)| Table { name, text }).collect())
    };
    let mut shown = Shown::default();
    // The client drives its own runtime, and this thread may already drive one.
    let fetched = std::thread::scope(|scope| {
        let fetching = scope.spawn(|| fetch.run(&tables, &mut |progress| shown.show(progress)));
        fetching.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    shown.clear();
    let fetched = fetched.map_err(|error| refused(&error))?;
    report(known, &set, &folder, &fetched, args.output);
    Ok(0)
}

/// The set of a name that can be fetched.
fn known(name: &str) -> Result<&'static Known> {
    let found = KNOWN.iter().find(|known| known.name == name);
    match found {
        Some(known) if known.fetched => Ok(known),
        Some(known) => {
            let problem = Problem::usage(format!("this command does not fetch `{name}`"));
            Err(problem.hint(format!(
                "its page is {}; the chapter \"Public data\" of the book says how it is read",
                known.home
            )))
        }
        None => {
            let near = spelling::nearest(name, KNOWN.iter().map(|known| known.name));
            let near = near.map_or_else(String::new, |near| format!("did you mean `{near}`? "));
            let problem = Problem::usage(format!("there is no set `{name}`"));
            Err(problem.hint(format!("{near}`trainer data list` shows the sets")))
        }
    }
}

/// Shows the licence, and asks for its acceptance unless it was given.
fn accept(known: &Known, given: bool) -> Result<()> {
    let Known { title, licence, licence_text, home, .. } = known;
    print::note(&format!("{title}\n{home}\nlicence: {licence}, {licence_text}"));
    if given {
        return Ok(());
    }
    let refused = |what: &str| Problem::usage(format!("the licence of `{}` {what}; nothing was fetched", known.name));
    if !(std::io::stdin().is_terminal() && print::on_terminal()) {
        return Err(refused("was not accepted").hint("read it, and add `--accept-licence` to accept it in a script"));
    }
    print::note("Do you accept this licence? [y/N]");
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer).map_err(|error| refused(&format!("was not accepted: {error}")))?;
    if ["y", "yes"].contains(&answer.trim().to_lowercase().as_str()) {
        return Ok(());
    }
    Err(refused("was not accepted"))
}

fn refused(error: &FetchError) -> Problem {
    let exit = match error {
        FetchError::Taken { .. } => exit::USAGE,
        FetchError::Busy { .. } => exit::CONFLICT,
        FetchError::Away { .. } => exit::UNREACHABLE,
        FetchError::Content { .. } => exit::INTEGRITY,
        FetchError::Refused { .. } | FetchError::DiskFull { .. } | FetchError::Io { .. } => exit::FAILED,
    };
    Problem::new(exit, anyhow::anyhow!("{error}")).hint(error.advice())
}

fn report(known: &Known, set: &PublicSet, folder: &Path, fetched: &Fetched, output: Output) {
    let there = || set.files.iter().filter(|(name, _)| fetched.missing == 0 || folder.join(name).is_file());
    let short = there().filter(|(_, listed)| !bandai::is_long_enough(listed.frames)).count();
    let unlisted = known.recordings.saturating_sub(set.files.len());
    if output == Output::Json {
        print::json(&json!({
            "set": known.name, "folder": folder, "files": fetched.files, "kept": fetched.kept,
            "was_complete": fetched.was_complete,
            "left_out": {"not_listed": unlisted, "missing": fetched.missing, "too_short_to_train": short},
        }));
        return;
    }
    let done = if fetched.was_complete { "is complete already" } else { "is complete" };
    let mut text = format!("{}: `{}` {done}, {} recordings", folder.display(), known.name, fetched.files);
    text += &format!("\nleft out: {unlisted} published takes that are kept apart for trying models on unseen motion");
    if fetched.missing > 0 {
        text += &format!("\nleft out: {} takes that the source does not have", fetched.missing);
    }
    text += &format!("\ntraining leaves out {short} recordings shorter than two seconds");
    text += &format!("\nnext: trainer run configs/{}.yaml", known.name);
    if folder != Path::new(FOLDER).join(known.name) {
        text += &format!(" --set stages.dataset.path={}", folder.display());
    }
    print::out(&text);
}

/// The progress bar, on a terminal.
#[derive(Default)]
struct Shown {
    bar: Option<(Bar, ProgressBar)>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Bar {
    Checked,
    Arrived { of: Option<u64> },
    Kept,
}

impl Shown {
    fn show(&mut self, progress: Progress) {
        let (bar, at, of) = match progress {
            Progress::Checked { files } => (Bar::Checked, files as u64, None),
            Progress::Arrived(Arrived { bytes, of }) => (Bar::Arrived { of }, bytes, of),
            Progress::Kept { files, of } => (Bar::Kept, files as u64, Some(of as u64)),
        };
        if self.bar.as_ref().is_none_or(|(shown, _)| *shown != bar) {
            self.clear();
            self.bar = Some((bar, drawn(bar, of)));
        }
        if let Some((_, bar)) = &self.bar {
            bar.set_position(at);
        }
    }

    fn clear(&mut self) {
        if let Some((_, bar)) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

fn drawn(bar: Bar, of: Option<u64>) -> ProgressBar {
    if !print::on_terminal() {
        match bar {
            Bar::Checked => print::note("checking the files of an earlier attempt"),
            Bar::Arrived { .. } => print::note("fetching the archive"),
            Bar::Kept => print::note("checking the files"),
        }
        return ProgressBar::hidden();
    }
    let template = match (bar, of) {
        (Bar::Checked, _) => "checking {pos} files of an earlier attempt",
        (Bar::Arrived { .. }, Some(_)) => "fetching {bar:30} {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left",
        (Bar::Arrived { .. }, None) => "fetching {bytes}, {bytes_per_sec}",
        (Bar::Kept, _) => "checking {bar:30} {pos} of {len} files",
    };
    let bar = of.map_or_else(ProgressBar::no_length, ProgressBar::new);
    // The templates are constants.
    bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}
