//! Parser of BVH. One pass over the bytes without recursion, so that depth uses no stack.

use std::path::Path;

use motion::quaternion::Vec3;
use protocol::excerpt;

use super::{Bvh, BvhError, Channel, MAX_DEPTH, MAX_NODES, MAX_SECONDS, MAX_VALUES, Node, nominal_rate};

/// Largest length of a joint's name, in bytes.
const NAME_BYTES: usize = 256;

impl Bvh {
    /// Parses a file's bytes; `file` is only its name in errors.
    ///
    /// # Errors
    /// The defect, with file and line.
    pub fn parse(file: &Path, bytes: &[u8]) -> Result<Self, BvhError> {
        let fail = |(line, what)| BvhError::Text { file: file.into(), line, what };
        let text = std::str::from_utf8(bytes).map_err(|error| {
            let line = 1 + bytes[..error.valid_up_to()].iter().filter(|byte| **byte == b'\n').count();
            fail((line, "not UTF-8 text; is it a BVH file?".to_owned()))
        })?;
        read(text.strip_prefix('\u{feff}').unwrap_or(text)).map_err(fail)
    }
}

/// A line number and the defect there.
type Fault = (usize, String);

/// The remaining text, and the number of its first line.
struct Reader<'a> {
    rest: &'a str,
    line: usize,
}

impl<'a> Reader<'a> {
    fn advance(&mut self, bytes: usize) -> &'a str {
        let (taken, rest) = self.rest.split_at(bytes);
        self.line += taken.bytes().filter(|byte| *byte == b'\n').count();
        self.rest = rest;
        taken
    }

    fn skip_blanks(&mut self) {
        let blanks = self.rest.len() - self.rest.trim_start().len();
        self.advance(blanks);
    }

    /// The next word: a brace, or the text before a blank or a brace. Empty at the end of the file.
    fn word(&mut self) -> &'a str {
        self.skip_blanks();
        let end = self.rest.find(|c: char| c.is_whitespace() || matches!(c, '{' | '}')).unwrap_or(self.rest.len());
        let first = self.rest.chars().next().map_or(0, char::len_utf8);
        self.advance(end.max(first))
    }

    fn peek(&self) -> &'a str {
        Reader { rest: self.rest, line: self.line }.word()
    }

    fn fault<T>(&self, what: impl Into<String>) -> Result<T, Fault> {
        Err((self.line, what.into()))
    }

    fn expect(&mut self, wanted: &str) -> Result<(), Fault> {
        let found = self.word();
        if found.eq_ignore_ascii_case(wanted) {
            return Ok(());
        }
        self.fault(format!("{}, expected `{wanted}`", shown(found)))
    }

    /// The rest of the line up to a brace.
    fn name(&mut self) -> Result<String, Fault> {
        let ends = |byte| matches!(byte, b'\n' | b'{' | b'}');
        let end = self.rest.bytes().position(ends).unwrap_or(self.rest.len());
        let name = self.rest[..end].trim();
        if name.is_empty() {
            return self.fault("the joint has no name");
        }
        if name.len() > NAME_BYTES || name.contains(char::is_control) {
            return self.fault(format!(
                "{} is not a valid joint name; expected one line of at most {NAME_BYTES} bytes",
                shown(name)
            ));
        }
        self.advance(end);
        Ok(name.to_owned())
    }

    fn number(&mut self, of: &str) -> Result<f64, Fault> {
        let word = self.word();
        number(word).map_or_else(|| self.fault(format!("{} in {of}; expected a number", shown(word))), Ok)
    }

    fn count(&mut self, of: &str) -> Result<usize, Fault> {
        let word = self.word();
        match word.parse() {
            Ok(count) => Ok(count),
            Err(_) => self.fault(format!("{} as {of}; expected a whole number", shown(word))),
        }
    }

    fn offset(&mut self) -> Result<Vec3, Fault> {
        Ok([self.number("OFFSET")?, self.number("OFFSET")?, self.number("OFFSET")?])
    }
}

fn shown(word: &str) -> String {
    match word {
        "" => "the file ends here".to_owned(),
        _ => format!("`{}`", excerpt(word)),
    }
}

/// Parses a number that is finite, also as a float of 32 bits.
fn number(word: &str) -> Option<f64> {
    word.parse::<f64>().ok().filter(|value| value.abs() <= f64::from(f32::MAX))
}

fn read(text: &str) -> Result<Bvh, Fault> {
    let mut reader = Reader { rest: text, line: 1 };
    reader.expect("HIERARCHY")?;
    let nodes = hierarchy(&mut reader)?;
    motion(&mut reader, nodes)
}

/// Parses from `ROOT` to its closing brace.
fn hierarchy(reader: &mut Reader<'_>) -> Result<Vec<Node>, Fault> {
    let mut nodes: Vec<Node> = vec![];
    // Joints with open braces, outermost first.
    let mut open: Vec<usize> = vec![];
    reader.expect("ROOT")?;
    open_joint(reader, &mut nodes, &mut open)?;
    while let Some(joint) = open.last().copied() {
        let word = reader.word();
        match word.to_ascii_uppercase().as_str() {
            "OFFSET" => nodes[joint].offset = reader.offset()?,
            "CHANNELS" => nodes[joint].channels = channels(reader, &nodes[joint])?,
            "JOINT" => open_joint(reader, &mut nodes, &mut open)?,
            "END" => end_site(reader, &mut nodes, joint)?,
            "}" => {
                open.pop();
            }
            "MOTION" | "" => {
                let name = excerpt(&nodes[joint].name);
                return reader.fault(format!("the brace of `{name}` is not closed ({} open)", open.len()));
            }
            _ => {
                let expected = "expected OFFSET, CHANNELS, JOINT, End Site or `}`";
                return reader.fault(format!("{} in `{}`, {expected}", shown(word), excerpt(&nodes[joint].name)));
            }
        }
    }
    Ok(nodes)
}

/// Adds a node after checking the limits that hold for all of them.
fn add(
    reader: &Reader<'_>,
    nodes: &mut Vec<Node>,
    name: String,
    parent: Option<usize>,
    end: bool,
) -> Result<(), Fault> {
    if nodes.len() == MAX_NODES {
        return reader.fault(format!("more than {MAX_NODES} joints and end sites, the largest supported number"));
    }
    nodes.push(Node { name, parent, offset: [0.0; 3], channels: vec![], end });
    Ok(())
}

fn open_joint(reader: &mut Reader<'_>, nodes: &mut Vec<Node>, open: &mut Vec<usize>) -> Result<(), Fault> {
    let name = reader.name()?;
    if open.iter().any(|joint| nodes[*joint].name == name) {
        return reader.fault(format!("joint `{}` is inside a joint with the same name", excerpt(&name)));
    }
    if open.len() == MAX_DEPTH {
        return reader
            .fault(format!("joints are nested more than {MAX_DEPTH} levels deep, the largest supported depth"));
    }
    add(reader, nodes, name, open.last().copied(), false)?;
    open.push(nodes.len() - 1);
    reader.expect("{")
}

fn end_site(reader: &mut Reader<'_>, nodes: &mut Vec<Node>, joint: usize) -> Result<(), Fault> {
    reader.expect("Site")?;
    reader.expect("{")?;
    reader.expect("OFFSET")?;
    let offset = reader.offset()?;
    reader.expect("}")?;
    let name = format!("{}_end", nodes[joint].name);
    add(reader, nodes, name, Some(joint), true)?;
    if let Some(node) = nodes.last_mut() {
        node.offset = offset;
    }
    Ok(())
}

fn channels(reader: &mut Reader<'_>, joint: &Node) -> Result<Vec<Channel>, Fault> {
    if !joint.channels.is_empty() {
        return reader.fault(format!("`{}` has a second list of channels", excerpt(&joint.name)));
    }
    let count = reader.count("the number of CHANNELS")?;
    if count > Channel::NAMES.len() {
        return reader.fault(format!(
            "`{}` has {count} channels; expected at most {}",
            excerpt(&joint.name),
            Channel::NAMES.len()
        ));
    }
    let mut channels = Vec::with_capacity(count);
    for i in 0..count {
        let line = reader.line;
        let word = reader.word();
        let Some((_, channel)) = Channel::NAMES.iter().find(|(name, _)| name.eq_ignore_ascii_case(word)) else {
            let found = format!(
                "CHANNELS {count} of `{}` is followed by {i} channel names, then {}",
                excerpt(&joint.name),
                shown(word)
            );
            return Err((line, format!("{found}; expected {count} names such as Xposition or Zrotation")));
        };
        if channels.contains(channel) {
            return reader.fault(format!("`{}` has the channel {} twice", excerpt(&joint.name), channel.name()));
        }
        channels.push(*channel);
    }
    Ok(channels)
}

/// Parses from `MOTION` to the end.
fn motion(reader: &mut Reader<'_>, nodes: Vec<Node>) -> Result<Bvh, Fault> {
    let found = reader.word();
    match found.to_ascii_uppercase().as_str() {
        "MOTION" => {}
        "}" => return reader.fault("one closing brace too many: the root is already closed; expected MOTION"),
        "ROOT" => return reader.fault("a second ROOT; expected a file with one skeleton"),
        _ => return reader.fault(format!("{}; expected MOTION after the hierarchy", shown(found))),
    }
    label(reader, &["Frames"])?;
    let frames = reader.count("the number of frames")?;
    if frames == 0 {
        return reader.fault("no frames");
    }
    let channels: usize = nodes.iter().map(|node| node.channels.len()).sum();
    if channels == 0 {
        return reader.fault("no joint has a channel, so nothing moves");
    }
    let most = MAX_VALUES / channels.max(nodes.len());
    if frames > most {
        return reader.fault(format!(
            "the file has {frames} frames of {channels} channels; expected at most {most} frames; split the recording"
        ));
    }
    label(reader, &["Frame", "Time"])?;
    let word = reader.peek();
    let frame_time = reader.number("Frame Time")?;
    if frame_time <= 0.0 {
        return reader.fault(format!("the frame time is {}; expected seconds above 0", shown(word)));
    }
    let seconds = frames as f64 * frame_time;
    if seconds > MAX_SECONDS {
        return reader.fault(format!("{frames} frames last {seconds:.0} s; expected at most {MAX_SECONDS} s"));
    }
    let rate = nominal_rate(frame_time, last_digit(word));
    let values = rows(reader, frames, channels)?;
    Ok(Bvh { nodes, frame_time, rate, frames, values })
}

/// Parses words; a colon follows the last one.
fn label(reader: &mut Reader<'_>, words: &[&str]) -> Result<(), Fault> {
    let wanted = format!("{}:", words.join(" "));
    for (i, wanted_word) in words.iter().enumerate() {
        let found = reader.word();
        let last = i + 1 == words.len();
        let bare = if last { found.strip_suffix(':').unwrap_or(found) } else { found };
        if !bare.eq_ignore_ascii_case(wanted_word) {
            return reader.fault(format!("{}, expected `{wanted}`", shown(found)));
        }
        if last && !found.ends_with(':') {
            reader.expect(":")?;
        }
    }
    Ok(())
}

/// Parses rows `[frames, channels]`. Memory grows with the actual content, not with the declared size.
fn rows(reader: &Reader<'_>, frames: usize, channels: usize) -> Result<Vec<f64>, Fault> {
    // Each number takes at least two bytes of the text.
    let mut values = Vec::with_capacity((frames * channels).min(reader.rest.len() / 2 + 1));
    let mut line = reader.line;
    for row in reader.rest.split('\n') {
        let before = values.len();
        for (i, word) in row.split_whitespace().enumerate() {
            let frame = before / channels;
            if frame == frames {
                return Err((line, format!("{} after the last of {frames} frames", shown(word))));
            }
            if i == channels {
                return Err((
                    line,
                    format!("frame {frame} has more than {channels} numbers; expected one for each channel"),
                ));
            }
            match number(word) {
                Some(value) => values.push(value),
                None => {
                    return Err((
                        line,
                        format!("value {i} of frame {frame} is {}; expected a finite number", shown(word)),
                    ));
                }
            }
        }
        let found = values.len() - before;
        if found != 0 && found != channels {
            let frame = before / channels;
            return Err((
                line,
                format!("frame {frame} has {found} numbers; expected {channels}, one for each channel"),
            ));
        }
        line += 1;
    }
    let found = values.len() / channels;
    if found < frames {
        return Err((line - 1, format!("the file ends after {found} of {frames} frames")));
    }
    Ok(values)
}

/// Value of one unit in the last digit of a written number.
fn last_digit(word: &str) -> f64 {
    let (mantissa, exponent) = word.split_once(['e', 'E']).unwrap_or((word, "0"));
    let decimals = mantissa.split_once('.').map_or(0, |(_, digits)| digits.len());
    let exponent = exponent.parse::<i32>().unwrap_or(0).saturating_sub(i32::try_from(decimals).unwrap_or(i32::MAX));
    10_f64.powi(exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = "HIERARCHY\nROOT a b{OFFSET 0 0 0 CHANNELS 2 Xposition yrotation End Site{OFFSET 0 1 0}}\nMOTION\nFrames: 2\nFrame Time: .0333\n1 90\n2 -90\n";

    fn said(text: &str) -> String {
        Bvh::parse(Path::new("x.bvh"), text.as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn a_small_file_is_read_with_its_usual_rate() {
        let bvh = Bvh::parse(Path::new("x.bvh"), SMALL.as_bytes()).unwrap();
        assert_eq!((bvh.nodes.len(), bvh.frames, bvh.channels()), (2, 2, 2));
        assert_eq!((bvh.nodes[0].name.as_str(), bvh.nodes[1].name.as_str()), ("a b", "a b_end"));
        assert_eq!(bvh.rate, 30.0);
        for (written, rate) in [
            ("0.05", 20.0),
            ("0.08", 12.5),
            ("0.0333667", 30_000.0 / 1001.0),
            ("8.333e-3", 120.0),
            ("0.037", 1.0 / 0.037),
        ] {
            assert_eq!(nominal_rate(written.parse().unwrap(), last_digit(written)), rate, "{written}");
        }
    }

    #[test]
    fn a_mistake_is_told_with_its_line() {
        protocol::show_excerpts();
        for (from, to, part) in [
            ("HIERARCHY", "", "x.bvh:2: `ROOT`, expected `HIERARCHY`"),
            ("yrotation", "yturn", "followed by 1 channel names, then `yturn`"),
            ("yrotation", "xposition", "the channel Xposition twice"),
            ("}}", "}", "x.bvh:3: the brace of `a b` is not closed (1 open)"),
            ("}}", "}}}", "x.bvh:2: one closing brace too many"),
            ("End Site", "Ende", "`Ende` in `a b`, expected OFFSET"),
            ("Frames: 2", "Frames: 3", "x.bvh:8: the file ends after 2 of 3 frames"),
            ("Frames: 2", "Frames: 1", "x.bvh:7: `2` after the last of 1 frames"),
            ("Frames: 2", "Frames: 99999999999999999999999", "whole number"),
            ("Frames: 2", "Frames: 99999999999", "at most"),
            (".0333", "0", "expected seconds above 0"),
            (".0333", "1e30", "expected at most 3600 s"),
            ("-90", "1e39", "value 1 of frame 1 is `1e39`"),
            ("-90", "-90 3", "frame 1 has more than 2 numbers"),
            ("2 -90", "2", "x.bvh:7: frame 1 has 1 numbers; expected 2"),
        ] {
            let said = said(&SMALL.replacen(from, to, 1));
            assert!(said.contains(part), "{from} -> {to}: {said}");
        }
        assert!(
            said(&SMALL.replace("2 Xposition yrotation", "0").replace("1 90\n2 -90\n", "")).contains("nothing moves")
        );
        let many: String = (0..=MAX_NODES).map(|i| format!("JOINT j{i} {{}}\n")).collect();
        assert!(said(&format!("HIERARCHY ROOT r\n{{ {many} }}")).contains("more than 4096 joints"));
        let deep: String = (0..=MAX_DEPTH).map(|i| format!("JOINT j{i} {{\n")).collect();
        assert!(said(&format!("HIERARCHY ROOT r\n{{ {deep}")).contains("more than 512 levels deep"));
    }

    proptest::proptest! {
        /// Arbitrary bytes must not cause a panic, nor more rows than the text has.
        #[test]
        fn no_bytes_break_the_reader(at in 0_usize..150, byte in proptest::prelude::any::<u8>(), cut in 0_usize..150, junk in "(?s).{0,80}") {
            let mut bytes = SMALL.as_bytes().to_vec();
            let place = at % bytes.len();
            bytes[place] = byte;
            bytes.truncate(bytes.len() - cut % 3);
            for bytes in [bytes, junk.clone().into_bytes(), format!("{}{junk}", &SMALL[..cut.min(SMALL.len())]).into_bytes()] {
                if let Ok(bvh) = Bvh::parse(Path::new("x.bvh"), &bytes) {
                    proptest::prop_assert_eq!(bvh.values.len(), bvh.frames * bvh.channels());
                    proptest::prop_assert_eq!(bvh.positions().len(), bvh.frames * bvh.nodes.len() * 3);
                }
            }
        }
    }
}
