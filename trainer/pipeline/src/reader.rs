//! Reader of a pipeline file that collects its mistakes: the common part of reading a stage and a sweep.

use protocol::spelling::nearest;
use protocol::stage::StageSettings;
use serde::Serialize;
use serde_json::Value;

use crate::diagnostic::Position;
use crate::schema::{Mistake, list_keys, overlay};
use crate::yaml::Node;

pub(crate) struct Reader {
    pub(crate) mistakes: Vec<Mistake>,
}

impl Reader {
    pub(crate) fn mistake(&mut self, at: Position, path: &str, message: impl Into<String>, help: Option<String>) {
        self.mistakes.push(Mistake { at, path: path.to_owned(), message: message.into(), help });
    }

    /// Reads a settings struct; `None` if it has a mistake.
    pub(crate) fn typed<T: Default + Serialize + serde::de::DeserializeOwned>(
        &mut self,
        node: &Node,
        owner: &str,
        path: &str,
        skip: &[&str],
    ) -> Option<T> {
        self.overlaid(serde_json::to_value(T::default()).ok()?, node, owner, path, skip)
    }

    pub(crate) fn overlaid<T: serde::de::DeserializeOwned>(
        &mut self,
        mut base: Value,
        node: &Node,
        owner: &str,
        path: &str,
        skip: &[&str],
    ) -> Option<T> {
        let before = self.mistakes.len();
        overlay::<T>(&mut base, node, owner, path, skip, &mut self.mistakes);
        if self.mistakes.len() > before {
            return None;
        }
        match serde_json::from_value(base) {
            Ok(value) => Some(value),
            Err(error) => {
                self.mistake(node.at, path, format!("{owner} has settings that conflict: {error}"), None);
                None
            }
        }
    }

    /// Default settings of the kind that `node` names.
    pub(crate) fn kind(&mut self, node: &Node, at: Position, owner: &str, path: &str) -> Option<StageSettings> {
        let mut all = StageSettings::all();
        let kinds: Vec<&str> = all.iter().map(StageSettings::kind).collect();
        let Some(kind) = node.entry("kind") else {
            let message = format!("{owner} has no `kind`");
            self.mistake(at, &format!("{path}.kind"), message, Some(format!("kinds: {}", list_keys(kinds))));
            return None;
        };
        let Some(found) = kind.value.as_text().and_then(|text| all.iter().position(|s| s.kind() == text)) else {
            let near = kind.value.as_text().and_then(|text| nearest(text, kinds.iter().copied()));
            let question = near.map(|near| format!("; did you mean `{near}`?")).unwrap_or_default();
            let message = match kind.value.as_text() {
                Some(text) => format!("unknown kind `{text}` of {owner}{question}"),
                None => format!("`kind` of {owner} is {}; expected a string", kind.value.describe()),
            };
            let help = Some(format!("kinds: {}", list_keys(kinds)));
            self.mistake(kind.value.at, &format!("{path}.kind"), message, help);
            return None;
        };
        Some(all.swap_remove(found))
    }
}
