//! Preparation of a caption by OpenAI's CLIP package before tokenising: `ftfy.fix_text`, then `html.unescape` twice,
//! then trimming.
//!
//! Sources: `clip/simple_tokenizer.py` (`basic_clean`); ftfy 6's documented steps. The steps that matter for captions
//! are implemented: mojibake of UTF-8 that was read as Windows-1252, HTML entities, ligatures, full-width forms, curly
//! quotes, control characters, composed characters (NFC).
//!
//! Departs: only thirty of HTML's 2231 named entities are known, with their semicolon; captions have no others.
//! Mojibake of other encodings than Windows-1252 is kept, and so is mojibake in a text with characters that
//! Windows-1252 lacks.

use unicode_normalization::UnicodeNormalization as _;

/// Characters of Windows-1252 from 0x80 to 0x9f. An undefined one is the control character of that number, as in
/// browsers.
const WINDOWS: [char; 32] = [
    '€', '\u{81}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{8d}', 'Ž', '\u{8f}', '\u{90}', '‘', '’',
    '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{9d}', 'ž', 'Ÿ',
];

/// Named entities of HTML with their characters.
const ENTITIES: [(&str, &str); 30] = [
    ("amp", "&"),
    ("lt", "<"),
    ("gt", ">"),
    ("quot", "\""),
    ("apos", "'"),
    ("nbsp", "\u{a0}"),
    ("lsquo", "‘"),
    ("rsquo", "’"),
    ("ldquo", "“"),
    ("rdquo", "”"),
    ("sbquo", "‚"),
    ("bdquo", "„"),
    ("ndash", "–"),
    ("mdash", "—"),
    ("hellip", "…"),
    ("bull", "•"),
    ("middot", "·"),
    ("deg", "°"),
    ("plusmn", "±"),
    ("times", "×"),
    ("divide", "÷"),
    ("frac12", "½"),
    ("frac14", "¼"),
    ("frac34", "¾"),
    ("eacute", "é"),
    ("egrave", "è"),
    ("iuml", "ï"),
    ("uuml", "ü"),
    ("copy", "©"),
    ("reg", "®"),
];

/// Ligatures, which NFC keeps.
const LIGATURES: [(char, &str); 9] = [
    ('ﬀ', "ff"),
    ('ﬁ', "fi"),
    ('ﬂ', "fl"),
    ('ﬃ', "ffi"),
    ('ﬄ', "ffl"),
    ('ﬅ', "ſt"),
    ('ﬆ', "st"),
    ('Ĳ', "IJ"),
    ('ĳ', "ij"),
];

/// Repairs a caption like OpenAI's package, except for white space and case, which the tokenizer handles.
pub fn repaired(text: &str) -> String {
    // As in ftfy: a text with `<` may mean its entities. The last step unescapes them in any case.
    let text = if text.contains('<') { text.to_owned() } else { unescaped(text) };
    let text = without_mojibake(text);
    let text: String = text.chars().filter_map(plain).collect();
    let text: String = text.nfc().collect();
    unescaped(&unescaped(&text)).trim().to_owned()
}

/// The plain form of quotes, ligatures and full-width characters; `None` for a control character.
fn plain(c: char) -> Option<std::borrow::Cow<'static, str>> {
    let is_white = matches!(c, '\t' | '\n' | '\u{c}' | '\r');
    if (c.is_control() && !is_white && !('\u{80}'..='\u{9f}').contains(&c)) || c == '\u{feff}' {
        return None;
    }
    if let Some((_, text)) = LIGATURES.iter().find(|(ligature, _)| *ligature == c) {
        return Some((*text).into());
    }
    let c = match c {
        '‘' | '’' | '‚' | '‛' => '\'',
        '“' | '”' | '„' | '‟' => '"',
        '\u{ff01}'..='\u{ff5e}' => char::from_u32(c as u32 - 0xfee0).unwrap_or(c),
        '\u{3000}' => ' ',
        '\u{80}'..='\u{9f}' => WINDOWS[c as usize - 0x80],
        c => c,
    };
    Some(c.to_string().into())
}

/// Decodes a text whose characters in Windows-1252 are valid UTF-8; repeated for text that was decoded wrongly twice.
fn without_mojibake(mut text: String) -> String {
    for _ in 0..4 {
        let bytes: Option<Vec<u8>> = text.chars().map(windows_byte).collect();
        match bytes.and_then(|bytes| String::from_utf8(bytes).ok()) {
            Some(better) if better.len() < text.len() => text = better,
            _ => break,
        }
    }
    text
}

fn windows_byte(c: char) -> Option<u8> {
    if let Some(at) = WINDOWS.iter().position(|other| *other == c) {
        return u8::try_from(0x80 + at).ok();
    }
    u8::try_from(u32::from(c)).ok()
}

/// Replaces entities by their characters.
fn unescaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('&') {
        out.push_str(&rest[..at]);
        rest = &rest[at..];
        match entity(rest) {
            Some((stands_for, length)) => {
                out.push_str(&stands_for);
                rest = &rest[length..];
            }
            None => {
                out.push('&');
                rest = &rest[1..];
            }
        }
    }
    out.push_str(rest);
    out
}

/// The character of the entity at the start of `text`, and the entity's length.
fn entity(text: &str) -> Option<(String, usize)> {
    // The longest known entity is shorter than this.
    let end = text.bytes().take(12).position(|b| b == b';')?;
    let name = text.get(1..end)?;
    let found = match name.strip_prefix('#') {
        Some(number) => {
            let hex = number.strip_prefix(['x', 'X']);
            let code = hex.map_or_else(|| number.parse().ok(), |hex| u32::from_str_radix(hex, 16).ok())?;
            char::from_u32(code).filter(|c| *c != '\0')?.to_string()
        }
        None => ENTITIES.iter().find(|(known, _)| *known == name)?.1.to_owned(),
    };
    Some((found, end + 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captions_are_repaired_as_published() {
        for (broken, expected) in [
            ("a man walks", "a man walks"),
            ("run &amp; jump &lt;fast&gt;", "run & jump <fast>"),
            ("&amp;amp;lt;", "<"),
            ("donâ€™t stop", "don't stop"),
            ("naïve café", "naïve café"),
            ("cafÃ©", "café"),
            ("“bravo” ‘x’", "\"bravo\" 'x'"),
            ("ﬁ ﬂ Ａ！", "fi fl A!"),
            ("e\u{301}", "é"),
            ("&#65;&#x42; &nosuch; & &; &#xffffffff;", "AB &nosuch; & &; &#xffffffff;"),
            (" \u{feff}a\u{7}b ", "ab"),
            ("", ""),
        ] {
            assert_eq!(repaired(broken), expected, "{broken}");
        }
    }
}
