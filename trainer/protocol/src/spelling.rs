//! Suggestions for names that do not exist: `did you mean`.

/// Finds the candidate that `text` probably means: at most a third of its letters differ.
pub fn nearest<'a>(text: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let text = text.to_lowercase();
    // Names of other programs for it.
    let text = match text.as_str() {
        "learning_rate" => "lr".to_owned(),
        "iterations" | "epochs" | "max_steps" => "steps".to_owned(),
        "batch_size" => "batch".to_owned(),
        "d_model" | "hidden_size" => "width".to_owned(),
        _ => text,
    };
    let limit = (text.chars().count().max(3) / 3).clamp(1, 4);
    let away = |candidate: &str| {
        let candidate = candidate.to_lowercase();
        // `steps_total` for `steps`, or `learning_rate` for `rate`: sharing a whole word counts as similar.
        if text.split(['_', '-', '.']).any(|word| word == candidate) {
            return 1;
        }
        distance(&text, &candidate)
    };
    candidates
        .into_iter()
        .map(|candidate| (away(candidate), candidate))
        .filter(|(distance, _)| *distance <= limit)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Edit distance of the first 64 characters; a swap of neighbours counts as one edit.
pub fn distance(a: &str, b: &str) -> usize {
    let beginning = |text: &str| text.chars().take(64).collect::<String>();
    strsim::osa_distance(&beginning(a), &beginning(b))
}

/// `; did you mean \`fid\`?`, or nothing if no candidate is near.
pub fn question<'a>(text: &str, candidates: impl IntoIterator<Item = &'a str>) -> String {
    nearest(text, candidates).map(|near| format!("; did you mean `{near}`?")).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_key_is_the_one_that_was_meant() {
        let keys = ["steps", "batch", "lr", "warmup", "network"];
        assert_eq!(nearest("warmpu", keys), Some("warmup"));
        assert_eq!(nearest("step", keys), Some("steps"));
        assert_eq!(nearest("LR", keys), Some("lr"));
        assert_eq!(nearest("zebra", keys), None);
    }
}
