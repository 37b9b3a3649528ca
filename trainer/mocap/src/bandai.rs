//! Captions and splits of the Bandai-Namco Research Motion Dataset, made of the names of its files.
//!
//! The set has no sentences. A name is `dataset-N_CONTENT_STYLE_TAKE.bvh`; each content has a verb and a paraphrase,
//! each style an adverb and an adjective, and every take gets four sentences of them. In `walk-left` and `walk-right`
//! the figure walks ahead and drifts to that side; in `walk-turn-left` and `walk-turn-right` it turns by 90 degrees.
//!
//! A split takes whole takes. Of the takes with one content and style, a tenth is for validation and a tenth for the
//! test; draws that the names key decide which. The split of a take does not depend on the other takes that are there.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use motion::Skeleton;
use motion::dataset::Split;
use motion::random::Stream;
use protocol::Seed;
use protocol::stage::DataFormat;

/// Rate of the files, in frames a second.
const RATE: usize = 30;
/// Seed of the splits.
const SEED: Seed = Seed(0);
/// Takes with one content and style from which a split has its own share; fewer are divided with the other styles.
const OWN_SHARE: usize = 10;

/// Words for a content.
struct Content {
    label: &'static str,
    /// Third person: `a person ...`.
    verb: &'static str,
    /// Continuous form: `someone is ...`.
    continuous: &'static str,
    /// Paraphrase of the verb.
    other: &'static str,
}

const fn content(label: &'static str, verb: &'static str, continuous: &'static str, other: &'static str) -> Content {
    Content { label, verb, continuous, other }
}

const CONTENTS: [Content; 24] = [
    content("bow", "bows", "bowing", "bends forward in a bow"),
    content("bye", "waves goodbye", "waving goodbye", "says goodbye with one hand"),
    content("byebye", "waves bye bye", "waving bye bye", "says bye bye with a hand"),
    content("call", "calls someone over", "calling someone over", "beckons with one hand"),
    content("dance-long", "dances", "dancing", "performs a dance"),
    content("dance-short", "dances", "dancing", "performs a dance"),
    content("dash", "sprints forward", "sprinting forward", "dashes ahead"),
    content("guide", "shows the way", "showing the way", "guides someone with one hand"),
    content("kick", "kicks", "kicking", "performs kicks"),
    content("punch", "punches", "punching", "throws punches"),
    content("raise-up-both-hands", "raises both hands", "raising both hands", "lifts both arms up"),
    content("raise-up-left-hand", "raises the left hand", "raising the left hand", "lifts the left arm up"),
    content("raise-up-right-hand", "raises the right hand", "raising the right hand", "lifts the right arm up"),
    content("run", "runs forward", "running forward", "jogs ahead"),
    content("slash", "slashes with a sword", "slashing with a sword", "swings a sword"),
    content("walk", "walks forward", "walking forward", "strolls ahead"),
    content("walk-back", "walks backwards", "walking backwards", "steps back"),
    content("walk-left", "walks ahead to the left", "walking ahead to the left", "drifts left while strolling"),
    content("walk-right", "walks ahead to the right", "walking ahead to the right", "drifts right while strolling"),
    content(
        "walk-turn-left",
        "walks and turns left",
        "walking and turning left",
        "strolls around a corner to the left",
    ),
    content(
        "walk-turn-right",
        "walks and turns right",
        "walking and turning right",
        "strolls around a corner to the right",
    ),
    content("wave-both-hands", "waves both hands", "waving both hands", "greets with both arms"),
    content("wave-left-hand", "waves the left hand", "waving the left hand", "greets with the left arm"),
    content("wave-right-hand", "waves the right hand", "waving the right hand", "greets with the right arm"),
];

/// Label, adverb and adjective of each style.
const STYLES: [(&str, &str, &str); 20] = [
    ("active", "energetically", "energetic"),
    ("angry", "angrily", "angry"),
    ("childish", "like a child", "childish"),
    ("chimpira", "like a street thug", "rough"),
    ("elderly", "like an old person", "elderly"),
    ("exhausted", "in an exhausted way", "exhausted"),
    ("feminine", "in a feminine way", "feminine"),
    ("giant", "like a giant", "gigantic"),
    ("happy", "happily", "happy"),
    ("masculine", "in a masculine way", "masculine"),
    ("masculinity", "in a masculine way", "masculine"),
    ("musical", "to the beat of music", "musical"),
    ("normal", "", ""),
    ("not-confident", "without confidence", "timid"),
    ("old", "like an old person", "elderly"),
    ("proud", "proudly", "proud"),
    ("sad", "sadly", "sad"),
    ("tired", "in a tired way", "tired"),
    ("youthful", "in a youthful way", "youthful"),
    ("children", "like a child", "childish"),
];

/// Labels of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Labels<'a> {
    dataset: &'a str,
    content: &'a str,
    style: &'a str,
}

/// Reads the labels in a file's name.
fn labels(name: &str) -> Result<Labels<'_>, String> {
    let fields: Vec<&str> = name.strip_suffix(".bvh").unwrap_or(name).split('_').collect();
    let is_take = |take: &str| !take.is_empty() && take.bytes().all(|c| c.is_ascii_digit());
    match fields[..] {
        [dataset, content, style, take] if is_take(take) => Ok(Labels { dataset, content, style }),
        _ => Err(format!("`{name}` is not a name such as `dataset-1_walk_happy_001.bvh`")),
    }
}

/// The sentences of a take.
///
/// # Errors
/// If the name is none of the set.
pub fn captions(name: &str) -> Result<[String; 4], String> {
    let labels = labels(name)?;
    let content = CONTENTS.iter().find(|content| content.label == labels.content);
    let content = content.ok_or_else(|| format!("`{name}` has the unknown content `{}`", labels.content))?;
    let style = STYLES.iter().find(|(style, ..)| *style == labels.style);
    let (_, adverb, adjective) = *style.ok_or_else(|| format!("`{name}` has the unknown style `{}`", labels.style))?;
    let Content { verb, continuous, other, .. } = content;
    if adverb.is_empty() {
        return Ok([
            format!("a person {verb}"),
            format!("someone {verb}"),
            format!("someone is {continuous}"),
            format!("a person {other}"),
        ]);
    }
    let article = if adjective.starts_with(['a', 'e', 'i', 'o']) { "an" } else { "a" };
    Ok([
        format!("a person {verb} {adverb}"),
        format!("{article} {adjective} person {verb}"),
        format!("someone is {continuous} {adverb}"),
        format!("a person {other} {adverb}"),
    ])
}

/// Assigns every take of the set to a split.
///
/// # Errors
/// If a name is none of the set.
pub fn splits<'a>(names: &[&'a str]) -> Result<BTreeMap<&'a str, Split>, String> {
    let mut by_style: BTreeMap<Labels<'_>, Vec<&'a str>> = BTreeMap::new();
    for name in names {
        by_style.entry(labels(name)?).or_default().push(name);
    }
    let mut groups: BTreeMap<Labels<'_>, Vec<&'a str>> = BTreeMap::new();
    for (labels, takes) in by_style {
        let group = if takes.len() < OWN_SHARE { Labels { style: "", ..labels } } else { labels };
        groups.entry(group).or_default().extend(takes);
    }
    let mut splits = BTreeMap::new();
    for mut takes in groups.into_values() {
        takes.sort_by_key(|name| (Stream::new(SEED, &format!("bandai/split/{name}"), 0, 0).bits(), *name));
        let share = (takes.len() + 5) / 10;
        for (at, take) in takes.into_iter().enumerate() {
            let split = match at / share.max(1) {
                0 if share > 0 => Split::Test,
                1 if share > 0 => Split::Val,
                _ => Split::Train,
            };
            splits.insert(take, split);
        }
    }
    Ok(splits)
}

/// The files beside the recordings `there`: `captions.csv`, and the lists of the splits. `all` names the whole set.
///
/// # Errors
/// If a name is none of the set.
pub fn tables(all: &[&str], there: &[&str]) -> Result<Vec<(&'static str, String)>, String> {
    let splits = splits(all)?;
    let mut table = String::from("clip,caption\n");
    let mut lists = BTreeMap::<Split, String>::new();
    for name in there {
        let id = name.strip_suffix(".bvh").unwrap_or(name);
        for caption in captions(name)? {
            // Writing to a string cannot fail.
            let _ = writeln!(table, "{id},{caption}");
        }
        let split = splits.get(name).ok_or_else(|| format!("`{name}` is not in the list of the set"))?;
        let _ = writeln!(lists.entry(*split).or_default(), "{id}");
    }
    let mut list = |split: Split| lists.remove(&split).unwrap_or_default();
    Ok(vec![
        ("captions.csv", table),
        ("train.txt", list(Split::Train)),
        ("val.txt", list(Split::Val)),
        ("test.txt", list(Split::Test)),
    ])
}

/// Returns true if a take of so many frames is long enough for training.
pub fn is_long_enough(frames: usize) -> bool {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    // As in the conversion: frames at the skeleton's rate, without the last, which only supplies velocities.
    (frames.saturating_sub(1) as f64 * skeleton.fps / RATE as f64 + 1e-6).floor() as usize >= skeleton.min_frames
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences_have_the_content_and_the_style() {
        let of = |name: &str| captions(name).unwrap();
        assert_eq!(
            of("dataset-2_wave-both-hands_exhausted_004.bvh"),
            [
                "a person waves both hands in an exhausted way",
                "an exhausted person waves both hands",
                "someone is waving both hands in an exhausted way",
                "a person greets with both arms in an exhausted way"
            ]
        );
        assert_eq!(of("dataset-1_walk_normal_001")[0], "a person walks forward");
        for name in ["dataset-1_fly_normal_001", "dataset-1_walk_grumpy_001", "dataset-1_walk_001", "walk", "a_b_c_x"] {
            assert!(captions(name).is_err(), "{name}");
        }
        for content in &CONTENTS {
            for (style, ..) in STYLES {
                for caption in captions(&format!("dataset-1_{}_{style}_001.bvh", content.label)).unwrap() {
                    crate::captions::sentence(&caption).unwrap();
                    assert!(!caption.contains(',') && !caption.contains("  "), "{caption}");
                }
            }
        }
    }

    #[test]
    fn a_split_is_a_tenth_of_every_style_and_does_not_depend_on_what_is_there() {
        let names: Vec<String> = (1..=40)
            .flat_map(|take| ["normal", "active"].map(|style| format!("dataset-2_run_{style}_{take:03}.bvh")))
            .chain(["happy", "sad", "old"].map(|style| format!("dataset-1_bow_{style}_001.bvh")))
            .collect();
        let all: Vec<&str> = names.iter().map(String::as_str).collect();
        let splits = splits(&all).unwrap();
        for style in ["normal", "active"] {
            let count = |split| splits.iter().filter(|(name, of)| name.contains(style) && **of == split).count();
            assert_eq!((count(Split::Test), count(Split::Val), count(Split::Train)), (4, 4, 32));
        }
        assert!(all[80..].iter().all(|name| splits[name] == Split::Train), "three takes have no tenth");
        let files = tables(&all, &all[..10]).unwrap();
        let listed: usize = files[1..].iter().map(|(_, text)| text.lines().count()).sum();
        assert_eq!((files[0].1.lines().count(), listed), (41, 10));
        for (name, text) in &files[1..] {
            for id in text.lines() {
                assert_eq!(format!("{}.txt", splits[format!("{id}.bvh").as_str()]), *name);
            }
        }
    }

    #[test]
    fn takes_of_two_seconds_are_long_enough() {
        assert_eq!((is_long_enough(60), is_long_enough(61), is_long_enough(0)), (false, true, false));
    }
}
