//! Captions of clips: text beside them, or a table in CSV or JSON.
//!
//! A line of text is a sentence, or `sentence#tokens#from#to` as in HumanML3D's `texts`. A sentence alone describes the
//! whole clip. Its tokens come from the small dictionary of the synthetic clips; unknown words have the tag `X`, which
//! evaluators read as OTHER.
//!
//! A CSV starts with a row of names: [`CLIP`], [`CAPTION`], and optionally [`FROM`], [`TO`] (seconds) and [`SOURCE`],
//! the recording that a clip belongs to. JSON is `{"clip": "sentence" or ["sentence", ...]}`, or a list of objects with
//! the same names.

use std::path::Path;

use motion::synthetic::tokens;
use motion::text::{self, Caption};
use protocol::{excerpt, json_mistake};
use serde_json::Value;

/// Names of the column with the clip.
pub const CLIP: [&str; 8] = ["clip", "id", "name", "new_name", "file", "filename", "path", "motion"];
/// Names of the column with a sentence.
pub const CAPTION: [&str; 5] = ["caption", "captions", "text", "sentence", "description"];
/// Names of the column with the start of the described part, in seconds.
pub const FROM: [&str; 3] = ["from", "from_s", "f_tag"];
/// Names of the column with its end, in seconds.
pub const TO: [&str; 3] = ["to", "to_s", "to_tag"];
/// Names of the column with the recording that a clip is cut from.
pub const SOURCE: [&str; 3] = ["source", "source_path", "take"];

/// Largest size in bytes of a sentence with its tokens: half the limit of a caption's line, since its mirrored sentence
/// may be nearly twice as long.
const SENTENCE_BYTES: usize = protocol::limits::CAPTION_BYTES / 2;

/// A row of a table.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Row {
    /// The clip as written, possibly with folders and extension.
    pub clip: String,
    pub captions: Vec<Caption>,
    pub source: Option<String>,
}

/// Makes a caption of a whole clip from a sentence.
///
/// # Errors
/// If the sentence is empty or contains a `#`, which separates fields of stored captions.
pub fn sentence(text: &str) -> Result<Caption, String> {
    let text: String = text.split_whitespace().collect::<Vec<_>>().join(" ");
    if text.is_empty() {
        return Err("the caption is empty".into());
    }
    if text.contains('#') || text.contains(char::is_control) {
        return Err(format!("caption `{}` has a `#` or a control character", excerpt(&text)));
    }
    if text.len() > SENTENCE_BYTES {
        return Err(format!("the caption has {} bytes; expected at most {SENTENCE_BYTES}", text.len()));
    }
    let tokens = tokens(&text.to_lowercase());
    let caption = Caption::whole(text, tokens);
    match caption.to_line().len() {
        0..=SENTENCE_BYTES => Ok(caption),
        bytes => Err(format!("the caption has {bytes} bytes with its tokens; expected at most {SENTENCE_BYTES}")),
    }
}

/// Words of file names that describe no motion.
const OF_FILES: [&str; 5] = ["bvh", "clip", "dataset", "mocap", "recording"];

/// Makes a sentence of a file's name: its words in small letters, without numbers and words such as `dataset`. It is
/// empty if the name has none.
pub fn from_name(stem: &str) -> String {
    let mut words = String::new();
    let mut before = ' ';
    for c in stem.chars() {
        // `WalkFast` is two words.
        if !c.is_alphabetic() || (c.is_uppercase() && before.is_lowercase()) {
            words.push(' ');
        }
        if c.is_alphabetic() {
            words.extend(c.to_lowercase());
        }
        before = c;
    }
    words.split_whitespace().filter(|word| !OF_FILES.contains(word)).collect::<Vec<_>>().join(" ")
}

/// Writes a table of captions, one row per clip and sentence, that [`of_table`] reads.
pub fn to_table(rows: &[(String, String)]) -> String {
    let quoted = |text: &str| match text.contains([',', '"', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    };
    let rows = rows.iter().map(|(clip, caption)| format!("{},{}\n", quoted(clip), quoted(caption)));
    std::iter::once("clip,caption\n".to_owned()).chain(rows).collect()
}

/// Reads the captions of a text file.
///
/// # Errors
/// All invalid lines, with file and line.
pub fn of_text(file: &Path, content: &str) -> Result<Vec<Caption>, String> {
    if content.contains('#') {
        let texts = text::parse_file(file, content)
            .map_err(|errors| errors.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))?;
        return Ok(texts.captions.into_iter().map(|(_, caption)| caption).collect());
    }
    let lines = content.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines.map(|(i, line)| sentence(line).map_err(|e| format!("{}:{}: {e}", file.display(), i + 1))).collect()
}

/// Reads the rows of a table, CSV or JSON by its first character.
///
/// # Errors
/// The defect, with file and line or entry.
pub fn of_table(file: &Path, content: &str) -> Result<Vec<Row>, String> {
    let content = content.strip_prefix('\u{feff}').unwrap_or(content);
    let rows = if content.trim_start().starts_with(['{', '[']) { of_json(content) } else { of_csv(content) };
    rows.map_err(|e| format!("{}:{e}", file.display()))
}

fn of_csv(content: &str) -> Result<Vec<Row>, String> {
    let mut records = csv_records(content)?.into_iter();
    let Some((_, names)) = records.next() else {
        return Err("1: the file is empty; expected a row of column names".into());
    };
    let column = |wanted: &[&str]| names.iter().position(|name| wanted.contains(&name.trim().to_lowercase().as_str()));
    let clip = column(&CLIP);
    let caption = column(&CAPTION);
    let source = column(&SOURCE);
    let (Some(clip), true) = (clip, caption.is_some() || source.is_some()) else {
        return Err(format!(
            "1: the columns are {}; expected one of {} and one of {}",
            excerpt(&names.join(", ")),
            CLIP.join(", "),
            CAPTION.join(", ")
        ));
    };
    let from = column(&FROM);
    let to = column(&TO);
    records
        .map(|(line, fields)| {
            let fail = |what: String| format!("{line}: {what}");
            if fields.len() != names.len() {
                return Err(fail(format!("the row has {} fields; expected {}", fields.len(), names.len())));
            }
            let time = |at: Option<usize>| match at.map(|at| fields[at].trim()) {
                None | Some("") => Ok(0.0),
                Some(text) => text
                    .parse::<f64>()
                    .ok()
                    .filter(|t| t.is_finite() && *t >= 0.0)
                    .ok_or_else(|| fail(format!("`{}` is not a time in seconds", excerpt(text)))),
            };
            let mut captions = vec![];
            if let Some(at) = caption {
                captions.push(timed(sentence(&fields[at]).map_err(fail)?, time(from)?, time(to)?).map_err(fail)?);
            }
            Ok(Row {
                clip: fields[clip].trim().to_owned(),
                captions,
                source: source.map(|at| fields[at].trim().to_owned()).filter(|s| !s.is_empty()),
            })
        })
        .collect()
}

fn timed(caption: Caption, from_s: f64, to_s: f64) -> Result<Caption, String> {
    if (from_s == 0.0 && to_s == 0.0) || from_s < to_s {
        return Ok(Caption { from_s, to_s, ..caption });
    }
    Err(format!("the time range is {from_s} s to {to_s} s; expected the smaller time first"))
}

/// Splits records, each with its first line number. Commas separate fields; fields in quotes may hold commas, line ends
/// and doubled quotes.
fn csv_records(content: &str) -> Result<Vec<(usize, Vec<String>)>, String> {
    let mut records = vec![];
    let (mut fields, mut field): (Vec<String>, String) = (vec![], String::new());
    let mut quoted = false;
    let mut line = 1;
    let mut began = 1;
    let mut chars = content.chars().peekable();
    while let Some(c) = chars.next() {
        line += usize::from(c == '\n');
        match c {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                field.push('"');
            }
            '"' if quoted => quoted = false,
            '"' if field.is_empty() => quoted = true,
            _ if quoted => field.push(c),
            ',' => fields.push(std::mem::take(&mut field)),
            '\r' if chars.peek() == Some(&'\n') => {}
            '\n' => {
                if !(fields.is_empty() && field.trim().is_empty()) {
                    fields.push(std::mem::take(&mut field));
                    records.push((began, std::mem::take(&mut fields)));
                }
                field.clear();
                began = line;
            }
            _ => field.push(c),
        }
    }
    if quoted {
        return Err(format!("{began}: a quote is not closed"));
    }
    if !(fields.is_empty() && field.trim().is_empty()) {
        fields.push(field);
        records.push((began, fields));
    }
    Ok(records)
}

fn of_json(content: &str) -> Result<Vec<Row>, String> {
    let value: Value = serde_json::from_str(content).map_err(|e| format!(" {}", json_mistake(&e)))?;
    let sentences = |value: &Value| -> Result<Vec<Caption>, String> {
        let one = |value: &Value| {
            value
                .as_str()
                .ok_or_else(|| format!("`{}` is not a string", excerpt(&value.to_string())))
                .and_then(sentence)
        };
        value.as_array().map_or_else(|| one(value).map(|caption| vec![caption]), |list| list.iter().map(one).collect())
    };
    match value {
        Value::Object(clips) => {
            let row = |(clip, value): (&String, &Value)| {
                let captions = sentences(value).map_err(|e| format!(" `{}`: {e}", excerpt(clip)))?;
                Ok(Row { clip: clip.clone(), captions, source: None })
            };
            clips.iter().map(row).collect()
        }
        Value::Array(rows) => {
            let row = |(i, row): (usize, &Value)| {
                let get = |names: &[&str]| names.iter().find_map(|name| row.get(name));
                let number = |names: &[&str]| {
                    get(names).map_or(Ok(0.0), |v| {
                        v.as_f64().ok_or_else(|| {
                            format!(" entry {i}: `{}` is not a time in seconds", excerpt(&v.to_string()))
                        })
                    })
                };
                let clip = get(&CLIP).and_then(Value::as_str).ok_or_else(|| format!(" entry {i}: no `clip`"))?;
                let captions = get(&CAPTION).map_or(Ok(vec![]), &sentences);
                let from = number(&FROM)?;
                let to = number(&TO)?;
                let captions = captions.and_then(|all| all.into_iter().map(|c| timed(c, from, to)).collect());
                let source = get(&SOURCE).and_then(Value::as_str).map(str::to_owned);
                Ok(Row { clip: clip.to_owned(), captions: captions.map_err(|e| format!(" entry {i}: {e}"))?, source })
            };
            rows.iter().enumerate().map(row).collect()
        }
        _ => Err(" expected an object or a list".into()),
    }
}

/// The caption of the mirrored clip: words for sides and turning directions are exchanged in the sentence and its
/// tokens.
///
/// Source: the published set's `M` clips swap `left` and `right`, `clockwise` and `counterclockwise`. Departs: other
/// spellings are swapped too, and capitals are kept.
pub fn mirrored(caption: &Caption) -> Caption {
    let tokens = caption.tokens.iter().map(|token| swap_words(token)).collect();
    Caption { text: swap_words(&caption.text), tokens, ..caption.clone() }
}

fn swap_words(text: &str) -> String {
    const PAIRS: [(&str, &str); 11] = [
        ("left", "right"),
        ("right", "left"),
        ("lefthand", "righthand"),
        ("righthand", "lefthand"),
        ("lefthanded", "righthanded"),
        ("righthanded", "lefthanded"),
        ("leftward", "rightward"),
        ("rightward", "leftward"),
        ("leftwards", "rightwards"),
        ("rightwards", "leftwards"),
        ("anticlockwise", "clockwise"),
    ];
    // Joins two words for one direction to a single word.
    let mut joined = text.to_owned();
    for (from, to) in [
        ("counter-clockwise", "counterclockwise"),
        ("counter clockwise", "counterclockwise"),
        ("anti-clockwise", "anticlockwise"),
    ] {
        joined = joined.replace(from, to);
    }
    let mut out = String::with_capacity(joined.len());
    let mut rest = joined.as_str();
    while !rest.is_empty() {
        let letters = rest.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(rest.len());
        let (word, after) = rest.split_at(letters);
        let lower = word.to_ascii_lowercase();
        let other = match lower.as_str() {
            "clockwise" => Some("counterclockwise"),
            "counterclockwise" => Some("clockwise"),
            _ => PAIRS.iter().find(|(from, _)| *from == lower).map(|(_, to)| *to),
        };
        match other {
            Some(other) if word.starts_with(|c: char| c.is_ascii_uppercase()) => {
                out.push_str(&other[..1].to_ascii_uppercase());
                out.push_str(&other[1..]);
            }
            Some(other) => out.push_str(other),
            None => out.push_str(word),
        }
        let others = after.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(after.len());
        out.push_str(&after[..others]);
        rest = &after[others..];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files_become_captions_that_can_be_read_back() {
        let names = ["dataset-1_walk_forward-02", "WalkFast", "000003", "Subject1 jumps, twice"];
        let rows: Vec<(String, String)> = names.map(|name| (name.to_owned(), from_name(name))).to_vec();
        let sentences: Vec<&str> = rows.iter().map(|(_, sentence)| sentence.as_str()).collect();
        assert_eq!(sentences, ["walk forward", "walk fast", "", "subject jumps twice"]);
        let refused = of_table(Path::new("c.csv"), &to_table(&rows)).unwrap_err();
        assert!(refused.contains("c.csv:4: the caption is empty"), "{refused}");
        let filled: Vec<(String, String)> = rows.into_iter().filter(|(_, sentence)| !sentence.is_empty()).collect();
        let read = of_table(Path::new("c.csv"), &to_table(&filled)).unwrap();
        assert_eq!((read[2].clip.as_str(), read[2].captions[0].text.as_str()), (names[3], "subject jumps twice"));
    }

    #[test]
    fn tables_say_what_their_rows_say() {
        protocol::show_excerpts();
        let file = Path::new("captions.csv");
        let csv = "name,Caption,from,to,source\r\nwalks/a.bvh,\"a man, \"\"slowly\"\",\nwalks\",,,take 1\r\n\r\nb,turns left,0.5,3,\r\n";
        let rows = of_table(file, csv).unwrap();
        assert_eq!((rows[0].clip.as_str(), rows[0].source.as_deref()), ("walks/a.bvh", Some("take 1")));
        assert_eq!(rows[0].captions[0].text, "a man, \"slowly\", walks");
        assert_eq!((rows[1].captions[0].from_s, rows[1].captions[0].to_s, &rows[1].source), (0.5, 3.0, &None));
        let json = r#"[{"clip": "b", "caption": "turns left", "from": 0.5, "to": 3}, {"clip": "c", "text": ["x", "y"], "take": "t"}]"#;
        let listed = of_table(file, json).unwrap();
        assert_eq!((&listed[0], listed[1].captions.len(), listed[1].source.as_deref()), (&rows[1], 2, Some("t")));
        let map = of_table(file, r#"{"b": "turns left", "c": ["x", "y"]}"#).unwrap();
        assert_eq!((map.len(), map[1].captions.len()), (2, 2));
        assert!(of_table(file, "source_path,new_name\nx.bvh,000.npy\n").unwrap()[0].captions.is_empty());
        for (content, part) in [
            ("a,b\n1,2\n", "captions.csv:1: the columns are a, b; expected one of clip"),
            ("clip,text\na,b,c\n", "captions.csv:2: the row has 3 fields; expected 2"),
            ("clip,text\na,\"b\n", "captions.csv:2: a quote is not closed"),
            ("clip,text\na,b#c\n", "captions.csv:2: caption `b#c`"),
            ("clip,text,from,to\na,b,3,1\n", "the time range is 3 s to 1 s"),
            ("{\"a\": 3}", "`a`: `3` is not a string"),
            ("[{}]", "entry 0: no `clip`"),
            ("[", "EOF"),
        ] {
            let said = of_table(file, content).unwrap_err();
            assert!(said.contains(part), "{content}: {said}");
        }
    }

    #[test]
    fn text_is_lines_of_either_kind() {
        let file = Path::new("a.txt");
        let plain = of_text(file, "A person walks.\n\n  someone turns left \n").unwrap();
        assert_eq!((plain.len(), plain[1].text.as_str()), (2, "someone turns left"));
        assert_eq!(plain[0].tokens, ["a/DET", "person/NOUN", "walk/VERB"]);
        assert_eq!(of_text(file, "a man kicks.#a/DET man/NOUN kick/VERB#2.0#6.5").unwrap()[0].to_s, 6.5);
        assert!(of_text(file, "a\nb#c\n").unwrap_err().contains("a.txt:1"));
    }

    #[test]
    fn mirroring_swaps_whole_words_and_twice_is_nothing() {
        for (one, other) in [
            ("Left hand, then right.", "Right hand, then left."),
            ("he leaves, turns clockwise", "he leaves, turns counterclockwise"),
            ("rightwards upright", "leftwards upright"),
            ("left-handed", "right-handed"),
        ] {
            let caption = sentence(one).unwrap();
            assert_eq!(mirrored(&caption).text, other);
            assert_eq!(mirrored(&mirrored(&caption)), caption);
        }
        assert_eq!(mirrored(&sentence("goes counter-clockwise").unwrap()).text, "goes clockwise");
        assert_eq!(swap_words("left/ADJ"), "right/ADJ");
    }

    proptest::proptest! {
        #[test]
        fn no_table_breaks_the_reader(content in "(?s)(clip,text\n)?[a-z\",\n\r{}\\[\\]:#0-9.]{0,80}") {
            if let Ok(rows) = of_table(Path::new("t"), &content) {
                for caption in rows.iter().flat_map(|row| &row.captions) {
                    proptest::prop_assert_eq!(&Caption::parse(&caption.to_line()).unwrap(), caption);
                }
            }
        }
    }
}
