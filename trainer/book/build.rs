//! Renders the chapters of `docs/book/src` to HTML without scripts, inline styles or markup of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use pulldown_cmark::{Alignment, CowStr, Event, Options, Parser, Tag, TagEnd, html};

#[path = "../../tests/src/book.rs"]
#[expect(dead_code, unreachable_pub, reason = "the checks of the documents use the rest")]
mod source;

fn main() {
    let root = source::plain(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../.."));
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo names the folder"));
    let mut files = Files { out, names: BTreeMap::new() };
    for folder in ["docs", "ops/README.md", "trainer/page/static/icon.svg", "trainer/book/static"] {
        println!("cargo::rerun-if-changed={}", root.join(folder).display());
    }
    println!("cargo::rerun-if-changed=build.rs");
    let chapters = source::chapters(&root);
    let mut pictures = BTreeSet::new();
    for (number, chapter) in chapters.iter().enumerate() {
        let text = source::expanded(&source::source(&root).join(&chapter.path));
        let rendered = Rendered::of(&text, Path::new(&chapter.path), &mut pictures);
        let name = html_name(&chapter.path);
        let around = (number.checked_sub(1).map(|before| &chapters[before]), chapters.get(number + 1));
        files.add(&name, document(&root, chapter, &rendered.body, around).as_bytes());
        files.add(&chapter.path, without_comments(&text).as_bytes());
    }
    for picture in pictures {
        let path = source::source(&root).join(&picture);
        files.add(&picture, &fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())));
    }
    files.add("llms.txt", list_of_chapters(&root, &chapters).as_bytes());
    for (name, path) in [("book.css", "trainer/book/static/book.css"), ("icon.svg", "trainer/page/static/icon.svg")] {
        files.add(name, &fs::read(root.join(path)).unwrap_or_else(|e| panic!("{path}: {e}")));
    }
    files.list();
}

/// The files of the book: name below `/book/`, and where its bytes are.
struct Files {
    out: PathBuf,
    names: BTreeMap<String, PathBuf>,
}

impl Files {
    fn add(&mut self, name: &str, bytes: &[u8]) {
        let path = self.out.join(name.replace('/', "--"));
        fs::write(&path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(self.names.insert(name.to_owned(), path).is_none(), "`{name}` is twice in the book");
    }

    /// Writes the list of all files that `lib.rs` includes.
    fn list(&self) {
        let mut code = format!("static RENDERED: [(&str, &[u8]); {}] = [\n", self.names.len());
        for (name, path) in &self.names {
            let _ = writeln!(code, "    ({name:?}, include_bytes!({:?})),", path.display().to_string());
        }
        code.push_str("];\n");
        fs::write(self.out.join("rendered.rs"), code).expect("the list is written");
    }
}

/// The address of a chapter, below the book.
fn html_name(path: &str) -> String {
    path.strip_suffix(".md").map_or_else(|| path.to_owned(), |name| format!("{name}.html"))
}

/// A chapter's target as it is in HTML: another chapter by its HTML file, everything else unchanged.
fn html_target(target: &str) -> String {
    let (file, anchor) = target.split_once('#').map_or((target, None), |(file, anchor)| (file, Some(anchor)));
    if target.contains("://") || !file.ends_with(".md") {
        return target.to_owned();
    }
    anchor.map_or_else(|| html_name(file), |anchor| format!("{}#{anchor}", html_name(file)))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A text without its comments, which are notes to the tests of commands.
fn without_comments(text: &str) -> String {
    text.lines().filter(|line| !line.starts_with("<!--")).fold(String::new(), |whole, line| whole + line + "\n")
}

struct Rendered {
    body: String,
}

impl Rendered {
    /// Renders the text of the chapter at `path`, and adds the pictures that it shows to `pictures`.
    fn of(text: &str, path: &Path, pictures: &mut BTreeSet<String>) -> Self {
        let mut headings = source::anchors(text).into_iter();
        let mut taken: BTreeSet<String> = source::anchors(text).into_iter().collect();
        let mut row = Row::None;
        let events = Parser::new_ext(text, Options::ENABLE_TABLES).flat_map(|event| match event {
            Event::Start(Tag::Heading { level, classes, attrs, .. }) => {
                let id = headings.next().unwrap_or_else(|| panic!("{}: a heading without a name", path.display()));
                vec![Event::Start(Tag::Heading { level, id: Some(id.into()), classes, attrs })]
            }
            // Alignments would be inline styles. A wide table scrolls by itself.
            Event::Start(Tag::Table(alignments)) => vec![
                Event::Html("<div class=\"table\" tabindex=\"0\">".into()),
                Event::Start(Tag::Table(vec![Alignment::None; alignments.len()])),
            ],
            Event::End(TagEnd::Table) => vec![event, Event::Html("</div>\n".into())],
            Event::Start(Tag::Link { link_type, dest_url, title, id }) => {
                vec![Event::Start(Tag::Link { link_type, dest_url: html_target(&dest_url).into(), title, id })]
            }
            Event::Start(Tag::Image { ref dest_url, .. }) => {
                let beside = path.with_file_name("").join(dest_url.as_ref());
                pictures.insert(source::plain(&beside).display().to_string());
                vec![event]
            }
            Event::Html(comment) | Event::InlineHtml(comment) => {
                let is_comment = comment.trim().is_empty() || comment.trim_start().starts_with("<!--");
                assert!(is_comment, "{}: markup in a chapter: {comment}", path.display());
                Vec::new()
            }
            Event::Start(Tag::HtmlBlock) | Event::End(TagEnd::HtmlBlock) => Vec::new(),
            other => vec![row.named(other, &mut taken)],
        });
        let mut body = String::with_capacity(2 * text.len());
        html::push_html(&mut body, events);
        assert!(headings.next().is_none(), "{}: a heading was not rendered", path.display());
        Self { body }
    }
}

/// The parser's position in a row of a table.
#[derive(PartialEq)]
enum Row {
    None,
    FirstCell,
    Rest,
}

impl Row {
    /// Gives the code in the first cell of a row a name, such as an error code's, by which links reach it.
    fn named<'a>(&mut self, event: Event<'a>, taken: &mut BTreeSet<String>) -> Event<'a> {
        match &event {
            Event::Start(Tag::TableRow) => *self = Self::FirstCell,
            Event::End(TagEnd::TableCell) if *self == Self::FirstCell => *self = Self::Rest,
            Event::End(TagEnd::TableRow) => *self = Self::None,
            Event::Code(code) if *self == Self::FirstCell => {
                let is_name = code.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.'));
                if is_name && taken.insert(code.to_string()) {
                    let code = escaped(code);
                    return Event::InlineHtml(CowStr::from(format!("<code id=\"{code}\">{code}</code>")));
                }
            }
            _ => {}
        }
        event
    }
}

/// The table of contents with the chapter at `path` marked, from `SUMMARY.md`.
fn contents(root: &Path, path: &str, up: &str) -> String {
    let text = fs::read_to_string(source::source(root).join("SUMMARY.md")).expect("SUMMARY.md");
    let mut headings = 0;
    let events = Parser::new(&text).map(|event| match event {
        Event::Start(Tag::Heading { .. }) => {
            headings += 1;
            Event::Html(if headings == 1 { "<p class=\"unseen\">" } else { "<p class=\"part\">" }.into())
        }
        Event::End(TagEnd::Heading(_)) => Event::Html("</p>\n".into()),
        Event::Start(Tag::Link { dest_url, .. }) => {
            let mark = if *dest_url == *path { " aria-current=\"page\"" } else { "" };
            Event::InlineHtml(format!("<a href=\"{up}{}\"{mark}>", html_name(&dest_url)).into())
        }
        Event::End(TagEnd::Link) => Event::InlineHtml("</a>".into()),
        other => other,
    });
    let mut list = String::new();
    html::push_html(&mut list, events);
    list
}

/// The whole document of a chapter between the one before and the next.
fn document(
    root: &Path,
    chapter: &source::Chapter,
    body: &str,
    (before, next): (Option<&source::Chapter>, Option<&source::Chapter>),
) -> String {
    let up = "../".repeat(chapter.path.matches('/').count());
    let turn = |to: Option<&source::Chapter>, class: &str| {
        to.map_or_else(String::new, |to| {
            let name = html_name(&to.path);
            let title = escaped(&to.title);
            format!("<a class=\"{class}\" rel=\"{class}\" href=\"{up}{name}\">{title}</a>\n")
        })
    };
    let title = escaped(&chapter.title);
    let list = contents(root, &chapter.path, &up);
    let before = turn(before, "prev");
    let next = turn(next, "next");
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>{title} · Stride</title>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <link rel=\"icon\" href=\"{up}icon.svg\" type=\"image/svg+xml\">\n\
         <link rel=\"stylesheet\" href=\"{up}book.css\">\n</head>\n<body>\n\
         <a class=\"skip\" href=\"#main\">Skip to the content</a>\n\
         <header><a class=\"brand\" href=\"/\">Stride</a> <span>the book</span> <a class=\"to-list\" href=\"#contents\">Chapters</a></header>\n\
         <div class=\"columns\">\n<main id=\"main\">\n{body}\n<nav class=\"turn\" aria-label=\"Turn the page\">\n{before}{next}</nav>\n</main>\n\
         <nav id=\"contents\" class=\"contents\" aria-label=\"Chapters\">\n{list}</nav>\n</div>\n</body>\n</html>\n"
    )
}

/// `llms.txt`: the chapters' text by their addresses.
fn list_of_chapters(root: &Path, chapters: &[source::Chapter]) -> String {
    let about = source::llms(root);
    let (about, _) = about.split_once("## Chapters").expect("a list of chapters");
    let line = |chapter: &source::Chapter| format!("- [{}]({})\n", chapter.title, chapter.path);
    format!("{about}## Chapters\n\n{}", chapters.iter().map(line).collect::<String>())
}
