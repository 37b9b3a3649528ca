//! A headless Chromium for tests of pages.
//!
//! It speaks the DevTools protocol through two named pipes, JSON with a zero after each message. It needs Chromium or Chrome (on Debian
//! `apt-get install chromium`), or a path to one in `STRIDE_BROWSER`.

mod base64;

use std::fs::{File, OpenOptions};
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

pub use base64::decoded;

/// Time limit for an answer of the browser, and for a condition to hold.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// Says that a test checks pages for accessibility only with axe-core.
pub const AXE_MISSING: &str =
    "no axe-core here to check pages with; `npm install axe-core`, and set STRIDE_AXE to its axe.min.js";

/// Says that a test needs a browser.
pub const MISSING: &str = "no Chromium here to show pages in; `apt-get install chromium`, or set STRIDE_BROWSER";

/// Resolves once the requested frame is drawn.
pub const DRAWN: &str = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(() => done(1)))))";

/// Finds a browser on this machine.
#[must_use]
pub fn program() -> Option<PathBuf> {
    if let Some(told) = std::env::var_os("STRIDE_BROWSER") {
        return Some(told.into());
    }
    let folders: Vec<PathBuf> = std::env::var_os("PATH").iter().flat_map(std::env::split_paths).collect();
    let names = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"];
    names.iter().flat_map(|name| folders.iter().map(move |folder| folder.join(name))).find(|path| path.is_file())
}

/// The script of axe-core, if `STRIDE_AXE` names it. It checks a page for accessibility.
///
/// # Panics
///
/// If the file does not read.
#[must_use]
pub fn axe() -> Option<&'static str> {
    static AXE: OnceLock<Option<String>> = OnceLock::new();
    let read = || {
        std::env::var_os("STRIDE_AXE").map(|path| std::fs::read_to_string(path).expect("STRIDE_AXE names axe.min.js"))
    };
    AXE.get_or_init(read).as_deref()
}

/// Size of a window in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    pub width: usize,
    pub height: usize,
    /// A phone: with touch, and as wide as the device says.
    pub mobile: bool,
}

/// A running browser with one page.
#[derive(Debug)]
pub struct Browser {
    process: Child,
    input: File,
    messages: Receiver<Value>,
    /// Unsolicited messages, such as requests and violations.
    pub events: Vec<Value>,
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
    /// Starts `program` with its profile and pipes in `folder`.
    ///
    /// # Panics
    ///
    /// If it does not start.
    #[must_use]
    pub fn start(program: &Path, folder: &Path) -> Self {
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

    /// Calls a method of the protocol.
    ///
    /// # Panics
    ///
    /// If it is refused.
    pub fn call(&mut self, method: &str, parameters: &Value) -> Value {
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

    /// Opens a page in a window.
    pub fn open(&mut self, url: &str, window: Window) {
        self.session = None;
        let target = self.call("Target.createTarget", &json!({"url": "about:blank"}))["targetId"].clone();
        let session = self.call("Target.attachToTarget", &json!({"targetId": target, "flatten": true}));
        self.session = Some(session["sessionId"].as_str().expect("a session").to_owned());
        for domain in ["Page", "Network", "Log", "Runtime"] {
            self.call(&format!("{domain}.enable"), &json!({}));
        }
        self.resize(window);
        self.go(url);
    }

    /// Gives the window another size.
    pub fn resize(&mut self, window: Window) {
        let Window { width, height, mobile } = window;
        let size = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile});
        self.call("Emulation.setDeviceMetricsOverride", &size);
        self.call("Emulation.setTouchEmulationEnabled", &json!({"enabled": mobile}));
    }

    /// Sets the preferred colour scheme to dark or light.
    pub fn prefer_dark(&mut self, dark: bool) {
        let value = if dark { "dark" } else { "light" };
        let features = json!({"features": [{"name": "prefers-color-scheme", "value": value}]});
        self.call("Emulation.setEmulatedMedia", &features);
    }

    /// Loads another address in the same window.
    pub fn go(&mut self, url: &str) {
        let before = self.loads();
        self.call("Page.navigate", &json!({"url": url}));
        while self.loads() == before {
            let event = self.next();
            self.events.push(event);
        }
    }

    fn loads(&self) -> usize {
        self.events.iter().filter(|event| event["method"] == "Page.loadEventFired").count()
    }

    /// The value of a script's expression.
    ///
    /// # Panics
    ///
    /// If it throws.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let asked = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let answer = self.call("Runtime.evaluate", &asked);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    ///
    /// # Panics
    ///
    /// If it never is; says what the page shows.
    pub fn until(&mut self, expression: &str) {
        let since = Instant::now();
        while self.evaluate(&format!("{DRAWN}.then(() => Boolean({expression}))")) != json!(true) {
            if since.elapsed() > PATIENCE {
                let text = self.evaluate("document.body.innerText");
                panic!("`{expression}` never holds; the page shows {text}");
            }
        }
    }

    /// Problems that axe-core finds on the page: the rule, the number of elements and the first element. Empty without axe-core.
    pub fn inaccessible(&mut self) -> Vec<String> {
        let Some(axe) = axe() else { return Vec::new() };
        self.evaluate(&format!("{axe};1"));
        let found = "axe.run(document, {resultTypes: ['violations']}).then(({violations}) => violations.map(({id, nodes}) => \
                     `${id} (${nodes.length}): ${nodes[0].html.slice(0, 200)}`))";
        serde_json::from_value(self.evaluate(found)).expect("a list of texts")
    }

    /// Presses a key.
    pub fn press(&mut self, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            let mut event = json!({"type": kind, "key": key, "code": key});
            if key == "Enter" {
                event["text"] = json!("\r");
                event["windowsVirtualKeyCode"] = json!(13);
            }
            if key == "Tab" {
                event["windowsVirtualKeyCode"] = json!(9);
            }
            self.call("Input.dispatchKeyEvent", &event);
        }
    }

    /// Types text where the focus is.
    pub fn write(&mut self, text: &str) {
        self.call("Input.insertText", &json!({"text": text}));
    }

    /// The window as a PNG.
    pub fn screenshot(&mut self) -> Vec<u8> {
        let shot = self.call("Page.captureScreenshot", &json!({"format": "png"}));
        decoded(shot["data"].as_str().expect("a picture"))
    }

    /// Left, top, right and bottom of the elements of a selector.
    pub fn places(&mut self, selector: &str) -> Vec<[f64; 4]> {
        let rectangle = "(e) => { const r = e.getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; }";
        let found = self.evaluate(&format!("[...document.querySelectorAll('{selector}')].map({rectangle})"));
        serde_json::from_value(found).expect("rectangles")
    }

    /// The addresses that it requested so far.
    pub fn requested(&self) -> Vec<&str> {
        let asked = self.events.iter().filter(|event| event["method"] == "Network.requestWillBeSent");
        asked.filter_map(|event| event["params"]["request"]["url"].as_str()).collect()
    }

    /// What it complains of: refused requests, violations of the content policy, errors of scripts.
    pub fn complaints(&self) -> Vec<&Value> {
        let is_complaint = |event: &&Value| {
            matches!(event["method"].as_str(), Some("Log.entryAdded" | "Runtime.exceptionThrown"))
                || (event["method"] == "Runtime.consoleAPICalled" && event["params"]["type"] == "error")
        };
        self.events.iter().filter(is_complaint).collect()
    }
}
