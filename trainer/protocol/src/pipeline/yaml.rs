//! YAML as a tree whose every key and value knows where it stands.
//!
//! Built from the parser's events rather than from a ready-made document type, because we want every duplicate key with
//! both its places, and limits before anything is allocated: 1 MiB of text, 64 levels, 20,000 nodes after aliases are
//! expanded. Plain scalars follow the YAML 1.2 core schema, so `no` and `on` are texts.

use std::collections::HashMap;

use saphyr_parser::{Event, Parser, ScalarStyle, ScanError, Span};
use serde_json::{Number, Value};

use super::diagnostic::Position;

const MAX_BYTES: usize = 1 << 20;
const MAX_DEPTH: usize = 64;
const MAX_NODES: usize = 20_000;

/// A value and where it begins.
#[derive(Debug, Clone)]
pub(super) struct Node {
    pub(super) at: Position,
    pub(super) value: Content,
}

/// What a node is.
#[derive(Debug, Clone)]
pub(super) enum Content {
    /// Null, a flag, a number or a text. A number that is not finite keeps its text.
    Scalar { value: Value, text: String, plain: bool },
    /// A list.
    List(Vec<Node>),
    /// A mapping in the order of the file; keys are unique.
    Map(Vec<Entry>),
}

/// A key with its value.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) key: String,
    pub(super) key_at: Position,
    pub(super) value: Node,
}

/// A mistake in the text itself.
#[derive(Debug)]
pub(super) struct YamlError {
    pub(super) at: Position,
    pub(super) message: String,
    pub(super) help: Option<String>,
}

impl Node {
    pub(super) fn map(&self) -> Option<&[Entry]> {
        match &self.value {
            Content::Map(entries) => Some(entries),
            _ => None,
        }
    }

    pub(super) fn entry(&self, key: &str) -> Option<&Entry> {
        self.map()?.iter().find(|entry| entry.key == key)
    }

    /// The text of a scalar that is a text.
    pub(super) fn as_text(&self) -> Option<&str> {
        match &self.value {
            Content::Scalar { value: Value::String(text), .. } => Some(text),
            _ => None,
        }
    }

    /// As JSON; `None` if a number in it is not finite.
    pub(super) fn to_json(&self) -> Option<Value> {
        Some(match &self.value {
            Content::Scalar { value, text, plain } => {
                if *plain && is_not_finite(text) {
                    return None;
                }
                value.clone()
            }
            Content::List(items) => Value::Array(items.iter().map(Self::to_json).collect::<Option<_>>()?),
            Content::Map(entries) => {
                Value::Object(entries.iter().map(|e| Some((e.key.clone(), e.value.to_json()?))).collect::<Option<_>>()?)
            }
        })
    }

    /// For a message: `the text `x``, `the number 3`, `a list`.
    pub(super) fn describe(&self) -> String {
        match &self.value {
            Content::Scalar { text, plain: true, .. } if is_not_finite(text) => format!("`{text}`"),
            Content::Scalar { value: Value::Null, .. } => "nothing".into(),
            Content::Scalar { value: Value::Bool(flag), .. } => format!("the flag `{flag}`"),
            Content::Scalar { value: Value::Number(_), text, .. } => format!("the number `{text}`"),
            Content::Scalar { text, .. } => {
                let short: String = text.chars().take(40).collect();
                format!("the text `{short}{}`", if short.len() < text.len() { "..." } else { "" })
            }
            Content::List(items) => format!("a list of {}", items.len()),
            Content::Map(_) => "a mapping".into(),
        }
    }
}

/// `.nan`, `.inf`, `nan`, `inf`, or digits that overflow.
fn is_not_finite(text: &str) -> bool {
    let bare = text.trim_start_matches(['+', '-', '.']).to_ascii_lowercase();
    matches!(bare.as_str(), "nan" | "inf" | "infinity")
        || (text.contains(|c: char| c.is_ascii_digit()) && text.parse::<f64>().is_ok_and(|number| !number.is_finite()))
}

/// A plain scalar by the core schema.
fn resolve(text: &str) -> Value {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Value::Null,
        "true" | "True" | "TRUE" => return Value::Bool(true),
        "false" | "False" | "FALSE" => return Value::Bool(false),
        _ => {}
    }
    let numeric = text.bytes().any(|b| b.is_ascii_digit())
        && text.bytes().all(|b| b.is_ascii_digit() || matches!(b, b'+' | b'-' | b'.' | b'e' | b'E'));
    if numeric {
        let unsigned = text.strip_prefix('+').unwrap_or(text);
        if let Ok(whole) = unsigned.parse::<u64>() {
            return Value::from(whole);
        }
        if let Ok(whole) = text.parse::<i64>() {
            return Value::from(whole);
        }
        if let Some(number) = unsigned.parse::<f64>().ok().and_then(Number::from_f64) {
            return Value::Number(number);
        }
    }
    Value::String(text.to_owned())
}

/// Reads one document. `source` tells positions of different texts apart.
pub(super) fn parse(text: &str, source: usize) -> Result<Node, Vec<YamlError>> {
    let start = Position { source, line: 1, column: 1 };
    let fail = |message: String| vec![YamlError { at: start, message, help: None }];
    if text.len() > MAX_BYTES {
        return Err(fail(format!("the text has {} bytes; at most {MAX_BYTES} are read", text.len())));
    }
    let mut builder = Builder { source, nodes: 0, anchors: HashMap::new(), mistakes: Vec::new() };
    let mut parser = Parser::new_from_str(text.strip_prefix('\u{feff}').unwrap_or(text));
    let mut root = None;
    loop {
        match parser.next() {
            None | Some(Ok((Event::StreamEnd, _))) => break,
            Some(Ok((Event::StreamStart | Event::DocumentEnd | Event::Nothing, _))) => {}
            Some(Ok((Event::DocumentStart(_), span))) => {
                if root.is_some() {
                    builder.mistake(span, "a second document begins here; a pipeline is one document".into());
                    break;
                }
            }
            Some(Ok((event, span))) => match builder.node(event, span, &mut parser, 0) {
                Ok(node) => root = Some(node),
                Err(Stop::Scan(error)) => {
                    builder.scan_error(&error);
                    break;
                }
                Err(Stop::Limit) => break,
            },
            Some(Err(error)) => {
                builder.scan_error(&error);
                break;
            }
        }
    }
    match root {
        Some(root) if builder.mistakes.is_empty() => Ok(root),
        _ if !builder.mistakes.is_empty() => Err(builder.mistakes),
        _ => Err(fail("the text is empty; a pipeline has `name`, `dataset` and `stages`".into())),
    }
}

enum Stop {
    Scan(ScanError),
    /// A limit was passed; the mistake is recorded.
    Limit,
}

struct Builder {
    source: usize,
    nodes: usize,
    anchors: HashMap<usize, (Node, usize)>,
    mistakes: Vec<YamlError>,
}

impl Builder {
    fn position(&self, span: Span) -> Position {
        // The parser counts lines from 1 and columns from 0.
        Position { source: self.source, line: span.start.line().max(1), column: span.start.col() + 1 }
    }

    fn mistake(&mut self, span: Span, message: String) {
        let at = self.position(span);
        self.mistakes.push(YamlError { at, message, help: None });
    }

    fn scan_error(&mut self, error: &ScanError) {
        let mark = error.marker();
        let at = Position { source: self.source, line: mark.line().max(1), column: mark.col() + 1 };
        let help = match error.info() {
            info if info.contains("tab") => Some("indent with spaces".into()),
            info if info.contains("mapping values") || info.contains("simple key") => {
                Some("put a space after `:`, quote texts that hold `: `, and indent keys of one mapping alike".into())
            }
            _ => None,
        };
        self.mistakes.push(YamlError { at, message: format!("this is not YAML: {}", error.info()), help });
    }

    fn count(&mut self, span: Span, nodes: usize) -> Result<(), Stop> {
        self.nodes += nodes;
        if self.nodes > MAX_NODES {
            self.mistake(span, format!("the document has more than {MAX_NODES} values once aliases are expanded"));
            return Err(Stop::Limit);
        }
        Ok(())
    }

    fn next<'a>(parser: &mut Parser<'a, saphyr_parser::StrInput<'a>>) -> Result<(Event<'a>, Span), Stop> {
        match parser.next() {
            Some(Ok(pair)) => Ok(pair),
            Some(Err(error)) => Err(Stop::Scan(error)),
            None => Ok((Event::StreamEnd, Span::default())),
        }
    }

    fn node<'a>(
        &mut self,
        event: Event<'a>,
        span: Span,
        parser: &mut Parser<'a, saphyr_parser::StrInput<'a>>,
        depth: usize,
    ) -> Result<Node, Stop> {
        let at = self.position(span);
        if depth > MAX_DEPTH {
            self.mistake(span, format!("values are nested more than {MAX_DEPTH} deep"));
            return Err(Stop::Limit);
        }
        let before = self.nodes;
        self.count(span, 1)?;
        let (value, anchor) = match event {
            Event::Alias(id) => {
                let Some((node, size)) = self.anchors.get(&id).cloned() else {
                    self.mistake(span, "this alias refers to a value that contains it".into());
                    return Err(Stop::Limit);
                };
                self.count(span, size)?;
                return Ok(node);
            }
            Event::Scalar(text, style, anchor, _) => {
                let plain = style == ScalarStyle::Plain;
                let value = if plain { resolve(&text) } else { Value::String(text.to_string()) };
                (Content::Scalar { value, text: text.into_owned(), plain }, anchor)
            }
            Event::SequenceStart(anchor, _) => {
                let mut items = Vec::new();
                loop {
                    let (event, span) = Self::next(parser)?;
                    match event {
                        Event::SequenceEnd | Event::StreamEnd => break,
                        event => items.push(self.node(event, span, parser, depth + 1)?),
                    }
                }
                (Content::List(items), anchor)
            }
            Event::MappingStart(anchor, _) => (Content::Map(self.entries(parser, depth)?), anchor),
            _ => {
                self.mistake(span, "a value was expected here".into());
                return Err(Stop::Limit);
            }
        };
        let node = Node { at, value };
        if anchor != 0 {
            self.anchors.insert(anchor, (node.clone(), self.nodes - before));
        }
        Ok(node)
    }

    fn entries<'a>(
        &mut self,
        parser: &mut Parser<'a, saphyr_parser::StrInput<'a>>,
        depth: usize,
    ) -> Result<Vec<Entry>, Stop> {
        let mut entries: Vec<Entry> = Vec::new();
        loop {
            let (event, span) = Self::next(parser)?;
            if matches!(event, Event::MappingEnd | Event::StreamEnd) {
                return Ok(entries);
            }
            let key = self.node(event, span, parser, depth + 1)?;
            let (event, value_span) = Self::next(parser)?;
            let value = self.node(event, value_span, parser, depth + 1)?;
            let Content::Scalar { text, .. } = key.value else {
                self.mistake(span, "a key must be a text, not a list or a mapping".into());
                continue;
            };
            if let Some(first) = entries.iter().find(|entry| entry.key == text) {
                let message =
                    format!("the key `{text}` stands here a second time; the first is in line {}", first.key_at.line);
                let help = Some("keep one of the two".to_owned());
                self.mistakes.push(YamlError { at: key.at, message, help });
                continue;
            }
            entries.push(Entry { key: text, key_at: key.at, value });
        }
    }
}
