//! The page that a server shows to browsers, as files of this binary.
//!
//! The files are ES modules written by hand, with two libraries beside them (`static/vendor`, unchanged, with their licences). They load
//! under a folder that is named after all of them, so that a browser may keep them for ever: another build has another folder. The page
//! knows the HTTP API alone, and this crate has no server.

use std::io::Write as _;
use std::sync::LazyLock;

use flate2::Compression;
use flate2::write::GzEncoder;
use protocol::Digest;

/// Content policy of the page: a browser loads and runs only its own files. Markup is made by one policy alone, that of the
/// vendored template library, whose templates are constants.
pub const CONTENT_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob:; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types lit-html";

/// The content policy of the document, whose scripts may also open a WebSocket to `stream`.
#[must_use]
pub fn content_policy(stream: Option<&str>) -> String {
    match stream {
        Some(stream) => CONTENT_POLICY.replace("connect-src 'self'", &format!("connect-src 'self' {stream}")),
        None => CONTENT_POLICY.to_owned(),
    }
}

/// A file of the page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct File {
    /// Its path below the folder.
    pub name: &'static str,
    /// Its MIME type.
    pub kind: &'static str,
    pub bytes: Vec<u8>,
    /// The same bytes, compressed; empty where that saves nothing.
    pub gzip: Vec<u8>,
    /// Its entity tag, with quotes.
    pub tag: String,
}

/// Written by the server in the place of the folder's name.
const FOLDER: &str = "FOLDER";

/// The viewer of motions as a module that exports `mount`, for pages of other crates.
pub const VIEWER: &str = include_str!("../static/viewer.js");

/// The style sheet of the viewer.
pub const VIEWER_STYLE: &str = include_str!("../static/viewer.css");

/// The addresses at which the page itself is shown: each is a view. The page itself parses the part after the last slash.
pub const VIEWS: [&str; 11] = [
    "/",
    "/runs",
    "/runs/{*rest}",
    "/compare",
    "/draw",
    "/data",
    "/data/{*rest}",
    "/models",
    "/models/{*rest}",
    "/workers",
    "/store",
];

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_bytes!(concat!("../static/", $name)).as_slice())),*]
    };
}

/// Everything that lies in `static` but licences.
static FILES: [(&str, &[u8]); 43] = files![
    "index.html",
    "icon.svg",
    "style.css",
    "main.js",
    "api.js",
    "session.js",
    "router.js",
    "format.js",
    "parts.js",
    "advice.js",
    "chart.js",
    "graph.js",
    "log.js",
    "rates.js",
    "viewer.js",
    "character.js",
    "motions.js",
    "floor.js",
    "drawing.js",
    "stream.js",
    "thumbnails.js",
    "features.js",
    "viewer.css",
    "settings.js",
    "history.js",
    "live.js",
    "lanes.js",
    "marks.js",
    "sweep.js",
    "views/now.js",
    "views/runs.js",
    "views/run.js",
    "views/stage.js",
    "views/compare.js",
    "views/draw.js",
    "views/data.js",
    "views/models.js",
    "views/workers.js",
    "views/store.js",
    "views/login.js",
    "vendor/lit-html.js",
    "vendor/uPlot.iife.min.js",
    "vendor/uPlot.min.css",
];

/// Written by the server in the place of links that load all modules at once, rather than each after the one that names it.
const PRELOADS: &str = "PRELOADS";

/// Scripts that the document does not need as modules at first.
const LATER: [&str; 2] = ["character.js", "vendor/uPlot.iife.min.js"];

struct Page {
    index: File,
    folder: String,
    files: Vec<File>,
}

static PAGE: LazyLock<Page> = LazyLock::new(|| {
    let all: String = FILES.iter().map(|(name, bytes)| format!("{name} {}\n", Digest::of(bytes))).collect();
    let folder = Digest::of(all.as_bytes()).hex()[..16].to_owned();
    let mut files: Vec<File> = FILES.iter().map(|(name, bytes)| File::new(name, bytes.to_vec())).collect();
    let index = files.remove(0);
    let modules = files.iter().filter(|file| file.name.ends_with(".js") && !LATER.contains(&file.name));
    let preloads = modules.map(|file| format!("<link rel=\"modulepreload\" href=\"/page/{FOLDER}/{}\">\n", file.name));
    let text = String::from_utf8_lossy(&index.bytes).replace(PRELOADS, preloads.collect::<String>().trim_end());
    let index = File::new(index.name, text.replace(FOLDER, &folder).into_bytes());
    Page { index, folder, files }
});

impl File {
    /// The file of this name and content, compressed unless it is a PNG, which is compressed already.
    #[must_use]
    pub fn new(name: &'static str, bytes: Vec<u8>) -> Self {
        let kind = kind(name);
        let mut gzip = Vec::new();
        if kind != "image/png" {
            let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
            // Writing to memory cannot fail.
            gzip = encoder.write_all(&bytes).and_then(|()| encoder.finish()).unwrap_or_default();
        }
        let tag = format!("\"{}\"", &Digest::of(&bytes).hex()[..32]);
        Self { name, kind, bytes, gzip, tag }
    }
}

fn kind(name: &str) -> &'static str {
    match name.rsplit_once('.').map(|(_, ending)| ending) {
        Some("html") => "text/html; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        Some("png") => "image/png",
        Some("md") => "text/markdown; charset=utf-8",
        Some("txt") => "text/plain; charset=utf-8",
        Some(_) | None => "application/octet-stream",
    }
}

/// The document that is shown at each of [`VIEWS`].
#[must_use]
pub fn index() -> &'static File {
    &PAGE.index
}

/// The name of the folder that the files lie in.
#[must_use]
pub fn folder() -> &'static str {
    &PAGE.folder
}

/// Returns the embedded file of this build at `folder/name`.
#[must_use]
pub fn find(folder: &str, name: &str) -> Option<&'static File> {
    PAGE.files.iter().find(|file| folder == PAGE.folder && file.name == name)
}

/// All files but the document.
pub fn files() -> impl Iterator<Item = &'static File> {
    PAGE.files.iter()
}
