//! `--set a.b=c`: values are written over the tree before its check, so that they are checked like the file.

use protocol::limits;
use protocol::spelling::nearest;
use serde_json::Value;

use crate::diagnostic::Position;
use crate::schema::list_keys;
use crate::yaml::{self, Budget, Content, Entry, Node};

/// Top-level keys of a pipeline.
pub(crate) const TOP_KEYS: [&str; 7] = ["name", "seed", "backend", "priority", "dataset", "text", "stages"];

/// Applies one override; positions of added values have `source`.
///
/// # Errors
/// The defect of the override.
pub(crate) fn apply(root: &mut Node, text: &str, source: usize, budget: &mut Budget) -> Result<(), String> {
    let at = Position { source, line: 1, column: 1 };
    let Some((path, value)) = text.split_once('=') else {
        return Err("expected `key.path=value`, such as `stages.vae.lr=1e-4`".into());
    };
    let mut keys: Vec<&str> = path.trim().split('.').collect();
    if keys.len() > limits::PIPELINE_DEPTH {
        return Err(format!("its path has {} keys; at most {} are read", keys.len(), limits::PIPELINE_DEPTH));
    }
    if let Some(long) = keys.iter().find(|key| key.len() > limits::KEY_BYTES) {
        return Err(format!("its path has a key of {} bytes; at most {} are read", long.len(), limits::KEY_BYTES));
    }
    if keys.iter().any(|key| key.is_empty()) {
        return Err(format!("`{path}` is not a path of keys; expected a path such as `stages.vae.lr`"));
    }
    if !TOP_KEYS.contains(&keys[0]) {
        // `vae.lr` abbreviates `stages.vae.lr`.
        let stages: Vec<&str> =
            root.entry("stages").and_then(|e| e.value.map()).unwrap_or(&[]).iter().map(|e| e.key.as_str()).collect();
        if stages.contains(&keys[0]) {
            keys.insert(0, "stages");
        } else {
            let near = nearest(keys[0], TOP_KEYS.into_iter().chain(stages.iter().copied()));
            let question = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
            let known = list_keys(TOP_KEYS.into_iter().chain(stages.iter().copied()));
            return Err(format!(
                "`{}` is neither a key of the pipeline nor a stage{question} (known: {known})",
                keys[0]
            ));
        }
    }
    let value = if value.trim().is_empty() {
        Node { at, value: Content::Scalar { value: Value::Null, text: String::new(), plain: true } }
    } else {
        yaml::parse(value, source, budget).map_err(|mistakes| {
            let first = mistakes.into_iter().next().map_or_else(String::new, |mistake| mistake.message);
            format!("cannot parse the value `{}`: {first}", yaml::shortened(value))
        })?
    };
    put(root, &keys, value, at, path.trim())
}

fn put(node: &mut Node, keys: &[&str], value: Node, at: Position, path: &str) -> Result<(), String> {
    let Some((key, rest)) = keys.split_first() else {
        *node = value;
        return Ok(());
    };
    match &mut node.value {
        Content::Map(entries) => {
            let index = entries.iter().position(|entry| entry.key == *key).unwrap_or_else(|| {
                let empty = Node { at, value: Content::Map(Vec::new()) };
                entries.push(Entry { key: (*key).to_owned(), key_at: at, value: empty });
                entries.len() - 1
            });
            put(&mut entries[index].value, rest, value, at, path)
        }
        Content::List(items) => {
            let length = items.len();
            match key.parse::<usize>().ok().and_then(|index| items.get_mut(index)) {
                Some(item) => put(item, rest, value, at, path),
                None => Err(format!("`{key}` in `{path}` is not an index of a list of {length} entries")),
            }
        }
        Content::Scalar { value: Value::Null, .. } => {
            *node = Node { at, value: Content::Map(Vec::new()) };
            put(node, keys, value, at, path)
        }
        Content::Scalar { text, .. } => {
            Err(format!("`{key}` in `{path}` is not a key: the value `{}` has no keys", yaml::shortened(text)))
        }
    }
}
