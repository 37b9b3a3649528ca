//! Runs a target for a limited time in a separate process, so that a stack overflow or a refused allocation ends that
//! process and not the test.
//!
//! The process writes the number of its current input to a file. If an input ends the process or takes too long, the
//! waiting test writes that input to a file. Inputs are a function of their number, so only the number has to survive.

use std::alloc::System;
use std::cell::RefCell;
use std::fs::{self, File};
use std::os::unix::fs::FileExt as _;
use std::os::unix::process::ExitStatusExt as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cap::Cap;
use nix::sys::resource::{UsageWho, getrusage};
use protocol::Digest;

use crate::{CPU_S, MEMORY_FACTOR, Target, mutate};

/// Seconds per target in `cargo test`.
const SECONDS: u64 = 20;
/// Variable with the seconds per target.
pub const SECONDS_VARIABLE: &str = "STRIDE_FUZZ_SECONDS";
/// Variable with the seed of the inputs; 1 by default.
pub const SEED_VARIABLE: &str = "STRIDE_FUZZ_SEED";
/// Variable with a file to run alone, or a folder of such files.
pub const INPUT_VARIABLE: &str = "STRIDE_FUZZ_INPUT";
/// Variable with the file for the number of the current input; set only for the fuzzing process.
const STATE_VARIABLE: &str = "STRIDE_FUZZ_STATE";
/// Wall time after which an input counts as hanging.
const HANGS: Duration = Duration::from_secs(120);

fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

fn seed() -> u64 {
    variable(SEED_VARIABLE).map_or(1, |value| value.parse().expect("STRIDE_FUZZ_SEED is a number"))
}

/// Inputs to run: unchanged ones first, then endless mutations.
struct Inputs<'a> {
    target: &'a Target,
    seed: u64,
    /// Inputs that are only run unchanged: the named files, or the requested ones.
    whole: Vec<Vec<u8>>,
    /// Inputs that are run unchanged and mutated: the seeds and the regressions.
    seeds: Vec<Vec<u8>>,
    /// True if mutations follow.
    changes: bool,
}

impl<'a> Inputs<'a> {
    fn new(target: &'a Target, corpus: &Path) -> Self {
        if let Some(path) = variable(INPUT_VARIABLE) {
            return Self { target, seed: 0, whole: files(Path::new(&path)), seeds: Vec::new(), changes: false };
        }
        let whole = (target.named)().into_iter().map(|(_, bytes)| bytes).collect();
        let mut seeds = (target.seeds)();
        seeds.extend(files(&corpus.join(target.name)));
        Self { target, seed: seed(), whole, seeds, changes: true }
    }

    fn get(&self, index: u64) -> Option<Vec<u8>> {
        let whole = usize::try_from(index).ok().and_then(|index| self.whole.iter().chain(&self.seeds).nth(index));
        if let Some(whole) = whole {
            return Some(whole.clone());
        }
        self.changes.then(|| mutate::input(self.seed, self.target.name, index, &self.seeds, &words(self.target)))
    }
}

fn words(target: &Target) -> Vec<&'static str> {
    target.words.split('¦').filter(|word| !word.is_empty()).collect()
}

/// Reads the files of a folder by name, or a single file; empty if the path does not exist.
fn files(path: &Path) -> Vec<Vec<u8>> {
    if path.is_file() {
        return vec![fs::read(path).expect("a file that is there")];
    }
    let Ok(listed) = fs::read_dir(path) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = listed.filter_map(|entry| Some(entry.ok()?.path())).filter(|p| p.is_file()).collect();
    paths.sort();
    paths.iter().map(|path| fs::read(path).expect("a file that is there")).collect()
}

/// Runs the target `name` of `targets`: the body of a test of that name. `memory` is the test's allocator, `corpus` has
/// a folder of regressions for each target, and failing inputs are kept in `found`.
///
/// # Panics
/// If an input breaks a rule; the message names the input and the command to run it again.
pub fn run(name: &str, targets: &[Target], memory: &Cap<System>, corpus: &Path, found: &Path) {
    let target = targets.iter().find(|target| target.name == name).expect("a target of that name");
    match variable(STATE_VARIABLE) {
        Some(state) => child(target, &Inputs::new(target, corpus), memory, Path::new(&state)),
        None => parent(target, corpus, found),
    }
}

thread_local! {
    static SAID: RefCell<String> = const { RefCell::new(String::new()) };
}

/// CPU seconds that this thread has used.
fn cpu() -> f64 {
    let used = getrusage(UsageWho::RUSAGE_THREAD).expect("the system counts");
    let seconds = |time: nix::sys::time::TimeVal| time.tv_sec() as f64 + time.tv_usec() as f64 * 1e-6;
    seconds(used.user_time()) + seconds(used.system_time())
}

/// Runs one input. Returns the reason if it fails.
fn verdict(target: &Target, bytes: &[u8], memory: &Cap<System>) -> Result<bool, String> {
    let before = cpu();
    let most = target.memory + MEMORY_FACTOR * bytes.len();
    memory.set_limit(memory.allocated() + most).expect("no more than is there is asked for");
    let accepted = catch_unwind(AssertUnwindSafe(|| (target.run)(bytes)));
    memory.set_limit(usize::MAX).expect("more than there is");
    let took = cpu() - before;
    let accepted = accepted.map_err(|_| format!("panics: {}", SAID.take()))?;
    if took > CPU_S {
        return Err(format!("takes {took:.1} s of a processor; at most {CPU_S} s are allowed"));
    }
    Ok(accepted)
}

fn child(target: &Target, inputs: &Inputs<'_>, memory: &Cap<System>, state: &Path) {
    // The caller reports a caught panic; thousands of backtraces would only hide it.
    std::panic::set_hook(Box::new(|info| SAID.set(info.to_string().chars().take(2_000).collect())));
    let state = File::options().write(true).open(state).expect("the file that the test made");
    let seconds =
        variable(SECONDS_VARIABLE).map_or(SECONDS, |value| value.parse().expect("STRIDE_FUZZ_SECONDS is a number"));
    let end = Instant::now() + Duration::from_secs(seconds);
    let (mut accepted, mut bytes_in_all, mut index) = (0_u64, 0, 0_u64);
    while let Some(bytes) = inputs.get(index) {
        if Instant::now() > end && index >= (inputs.whole.len() + inputs.seeds.len()) as u64 {
            break;
        }
        state.write_all_at(&index.to_le_bytes(), 0).expect("the file that the test made");
        match verdict(target, &bytes, memory) {
            Ok(good) => accepted += u64::from(good),
            Err(why) => {
                // The panic hook prints nothing.
                eprintln!("input {index} of `{}` {why}", target.name);
                std::process::exit(1);
            }
        }
        bytes_in_all += bytes.len() as u64;
        index += 1;
    }
    eprintln!("{}: {index} inputs of {bytes_in_all} bytes, {accepted} accepted", target.name);
    std::process::exit(0);
}

/// Waits for the process as long as it advances from input to input.
fn wait(child: &mut Child, state: &File) -> Option<std::process::ExitStatus> {
    let at = || {
        let mut bytes = [0; 8];
        state.read_exact_at(&mut bytes, 0).map_or(0, |()| u64::from_le_bytes(bytes))
    };
    let (mut last, mut since) = (at(), Instant::now());
    loop {
        if let Some(status) = child.try_wait().expect("the process can be waited for") {
            return Some(status);
        }
        let now = at();
        if now != last {
            (last, since) = (now, Instant::now());
        }
        if since.elapsed() > HANGS {
            child.kill().expect("a process of ours");
            child.wait().expect("a process of ours");
            return None;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn parent(target: &Target, corpus: &Path, found: &Path) {
    let name = target.name;
    let state = tempfile::NamedTempFile::new().expect("a file for the state");
    state.as_file().write_all_at(&0_u64.to_le_bytes(), 0).expect("a file of ours");
    let mut command = Command::new(std::env::current_exe().expect("this program"));
    command.args([name, "--exact", "--nocapture", "--test-threads=1"]).env(STATE_VARIABLE, state.path());
    let mut child = command.stdin(Stdio::null()).spawn().expect("this program starts");
    let status = wait(&mut child, state.as_file());
    if status.is_some_and(|status| status.success()) {
        return;
    }
    let mut index = [0; 8];
    state.as_file().read_exact_at(&mut index, 0).expect("a file of ours");
    let index = u64::from_le_bytes(index);
    let inputs = Inputs::new(target, corpus);
    let bytes = inputs.get(index).unwrap_or_default();
    fs::create_dir_all(found).expect("a folder for what was found");
    let file = found.join(format!("{name}-{}", Digest::of(&bytes).short()));
    fs::write(&file, &bytes).expect("a file for what was found");
    let what = match status {
        None => format!("did not end in {} s", HANGS.as_secs()),
        Some(status) if status.code() == Some(1) => "broke a rule (see above)".into(),
        // SIGABRT: std's reaction to a failed allocation and to a stack overflow.
        Some(status) if status.signal() == Some(6) => format!(
            "was stopped: it asked for more than {} bytes and {MEMORY_FACTOR} times its {} bytes, or overflowed the stack (see above)",
            target.memory,
            bytes.len()
        ),
        Some(status) => format!("ended the process with {status}"),
    };
    let again = format!("{INPUT_VARIABLE}={} cargo test {name} -- --exact --nocapture", file.display());
    panic!(
        "input {index} of `{name}` (seed {}) {what}\nit is kept in {}\nagain: {again}\nonce mended, keep it: cp {} fuzz/corpus/{name}/",
        inputs.seed,
        file.display(),
        file.display()
    );
}
