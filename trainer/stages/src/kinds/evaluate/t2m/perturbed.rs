//! Paraphrased captions, to test whether a model depends on words or on meaning. Source: SATO (Chen et al., 2024) and
//! Free-T2M's table 5. Their captions with exchanged words are published, but not the method. Departs: words are
//! exchanged by the table below, which is ours.

use motion::Stream;

/// Groups of words with the same meaning in a caption; each may replace any other of its group.
const GROUPS: &[&[&str]] = &[
    &["person", "man", "someone", "figure", "individual", "human"],
    &["walks", "strolls", "paces", "strides"],
    &["walk", "stroll", "pace", "stride"],
    &["walking", "strolling", "pacing", "striding"],
    &["runs", "sprints", "dashes"],
    &["running", "sprinting", "dashing"],
    &["jumps", "leaps", "springs"],
    &["jumping", "leaping", "springing"],
    &["jump", "leap"],
    &["forward", "forwards", "ahead"],
    &["backward", "backwards", "rearward"],
    &["quickly", "fast", "rapidly", "swiftly"],
    &["slowly", "leisurely", "gradually"],
    &["turns", "rotates", "spins"],
    &["turning", "rotating", "spinning"],
    &["raises", "lifts", "elevates"],
    &["raising", "lifting", "elevating"],
    &["lowers", "drops"],
    &["circle", "loop", "ring"],
    &["steps", "paces"],
    &["stops", "halts", "pauses"],
    &["starts", "begins"],
    &["moves", "shifts"],
    &["moving", "shifting"],
    &["around", "about"],
    &["picks", "takes"],
    &["throws", "tosses", "hurls"],
    &["throwing", "tossing", "hurling"],
    &["kicks", "boots"],
    &["waves", "gestures"],
    &["sits", "squats"],
    &["bends", "stoops"],
    &["bending", "stooping"],
    &["shakes", "wiggles"],
    &["straight", "directly"],
    &["while", "as"],
    &["then", "afterwards"],
    &["large", "big", "wide"],
    &["small", "little"],
    &["hits", "strikes", "punches"],
    &["dances", "grooves"],
    &["looks", "glances", "gazes"],
];

/// Paraphrases `caption`: every word in a group is replaced by another of the group with `probability`. Punctuation
/// around a word stays.
pub(super) fn said_otherwise(caption: &str, probability: f64, stream: &mut Stream) -> String {
    let word = |word: &str| {
        let bare = word.trim_matches(|c: char| !c.is_alphanumeric());
        let lower = bare.to_lowercase();
        let Some(group) = GROUPS.iter().find(|group| group.contains(&lower.as_str())) else { return word.to_owned() };
        // Drawn for each such word, so that a higher probability replaces the same words and more.
        let share = stream.uniform();
        let which = stream.below(group.len() - 1);
        let others: Vec<&str> = group.iter().copied().filter(|other| *other != lower).collect();
        if share < probability { word.replacen(bare, others[which], 1) } else { word.to_owned() }
    };
    caption.split(' ').map(word).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use protocol::Seed;

    use super::*;

    fn said(probability: f64, seed: u64) -> String {
        let mut stream = Stream::new(Seed(seed), "a test", 0, 0);
        said_otherwise("a Person walks forward, then waves at a zebra.", probability, &mut stream)
    }

    #[test]
    fn words_are_exchanged_for_others_of_their_meaning_alone() {
        assert_eq!(said(0.0, 1), "a Person walks forward, then waves at a zebra.");
        let all: Vec<String> = said(1.0, 1).split(' ').map(str::to_owned).collect();
        assert_eq!((all.len(), &all[0][..], &all[6..]), (9, "a", &["at", "a", "zebra."].map(str::to_owned)[..]));
        assert!(GROUPS[0].contains(&&all[1][..]) && all[1] != "person", "{all:?}");
        assert!(all[3].ends_with(',') && !all[3].starts_with("forward,"), "{all:?}");
        assert_eq!(said(1.0, 1), said(1.0, 1));
        assert!((0..20).any(|seed| said(0.5, seed) != said(0.5, 0)));
        for group in GROUPS {
            assert!(group.len() > 1, "{group:?}");
        }
    }
}
