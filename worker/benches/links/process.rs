//! The processes of members, and the lines that they and this process exchange.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use cluster_tests::network::Network;

use crate::{Result, SLICES};

/// Port on which members listen.
const PORT: u16 = 7800;
/// Longest wait for a line of a member.
const PATIENCE: Duration = Duration::from_secs(180);

/// The program of a member.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Program<'a> {
    /// A gang of Stride.
    Stride,
    /// gloo's all-reduce, by this Python.
    Gloo(&'a str),
}

impl Program<'_> {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Stride => "stride",
            Self::Gloo(_) => "gloo",
        }
    }
}

/// A line of a member, with its number.
#[derive(Debug)]
pub(crate) struct Said {
    pub(crate) who: usize,
    pub(crate) words: Vec<String>,
}

/// Members as processes, each on a host of its own.
pub(crate) struct Processes<'a> {
    network: &'a Network,
    program: Program<'a>,
    /// Numbers of a member's gradient, and of its state for each of them.
    size: (usize, usize),
    running: Vec<Option<(Child, ChildStdin)>>,
    sender: Sender<Said>,
    receiver: Receiver<Said>,
    generation: u64,
}

impl<'a> Processes<'a> {
    pub(crate) fn new(network: &'a Network, program: Program<'a>, size: (usize, usize)) -> Self {
        let (sender, receiver) = mpsc::channel();
        Self { network, program, size, running: Vec::new(), sender, receiver, generation: 0 }
    }

    fn address(&self, who: usize) -> String {
        format!("{}:{PORT}", self.network.host(who))
    }

    /// Starts member `who` and waits until it listens.
    pub(crate) fn start(&mut self, who: usize) -> Result {
        let mut command: Vec<String> = self.network.inside(who);
        match self.program {
            Program::Stride => command.extend([std::env::current_exe()?.display().to_string(), "member".to_owned()]),
            Program::Gloo(python) => {
                let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/links/gloo.py");
                command.extend([python, script].map(str::to_owned));
            }
        }
        let (parameters, copies) = self.size;
        command.extend([format!("w{who}"), self.address(who)]);
        command.extend([parameters, copies, SLICES].map(|number| number.to_string()));
        let mut child =
            Command::new(&command[0]).args(&command[1..]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let stdin = child.stdin.take().ok_or("no standard input")?;
        let stdout = BufReader::new(child.stdout.take().ok_or("no standard output")?);
        let sender = self.sender.clone();
        thread::spawn(move || {
            for line in stdout.lines().map_while(std::io::Result::ok) {
                let words = line.split(' ').map(str::to_owned).collect();
                if sender.send(Said { who, words }).is_err() {
                    return;
                }
            }
        });
        self.running.resize_with(self.running.len().max(who + 1), || None);
        self.running[who] = Some((child, stdin));
        self.await_from("listens", &[who]).map(drop)
    }

    /// Waits until member `who` has an answer of each of `members`, as a worker does before it joins.
    pub(crate) fn prepare(&mut self, who: usize, members: &[usize]) -> Result {
        let addresses: Vec<String> = members.iter().map(|who| self.address(*who)).collect();
        self.tell(who, &format!("probe {}", addresses.join(" ")));
        self.await_from("ready", &[who]).map(drop)
    }

    /// Sends a member a line. One that has ended misses it.
    pub(crate) fn tell(&mut self, who: usize, line: &str) {
        if let Some((_, stdin)) = self.running.get_mut(who).and_then(Option::as_mut) {
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Makes these members the next generation, and returns its number.
    pub(crate) fn regroup(&mut self, members: &[usize]) -> u64 {
        self.generation += 1;
        let list: Vec<String> = members.iter().map(|who| format!("w{who}={}", self.address(*who))).collect();
        let line = format!("gang {} {}", self.generation, list.join(" "));
        members.iter().for_each(|who| self.tell(*who, &line));
        self.generation
    }

    /// The next line of a member.
    pub(crate) fn next(&self) -> Result<Said> {
        Ok(self.receiver.recv_timeout(PATIENCE).map_err(|_| "no member says anything")?)
    }

    /// Waits until all of `members` have written a line that starts with `word`. Returns them in their order.
    pub(crate) fn await_from(&self, word: &str, members: &[usize]) -> Result<Vec<Said>> {
        let mut heard: Vec<Said> = Vec::new();
        let until = Instant::now() + PATIENCE;
        while heard.len() < members.len() {
            if Instant::now() > until {
                return Err(format!("only {} of {} members said `{word}`", heard.len(), members.len()).into());
            }
            let said = self.next()?;
            if said.words[0] == "failed" {
                return Err(said.words.join(" ").into());
            }
            if said.words[0] == word {
                heard.push(said);
            }
        }
        heard.sort_by_key(|said| said.who);
        Ok(heard)
    }

    /// Kills a member with `kill -9`.
    pub(crate) fn kill(&mut self, who: usize) {
        if let Some((mut child, _)) = self.running.get_mut(who).and_then(Option::take) {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Drop for Processes<'_> {
    fn drop(&mut self) {
        (0..self.running.len()).for_each(|who| self.kill(who));
    }
}
