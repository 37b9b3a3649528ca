//! The viewer in a real browser. Two times give two pictures that differ in the figures, in the clock and its slider,
//! and nowhere else. The page requests nothing but the file, and it plays by itself.
//!
//! The test needs Chromium or Chrome (on Debian `apt-get install chromium`), or a path to one in `STRIDE_BROWSER`;
//! without one it prints that it skips. It uses the DevTools protocol through two named pipes, JSON with a zero after
//! each message.

mod base64;

use std::fs::{File, OpenOptions};
use std::io::{Cursor, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use mocap::Body;
use mocap::html::{Page, Panel, Section};
use motion::{Skeleton, features, synthetic};
use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};
use serde_json::{Value, json};

use self::base64::decoded;

/// Time limit for an answer of the browser.
const PATIENCE: Duration = Duration::from_secs(90);
/// Size of the window in pixels.
const WINDOW: [usize; 2] = [900, 1200];
/// Resolves once the requested frame is drawn.
const DRAWN: &str = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(() => done(1)))))";

/// Finds a browser on this machine.
fn program() -> Option<PathBuf> {
    if let Some(told) = std::env::var_os("STRIDE_BROWSER") {
        return Some(told.into());
    }
    let folders: Vec<PathBuf> = std::env::var_os("PATH").iter().flat_map(std::env::split_paths).collect();
    let names = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"];
    names.iter().flat_map(|name| folders.iter().map(move |folder| folder.join(name))).find(|path| path.is_file())
}

/// A running browser.
struct Browser {
    process: Child,
    input: File,
    messages: Receiver<Value>,
    events: Vec<Value>,
    session: Option<String>,
    calls: u64,
}

impl Drop for Browser {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Browser {
    fn start(program: &Path, folder: &Path) -> Self {
        for name in ["in", "out"] {
            assert!(Command::new("mkfifo").arg(folder.join(name)).status().expect("mkfifo runs").success());
        }
        let open =
            |name: &str| OpenOptions::new().read(true).write(true).open(folder.join(name)).expect("a pipe of ours");
        let (input, mut output) = (open("in"), open("out"));
        // The protocol uses descriptors 3 and 4. The sandbox needs rights that containers lack, and the page is ours.
        let line = "exec \"$0\" --headless=new --no-sandbox --disable-gpu --no-first-run --disable-dev-shm-usage --hide-scrollbars \
                    --user-data-dir=\"$1/profile\" --remote-debugging-pipe about:blank 3<\"$1/in\" 4>\"$1/out\"";
        let mut command = Command::new("sh");
        command.args(["-c", line]).arg(program).arg(folder);
        let process =
            command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("sh runs");
        let (sender, messages) = channel();
        std::thread::spawn(move || {
            let (mut held, mut part) = (Vec::new(), vec![0; 64 << 10]);
            while let Ok(count) = output.read(&mut part) {
                held.extend_from_slice(&part[..count]);
                while let Some(end) = held.iter().position(|byte| *byte == 0) {
                    let message: Vec<u8> = held.drain(..=end).collect();
                    let message = serde_json::from_slice(&message[..end]).expect("the browser speaks JSON");
                    if sender.send(message).is_err() {
                        return;
                    }
                }
            }
        });
        Self { process, input, messages, events: Vec::new(), session: None, calls: 0 }
    }

    fn next(&self) -> Value {
        self.messages.recv_timeout(PATIENCE).expect("the browser answers")
    }

    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.calls += 1;
        let mut message = json!({"id": self.calls, "method": method, "params": parameters});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        self.input.write_all(&bytes).expect("the browser listens");
        loop {
            let answer = self.next();
            if answer["id"] == self.calls {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
            self.events.push(answer);
        }
    }

    fn open(&mut self, url: &str) {
        let target = self.call("Target.createTarget", json!({"url": "about:blank"}))["targetId"].clone();
        let session = self.call("Target.attachToTarget", json!({"targetId": target, "flatten": true}));
        self.session = Some(session["sessionId"].as_str().expect("a session").to_owned());
        self.call("Page.enable", json!({}));
        self.call("Network.enable", json!({}));
        self.call("Log.enable", json!({}));
        let [width, height] = WINDOW;
        let window = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        self.call("Emulation.setDeviceMetricsOverride", window);
        self.call("Page.navigate", json!({"url": url}));
        while !self.events.iter().any(|event| event["method"] == "Page.loadEventFired") {
            let event = self.next();
            self.events.push(event);
        }
    }

    fn evaluate(&mut self, expression: &str) -> Value {
        let asked = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let answer = self.call("Runtime.evaluate", asked);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// The window's pixels at a time, `[height, width, 3]`.
    fn picture(&mut self, seconds: f64) -> Vec<u8> {
        self.evaluate(&format!("location.hash = '#t={seconds}'"));
        // The address changes first, and the page is notified.
        let clock = format!("{seconds:.2} of ");
        let since = Instant::now();
        while !self
            .evaluate(&format!("{DRAWN}.then(() => document.getElementById('clock').textContent)"))
            .as_str()
            .is_some_and(|text| text.starts_with(&clock))
        {
            assert!(since.elapsed() < PATIENCE, "the clock never says {clock}");
        }
        self.evaluate(DRAWN);
        let shot = self.call("Page.captureScreenshot", json!({"format": "png"}));
        let bytes = decoded(shot["data"].as_str().expect("a picture"));
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a small picture")];
        let info = reader.next_frame(&mut pixels).expect("a PNG");
        assert_eq!([info.width as usize, info.height as usize], WINDOW);
        let channels = info.color_type.samples();
        pixels.chunks_exact(channels).flat_map(|pixel| pixel[..3].iter().copied()).collect()
    }

    /// Left, top, right and bottom of the elements of a selector.
    fn places(&mut self, selector: &str) -> Vec<[f64; 4]> {
        let rectangle = "(e) => { const r = e.getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; }";
        let found = self.evaluate(&format!("[...document.querySelectorAll('{selector}')].map({rectangle})"));
        serde_json::from_value(found).expect("rectangles")
    }
}

/// A page with a moving figure beside a standing one.
fn page(file: &Path) {
    let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(3));
    let joints = features::recover_joints(&dataset.clips[0].features, dataset.skeleton());
    assert!(joints.len() > 40 * 66, "longer than two seconds");
    let still = joints[..66].repeat(joints.len() / 66);
    let body = Body::of(Skeleton::of(DataFormat::Humanml3d));
    let panel = |caption: &str, joints| Panel {
        caption: caption.into(),
        note: String::new(),
        body: &body,
        joints,
        waypoints: &[],
    };
    let sections =
        vec![Section { title: String::new(), panels: vec![panel("moves", &joints), panel("stands", &still)] }];
    let page = Page { title: "two figures".into(), sections };
    page.write(File::create(file).expect("a file of ours")).expect("a page");
}

#[test]
fn a_figure_moves_and_nothing_else_does() {
    let Some(program) = program() else {
        fixtures::skip("no Chromium here to show the viewer in; `apt-get install chromium`, or set STRIDE_BROWSER");
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("page.html");
    page(&file);
    let mut browser = Browser::start(&program, folder.path());
    let url = format!("file://{}#t=0.5", file.display());
    browser.open(&url);
    let canvases = browser.places("canvas");
    let [moves, stands] = canvases[..] else { panic!("two figures, not {canvases:?}") };
    let controls = browser.places("#time, #clock");
    assert!(controls.iter().all(|place| place[3] <= WINDOW[1] as f64), "all is in the window: {controls:?}");
    // The first picture may show a button that is still being drawn.
    browser.picture(1.0);
    let (one, other) = (browser.picture(0.5), browser.picture(1.5));
    assert!(one == browser.picture(0.5), "a time has one picture");

    let within = |[left, top, right, bottom]: [f64; 4], x: f64, y: f64| {
        left <= x + 1.0 && x <= right && top <= y + 1.0 && y <= bottom
    };
    let (mut in_figure, mut in_still, mut in_controls, mut elsewhere) = (0, 0, 0, Vec::new());
    for (at, (a, b)) in one.chunks_exact(3).zip(other.chunks_exact(3)).enumerate() {
        let (x, y) = ((at % WINDOW[0]) as f64, (at / WINDOW[0]) as f64);
        match a == b {
            true => {}
            false if within(moves, x, y) => in_figure += 1,
            false if within(stands, x, y) => in_still += 1,
            false if controls.iter().any(|place| within(*place, x, y)) => in_controls += 1,
            false => elsewhere.push((x, y)),
        }
    }
    eprintln!("{in_figure} pixels of the figure differ, {in_controls} of clock and slider");
    assert!(in_figure > 300, "the figure moves: {in_figure} pixels");
    assert_eq!(in_still, 0, "the other one stands");
    assert!(in_controls > 0, "the clock goes");
    assert!(elsewhere.is_empty(), "{} pixels differ elsewhere, such as {:?}", elsewhere.len(), elsewhere.first());

    // Two figures have at least two colours: a blank page would also have no other differences.
    let colours: std::collections::BTreeSet<&[u8]> = one.chunks_exact(3).collect();
    assert!(colours.len() > 20, "{} colours", colours.len());

    let clock = |browser: &mut Browser| {
        browser.evaluate(&format!("{DRAWN}.then(() => document.getElementById('clock').textContent)"))
    };
    browser.evaluate("document.getElementById('play').click()");
    let (before, since) = (clock(&mut browser), Instant::now());
    while clock(&mut browser) == before {
        assert!(since.elapsed() < PATIENCE, "it plays");
    }

    let asked = browser.events.iter().filter(|event| event["method"] == "Network.requestWillBeSent");
    let asked: Vec<&str> = asked.filter_map(|event| event["params"]["request"]["url"].as_str()).collect();
    // The empty icon is inside the page itself.
    let others: Vec<&&str> =
        asked.iter().filter(|asked| !url.starts_with(**asked) && !asked.starts_with("data:")).collect();
    assert!(others.is_empty() && asked.iter().any(|asked| url.starts_with(*asked)), "{asked:?}");
    let said: Vec<&Value> = browser.events.iter().filter(|event| event["method"] == "Log.entryAdded").collect();
    assert!(said.is_empty(), "the browser complains: {said:?}");
}
