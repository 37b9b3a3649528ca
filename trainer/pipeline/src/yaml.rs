//! YAML as a tree whose every key and value has a position.
//!
//! Built from the parser's events rather than from a ready-made document type. So every duplicate key is reported with
//! both positions, and limits ([`limits`]) apply before memory is allocated. An alias is a copy of its anchor, so a
//! [`Budget`] counts the values and the bytes of text of every copy before it is made. A file and its overrides share
//! one budget. Plain scalars follow the YAML 1.2 core schema, so `no` and `on` are texts.

use std::collections::HashMap;

use protocol::limits;
use saphyr_parser::{Event, Parser, ScalarStyle, ScanError, Span};
use serde_json::{Number, Value};

use crate::diagnostic::Position;

/// Remaining size that may be read.
#[derive(Debug)]
pub(crate) struct Budget(Size);

impl Default for Budget {
    fn default() -> Self {
        Self(Size { values: limits::PIPELINE_VALUES, bytes: limits::PIPELINE_TEXT_BYTES })
    }
}

/// Size of a value in memory.
#[derive(Debug, Clone, Copy)]
struct Size {
    values: usize,
    bytes: usize,
}

/// A value and its position.
#[derive(Debug, Clone)]
pub(crate) struct Node {
    pub(crate) at: Position,
    pub(crate) value: Content,
}

/// Content of a node.
#[derive(Debug, Clone)]
pub(crate) enum Content {
    /// Null, a boolean, a number or a text. A number that is not finite keeps its text.
    Scalar { value: Value, text: String, plain: bool },
    /// A list of nodes.
    List(Vec<Node>),
    /// A mapping in the order of the file; keys are unique.
    Map(Vec<Entry>),
}

/// A key and its value.
#[derive(Debug, Clone)]
pub(crate) struct Entry {
    pub(crate) key: String,
    pub(crate) key_at: Position,
    pub(crate) value: Node,
}

/// A syntax error in the text.
#[derive(Debug)]
pub(crate) struct YamlError {
    pub(crate) at: Position,
    pub(crate) message: String,
    pub(crate) help: Option<String>,
}

impl Node {
    pub(crate) fn map(&self) -> Option<&[Entry]> {
        match &self.value {
            Content::Map(entries) => Some(entries),
            _ => None,
        }
    }

    pub(crate) fn entry(&self, key: &str) -> Option<&Entry> {
        self.map()?.iter().find(|entry| entry.key == key)
    }

    /// Text of a scalar, if it is a text.
    pub(crate) fn as_text(&self) -> Option<&str> {
        match &self.value {
            Content::Scalar { value: Value::String(text), .. } => Some(text),
            _ => None,
        }
    }

    fn size(&self) -> Size {
        let mut size = Size { values: 1, bytes: 0 };
        let mut add = |other: Size| {
            size.values += other.values;
            size.bytes += other.bytes;
        };
        match &self.value {
            Content::Scalar { text, .. } => add(Size { values: 0, bytes: text.len() }),
            Content::List(items) => items.iter().map(Self::size).for_each(add),
            Content::Map(entries) => entries.iter().for_each(|entry| {
                add(Size { values: 1, bytes: entry.key.len() });
                add(entry.value.size());
            }),
        }
        size
    }

    /// Converts to JSON; `None` if a number is not finite.
    pub(crate) fn to_json(&self) -> Option<Value> {
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

    /// Description for a message: `the text `x``, `the number 3`, `a list`.
    pub(crate) fn describe(&self) -> String {
        match &self.value {
            Content::Scalar { text, plain: true, .. } if is_not_finite(text) => format!("`{}`", shortened(text)),
            Content::Scalar { value: Value::Null, .. } => "nothing".into(),
            Content::Scalar { value: Value::Bool(flag), .. } => format!("the flag `{flag}`"),
            Content::Scalar { value: Value::Number(_), text, .. } => format!("the number `{}`", shortened(text)),
            Content::Scalar { text, .. } => format!("the string `{}`", shortened(text)),
            Content::List(items) => format!("a list of {}", items.len()),
            Content::Map(_) => "a mapping".into(),
        }
    }
}

/// Start of a text, for a message.
pub(crate) fn shortened(text: &str) -> String {
    let short: String = text.chars().take(40).collect();
    if short.len() < text.len() { short + "..." } else { short }
}

/// Returns true for `.nan`, `.inf`, `nan`, `inf`, or digits that overflow.
fn is_not_finite(text: &str) -> bool {
    let bare = text.trim_start_matches(['+', '-', '.']).to_ascii_lowercase();
    matches!(bare.as_str(), "nan" | "inf" | "infinity")
        || (text.contains(|c: char| c.is_ascii_digit()) && text.parse::<f64>().is_ok_and(|number| !number.is_finite()))
}

/// Interprets a plain scalar by the core schema.
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

/// Reads one document. `source` distinguishes positions of different texts.
pub(crate) fn parse(text: &str, source: usize, budget: &mut Budget) -> Result<Node, Vec<YamlError>> {
    let start = Position { source, line: 1, column: 1 };
    let fail = |message: String| vec![YamlError { at: start, message, help: None }];
    if text.len() as u64 > limits::PIPELINE_BYTES {
        return Err(fail(format!("the file has {} bytes; expected at most {}", text.len(), limits::PIPELINE_BYTES)));
    }
    let mut builder = Builder { source, budget, anchors: HashMap::new(), mistakes: Vec::new() };
    let mut parser = Parser::new_from_str(text.strip_prefix('\u{feff}').unwrap_or(text));
    let mut root = None;
    loop {
        match parser.next() {
            None | Some(Ok((Event::StreamEnd, _))) => break,
            Some(Ok((Event::StreamStart | Event::DocumentEnd | Event::Nothing, _))) => {}
            Some(Ok((Event::DocumentStart(_), span))) => {
                if root.is_some() {
                    builder.mistake(span, "a second YAML document starts here; a pipeline is one document".into());
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
        _ => Err(fail("the file is empty; a pipeline needs `name`, `dataset` and `stages`".into())),
    }
}

/// Reads an untrusted YAML text as JSON, for small files other than pipelines: one document, unique keys, within a
/// pipeline's [`limits`].
///
/// # Errors
/// Each mistake as `line:column: what`.
pub fn yaml_as_json(text: &str) -> Result<Value, Vec<String>> {
    let shown = |at: Position, what: &str| format!("{}:{}: {what}", at.line, at.column);
    let node = parse(text, 0, &mut Budget::default())
        .map_err(|errors| errors.iter().map(|e| shown(e.at, &e.message)).collect::<Vec<_>>())?;
    node.to_json().ok_or_else(|| vec![shown(node.at, "a number in the text is not finite")])
}

enum Stop {
    Scan(ScanError),
    /// A limit was exceeded; the mistake is recorded.
    Limit,
}

struct Builder<'b> {
    source: usize,
    budget: &'b mut Budget,
    anchors: HashMap<usize, (Node, Size)>,
    mistakes: Vec<YamlError>,
}

impl Builder<'_> {
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
            info if info.contains("mapping values") || info.contains("simple key") => Some(
                "put a space after `:`, quote strings that contain `: `, and give all keys of a mapping the same \
                 indentation"
                    .into(),
            ),
            info if info.contains("quoted scalar") => Some("close the quotation mark".into()),
            info if info.contains("flow mapping") => Some("close the `{` of a line above, or add the comma".into()),
            info if info.contains("flow sequence") => Some("close the `[` of a line above, or add the comma".into()),
            info if info.contains("unknown anchor") => {
                Some("define it before, as in `steps: &same 100`, or quote a string that begins with `*`".into())
            }
            _ => None,
        };
        self.mistakes.push(YamlError { at, message: format!("invalid YAML: {}", error.info()), help });
    }

    /// Subtracts `size` from the budget, or reports that it is exceeded.
    fn take(&mut self, span: Span, size: Size) -> Result<(), Stop> {
        let left = &mut self.budget.0;
        let values = left.values.checked_sub(size.values);
        let bytes = left.bytes.checked_sub(size.bytes);
        let (what, limit) = match (values, bytes) {
            (Some(values), Some(bytes)) => {
                *left = Size { values, bytes };
                return Ok(());
            }
            (None, _) => ("values", limits::PIPELINE_VALUES),
            (_, None) => ("bytes of text", limits::PIPELINE_TEXT_BYTES),
        };
        self.mistake(span, format!("the file has more than {limit} {what} after aliases are expanded"));
        Err(Stop::Limit)
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
        if depth > limits::PIPELINE_DEPTH {
            self.mistake(span, format!("values are nested more than {} levels deep", limits::PIPELINE_DEPTH));
            return Err(Stop::Limit);
        }
        let (value, anchor) = match event {
            Event::Alias(id) => {
                let Some(size) = self.anchors.get(&id).map(|(_, size)| *size) else {
                    self.mistake(span, "this alias refers to a value that contains it".into());
                    return Err(Stop::Limit);
                };
                self.take(span, size)?;
                return self.anchors.get(&id).map(|(node, _)| node.clone()).ok_or(Stop::Limit);
            }
            Event::Scalar(text, style, anchor, _) => {
                if text.len() > limits::TEXT_BYTES {
                    self.mistake(
                        span,
                        format!("the string has {} bytes; expected at most {}", text.len(), limits::TEXT_BYTES),
                    );
                    return Err(Stop::Limit);
                }
                self.take(span, Size { values: 1, bytes: text.len() })?;
                let plain = style == ScalarStyle::Plain;
                let value = if plain { resolve(&text) } else { Value::String(text.to_string()) };
                (Content::Scalar { value, text: text.into_owned(), plain }, anchor)
            }
            Event::SequenceStart(anchor, _) => {
                self.take(span, Size { values: 1, bytes: 0 })?;
                (Content::List(self.items(parser, depth)?), anchor)
            }
            Event::MappingStart(anchor, _) => {
                self.take(span, Size { values: 1, bytes: 0 })?;
                (Content::Map(self.entries(parser, depth)?), anchor)
            }
            _ => {
                self.mistake(span, "expected a value here".into());
                return Err(Stop::Limit);
            }
        };
        let node = Node { at, value };
        if anchor != 0 {
            let size = node.size();
            self.take(span, size)?;
            self.anchors.insert(anchor, (node.clone(), size));
        }
        Ok(node)
    }

    fn items<'a>(
        &mut self,
        parser: &mut Parser<'a, saphyr_parser::StrInput<'a>>,
        depth: usize,
    ) -> Result<Vec<Node>, Stop> {
        let mut items = Vec::new();
        loop {
            let (event, span) = Self::next(parser)?;
            match event {
                Event::SequenceEnd | Event::StreamEnd => return Ok(items),
                event => items.push(self.node(event, span, parser, depth + 1)?),
            }
        }
    }

    fn entries<'a>(
        &mut self,
        parser: &mut Parser<'a, saphyr_parser::StrInput<'a>>,
        depth: usize,
    ) -> Result<Vec<Entry>, Stop> {
        let mut entries: Vec<Entry> = Vec::new();
        let mut lines: HashMap<String, usize> = HashMap::new();
        loop {
            if self.mistakes.len() >= limits::MISTAKES {
                return Err(Stop::Limit);
            }
            let (event, span) = Self::next(parser)?;
            if matches!(event, Event::MappingEnd | Event::StreamEnd) {
                return Ok(entries);
            }
            let key = self.node(event, span, parser, depth + 1)?;
            let (event, value_span) = Self::next(parser)?;
            let value = self.node(event, value_span, parser, depth + 1)?;
            let Content::Scalar { text, .. } = key.value else {
                self.mistake(span, "a key must be a string, not a list or a mapping".into());
                continue;
            };
            if text.len() > limits::KEY_BYTES {
                self.mistake(span, format!("the key has {} bytes; expected at most {}", text.len(), limits::KEY_BYTES));
                return Err(Stop::Limit);
            }
            if let Some(first) = lines.get(&text) {
                let message = format!("duplicate key `{text}`; the first one is in line {first}");
                let help = Some("remove one of the two".to_owned());
                self.mistakes.push(YamlError { at: key.at, message, help });
                continue;
            }
            lines.insert(text.clone(), key.at.line);
            entries.push(Entry { key: text, key_at: key.at, value });
        }
    }
}
