//! Entries of a clip by the loaders' rules, which [`open`](super::open) names.

use super::{Clip, Dataset, Entry, Split};

/// A caption with times that describe too few or too many frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unusable {
    /// The caption's line.
    pub line: usize,
    /// First frame.
    pub start: usize,
    /// One past the last frame.
    pub end: usize,
}

impl Dataset {
    /// Adds the entries of clip `clip`: one with all captions of the whole clip, then one for each caption with times.
    /// `captions` has each caption's line and index. Returns the captions that give no entry.
    pub fn add_entries(&mut self, clip: usize, split: Split, captions: &[(usize, usize)]) -> Vec<Unusable> {
        let skeleton = self.skeleton();
        let Clip { id, frames, .. } = &self.clips[clip];
        let frames = *frames;
        let mut whole = Vec::new();
        let mut parts: Vec<Entry> = Vec::new();
        let mut unusable = Vec::new();
        for (line, index) in captions {
            let Some((from, to)) = self.captions[*index].frames(skeleton.fps) else {
                whole.push(*index);
                continue;
            };
            let start = from.min(frames);
            let end = to.min(frames);
            let len = end.saturating_sub(start);
            if !(skeleton.min_frames..skeleton.max_frames).contains(&len) {
                unusable.push(Unusable { line: *line, start, end });
                continue;
            }
            let mut name = format!("{id}@{start}-{end}");
            if parts.iter().any(|part| part.id == name) {
                name = format!("{name}.{line}");
            }
            parts.push(Entry { id: name, clip, start, len, captions: vec![*index], split });
        }
        if !whole.is_empty() {
            self.entries.push(Entry { id: id.clone(), clip, start: 0, len: frames, captions: whole, split });
        }
        self.entries.extend(parts);
        unusable
    }

    /// Drops clips and captions that no entry uses, so that they do not change the dataset's digest.
    pub fn drop_unused(&mut self) {
        let mut clip_used = vec![false; self.clips.len()];
        let mut caption_used = vec![false; self.captions.len()];
        for entry in &self.entries {
            clip_used[entry.clip] = true;
            entry.captions.iter().for_each(|c| caption_used[*c] = true);
        }
        let clip_at = renumbered(&clip_used);
        let caption_at = renumbered(&caption_used);
        let mut keep = clip_used.iter();
        self.clips.retain(|_| keep.next().copied().unwrap_or(true));
        let mut keep = caption_used.iter();
        self.captions.retain(|_| keep.next().copied().unwrap_or(true));
        for entry in &mut self.entries {
            entry.clip = clip_at[entry.clip];
            entry.captions.iter_mut().for_each(|c| *c = caption_at[*c]);
        }
    }
}

/// For each index the number of used ones before it.
fn renumbered(used: &[bool]) -> Vec<usize> {
    let mut next = 0;
    let mut numbers = Vec::with_capacity(used.len());
    for used in used {
        numbers.push(next);
        next += usize::from(*used);
    }
    numbers
}
