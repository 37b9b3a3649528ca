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

/// Edit distance in characters, of which 64 are looked at; swapping neighbours counts as one edit.
pub fn distance(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.chars().take(64).collect();
    let b: Vec<char> = b.chars().take(64).collect();
    let mut rows: Vec<Vec<usize>> = vec![(0..=b.len()).collect()];
    for i in 1..=a.len() {
        let mut row = vec![i; b.len() + 1];
        for j in 1..=b.len() {
            let change = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            row[j] = change.min(rows[i - 1][j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                row[j] = row[j].min(rows[i - 2][j - 2] + 1);
            }
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
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
