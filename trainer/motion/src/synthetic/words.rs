//! Sentences for synthetic clips, with the tokens that the evaluators read.
//!
//! A template names its slots: `{s}` the subject, `{m}` manner (from the tempo, may be empty), `{side}` and `{other}`,
//! `{round}` the turning direction. Words are tagged from a small dictionary; a test checks every template against it.

use crate::random::Stream;
use crate::text::Caption;

const WHO: [&str; 6] = ["a person", "someone", "a man", "a woman", "the person", "a figure"];

/// Speed of the clip, in words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Manner {
    Slow,
    Ordinary,
    Fast,
}

/// Entries `word=lemma/POS`, or `word/POS` if the word is its own lemma.
const DICTIONARY: &str = "a/DET the/DET an/DET one/NUM his=his/DET both/DET each/DET \
    person/NOUN someone/PRON man/NOUN woman/NOUN figure/NOUN something/PRON they/PRON \
    is/AUX walks=walk/VERB walking=walk/VERB runs=run/VERB running=run/VERB jogs=jog/VERB turns=turn/VERB \
    turning=turn/VERB goes=go/VERB moves=move/VERB steps=step/VERB stepping=step/VERB takes=take/VERB \
    sneaks=sneak/VERB sneaking=sneak/VERB creeps=creep/VERB marches=march/VERB marching=march/VERB crawls=crawl/VERB \
    crawling=crawl/VERB jumps=jump/VERB jumping=jump/VERB leaps=leap/VERB hops=hop/VERB hopping=hop/VERB \
    waves=wave/VERB waving=wave/VERB kicks=kick/VERB kicking=kick/VERB punches=punch/VERB punching=punch/VERB \
    throws=throw/VERB throwing=throw/VERB boxes=box/VERB boxing=box/VERB sits=sit/VERB sitting=sit/VERB \
    squats=squat/VERB squatting=squat/VERB bends=bend/VERB raises=raise/VERB raising=raise/VERB lifts=lift/VERB \
    bows=bow/VERB bowing=bow/VERB claps=clap/VERB clapping=clap/VERB stretches=stretch/VERB stretching=stretch/VERB \
    leans=lean/VERB does=do/VERB doing=do/VERB picks=pick/VERB picking=pick/VERB stands=stand/VERB \
    balances=balance/VERB balancing=balance/VERB spins=spin/VERB shuffles=shuffle/VERB keeps=keep/VERB \
    holds=hold/VERB \
    hand/NOUN hands=hand/NOUN arm/NOUN arms=arm/NOUN leg/NOUN foot/NOUN knee/NOUN knees=knee/NOUN head/NOUN \
    chair/NOUN floor/NOUN ground/NOUN circle/NOUN place/NOUN air/NOUN side/NOUN zombie/NOUN jacks=jack/NOUN \
    ball/NOUN body/NOUN upper/ADJ direction/NOUN \
    left/ADJ right/ADJ straight/ADV forward/ADV backward/ADV backwards/ADV ahead/ADV around/ADV up/ADV down/ADV \
    again/ADV slowly/ADV quickly/ADV sideways/ADV high/ADV low/ADV deeply/ADV politely/ADV clockwise/ADV \
    counterclockwise/ADV then/ADV \
    to/ADP in/ADP with/ADP on/ADP of/ADP over/ADP from/ADP into/ADP like/ADP above/ADP off/ADP at/ADP out/ADP \
    and/CCONJ while/SCONJ";

/// The token of a word of the dictionary.
fn token(word: &str) -> Option<String> {
    DICTIONARY.split_whitespace().find_map(|item| {
        let (forms, pos) = item.split_once('/')?;
        let (form, lemma) = forms.split_once('=').unwrap_or((forms, forms));
        (form == word).then(|| format!("{lemma}/{pos}"))
    })
}

/// Tokenises a sentence; words that the dictionary lacks get the tag `X`.
pub fn tokens(text: &str) -> Vec<String> {
    text.split(|c: char| !c.is_ascii_alphabetic())
        .filter(|word| !word.is_empty())
        .map(|word| token(word).unwrap_or_else(|| format!("{word}/X")))
        .collect()
}

fn fill(template: &str, who: &str, manner: Manner, side: usize) -> String {
    let sides = ["left", "right"];
    let manner = match manner {
        Manner::Slow => " slowly",
        Manner::Ordinary => "",
        Manner::Fast => " quickly",
    };
    template
        .replace("{s}", who)
        .replace("{m}", manner)
        .replace("{side}", sides[side])
        .replace("{other}", sides[1 - side])
        .replace("{round}", ["counterclockwise", "clockwise"][side])
        + "."
}

/// Draws two or three different sentences from the templates of a movement.
pub(super) fn captions(stream: &mut Stream, templates: &[&str], manner: Manner, side: usize) -> Vec<Caption> {
    let mut open: Vec<&str> = templates.to_vec();
    (0..2 + stream.below(2))
        .map_while(|_| {
            if open.is_empty() {
                return None;
            }
            let template = open.swap_remove(stream.below(open.len()));
            let text = fill(template, WHO[stream.below(WHO.len())], manner, side);
            let tokens = tokens(&text);
            Some(Caption::whole(text, tokens))
        })
        .collect()
}

/// The caption of the mirrored clip, with left and right, clockwise and counterclockwise swapped.
pub(super) fn mirrored(caption: &Caption) -> Caption {
    const PAIRS: [(&str, &str); 2] = [("left", "right"), ("clockwise", "counterclockwise")];
    let swap = |word: &str| {
        let bare = word.trim_end_matches('.');
        let other = PAIRS.iter().find_map(|(a, b)| match bare {
            w if w == *a => Some(*b),
            w if w == *b => Some(*a),
            _ => None,
        });
        other.map_or_else(|| word.to_owned(), |o| word.replacen(bare, o, 1))
    };
    let text = caption.text.split(' ').map(swap).collect::<Vec<_>>().join(" ");
    let tokens = tokens(&text);
    Caption { text, tokens, ..caption.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::KINDS;

    #[test]
    fn the_dictionary_knows_every_word_of_every_template() {
        for kind in KINDS {
            assert!(kind.words.len() >= 3, "{}", kind.name);
            for (template, side) in kind.words.iter().flat_map(|t| [(t, 0), (t, 1)]) {
                for (who, manner) in WHO.iter().zip([Manner::Slow, Manner::Ordinary, Manner::Fast].iter().cycle()) {
                    let text = fill(template, who, *manner, side);
                    assert!(!text.contains('{') && !text.contains("  "), "{text}");
                    let unknown: Vec<_> = tokens(&text).into_iter().filter(|t| t.ends_with("/X")).collect();
                    assert!(unknown.is_empty(), "{text}: {unknown:?}");
                }
            }
        }
    }

    #[test]
    fn mirroring_swaps_sides() {
        let text = "a man waves with his left hand and turns counterclockwise.";
        let caption = Caption::whole(text, tokens(text));
        let other = mirrored(&caption);
        assert_eq!(other.text, "a man waves with his right hand and turns clockwise.");
        assert!(other.tokens.contains(&"right/ADJ".to_owned()));
        assert_eq!(mirrored(&other), caption);
    }
}
