//! Finds files of a crate that import each other in a loop, from their text as `rustfmt` formats it.
//!
//! `mod x;` gives the tree of modules. Every path that starts with `crate`, `super`, `self` or a child module is
//! followed through `use` declarations to the file that defines its item. A re-export (`pub use`) does not count as a
//! use, and neither does code behind `#[cfg(test)]`. Not seen: methods, names from a glob, inline modules, and code
//! from macros.
//!
//! Folders are held to the same rule: [`folder_loops`].

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

type Names = Vec<String>;

/// The files that each file needs, each with one item that it uses.
type Needs = BTreeMap<PathBuf, BTreeMap<PathBuf, String>>;

#[derive(Debug)]
struct Module {
    file: PathBuf,
    /// Names of `use` declarations with their paths.
    names: BTreeMap<String, Names>,
    /// The paths used in the module.
    paths: Vec<Names>,
}

/// The imports that close loops in the crate with the root file `root` (`lib.rs` or `main.rs`), each as
/// `FILE -> FILE: NAME`.
///
/// # Panics
///
/// If a file of the crate cannot be read.
pub fn loops(root: &Path) -> Vec<String> {
    closing(&needs(root))
}

/// The imports that close loops between the folders of the crate with the root file `root`, each as
/// `FOLDER -> FOLDER: NAME`. A folder represents all files in it, beside the other files and folders of its parent. Its
/// module file (`mod.rs`) is one of its files.
///
/// # Panics
///
/// If a file of the crate cannot be read.
pub fn folder_loops(root: &Path) -> Vec<String> {
    let mut levels: BTreeMap<PathBuf, Needs> = BTreeMap::new();
    for (from, all) in needs(root) {
        for (to, name) in all {
            let common: PathBuf =
                from.iter().zip(to.iter()).take_while(|(a, b)| a == b).map(|(same, _)| same).collect();
            let child = |file: &Path| common.join(file.iter().nth(common.iter().count()).expect("two files differ"));
            // `stream.rs` and the folder `stream` are one module.
            let (from, to) = (child(&from).with_extension(""), child(&to).with_extension(""));
            if from != to {
                levels.entry(common).or_default().entry(from).or_default().insert(to, name);
            }
        }
    }
    levels.values().flat_map(closing).collect()
}

/// The files that each file of a crate needs.
fn needs(root: &Path) -> Needs {
    let mut modules = BTreeMap::new();
    read(&mut modules, root, &[], &root.with_file_name(""));
    let mut needs = Needs::new();
    for (at, module) in &modules {
        let items = module.paths.iter().filter_map(|path| item(&modules, at, path, 0));
        for (file, name) in items.filter(|(file, _)| *file != module.file) {
            needs.entry(module.file.clone()).or_default().insert(file, name);
        }
    }
    needs
}

/// The imports that are part of a loop.
fn closing(needs: &Needs) -> Vec<String> {
    let imports = needs.iter().flat_map(|(from, all)| all.iter().map(move |(to, name)| (from, to, name)));
    let closing = imports.filter(|(from, to, _)| reached(needs, to).contains(from));
    closing.map(|(from, to, name)| format!("{} -> {}: {name}", from.display(), to.display())).collect()
}

/// All files that `from` needs, directly or indirectly.
fn reached<'a>(needs: &'a Needs, from: &'a PathBuf) -> BTreeSet<&'a PathBuf> {
    let (mut seen, mut next) = (BTreeSet::new(), vec![from]);
    while let Some(file) = next.pop() {
        next.extend(needs.get(file).into_iter().flat_map(BTreeMap::keys).filter(|to| seen.insert(*to)));
    }
    seen
}

/// Reads the file of the module `at`, and those of its child modules in `folder`.
fn read(modules: &mut BTreeMap<Names, Module>, file: &Path, at: &[String], folder: &Path) {
    let text = fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    let mut module = Module { file: file.to_owned(), names: BTreeMap::new(), paths: Vec::new() };
    let mut children = Names::new();
    let mut lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    while let Some(line) = lines.next() {
        let (code, indent) = (line.trim_start(), line.len() - line.trim_start().len());
        let ends = |line: &str| line.len() - line.trim_start().len() == indent && line.ends_with(['}', ';']);
        let bare = code.strip_prefix("pub").map_or(code, |rest| rest.trim_start_matches(|c| c != ' ').trim_start());
        if code == "#[cfg(test)]" || (bare.starts_with("mod ") && bare.ends_with('{')) {
            lines.find(|line| ends(line));
        } else if let Some(name) = bare.strip_prefix("mod ").and_then(|rest| rest.strip_suffix(';')) {
            children.push(name.to_owned());
        } else if let Some(tree) = bare.strip_prefix("use ") {
            let mut tree = tree.to_owned();
            while !tree.ends_with(';') {
                tree.push_str(lines.next().expect("a `use` ends with `;`").trim());
            }
            let mut paths = Vec::new();
            unfold(tree.trim_end_matches(';'), &[], &mut paths);
            for (path, name) in paths {
                if bare == code {
                    module.paths.push(path.clone());
                }
                module.names.insert(name, path);
            }
        } else {
            let words = code.split(|c: char| !(c.is_alphanumeric() || "_:".contains(c)));
            let paths = words.filter(|word| word.contains("::"));
            module.paths.extend(paths.map(|path| path.split("::").map(str::to_owned).collect::<Names>()));
        }
    }
    modules.insert(at.to_vec(), module);
    for name in children {
        let (flat, beneath) = (folder.join(format!("{name}.rs")), folder.join(&name));
        let file = if flat.is_file() { flat } else { beneath.join("mod.rs") };
        read(modules, &file, &[at, &[name]].concat(), &beneath);
    }
}

/// The paths of a `use` tree below `prefix`, each with the name that it imports.
fn unfold(tree: &str, prefix: &[String], paths: &mut Vec<(Names, String)>) {
    let tree = tree.trim();
    if let Some((head, rest)) = tree.split_once('{') {
        let prefix: Names = prefix.iter().cloned().chain(head.split_terminator("::").map(str::to_owned)).collect();
        let (mut depth, mut begun) = (0, 0);
        for (i, c) in rest.char_indices() {
            match c {
                '{' => depth += 1,
                ',' | '}' if depth == 0 => {
                    unfold(&rest[begun..i], &prefix, paths);
                    begun = i + 1;
                }
                '}' => depth -= 1,
                _ => {}
            }
        }
    } else if !tree.is_empty() && !tree.ends_with('*') {
        let (path, alias) = tree.split_once(" as ").map_or((tree, None), |(path, alias)| (path, Some(alias)));
        let mut path: Names = prefix.iter().cloned().chain(path.split("::").map(str::to_owned)).collect();
        path.pop_if(|last| last == "self");
        let name = alias.map(str::to_owned).or_else(|| path.last().cloned()).unwrap_or_default();
        paths.push((path, name));
    }
}

/// The file that defines the item `path` as seen from the module `at`, and the item's name. `None` for items of other
/// crates.
fn item(modules: &BTreeMap<Names, Module>, at: &[String], path: &[String], depth: usize) -> Option<(PathBuf, String)> {
    let mut module = at.to_vec();
    for (i, word) in path.iter().enumerate() {
        let child = [module.as_slice(), std::slice::from_ref(word)].concat();
        match word.as_str() {
            "crate" => module.clear(),
            "self" => {}
            "super" => drop(module.pop()?),
            _ if modules.contains_key(&child) => module = child,
            name => {
                let here = &modules[&module];
                return match here.names.get(name) {
                    Some(stands_for) if depth < 16 => {
                        item(modules, &module, &[stands_for, &path[i + 1..]].concat(), depth + 1)
                    }
                    // A path whose first name is unknown here belongs to another crate.
                    _ => (i > 0).then(|| (here.file.clone(), name.to_owned())),
                };
            }
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loops_are_found_through_what_hands_names_on() {
        let dir = tempfile::tempdir().expect("a folder");
        let file = |name: &str, text: &str| {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("a file");
        };
        file("lib.rs", "mod a;\nmod b;\nmod c;\npub use a::Apple;\n");
        file("a.rs", "use crate::b::{self, nested::Deep as D};\npub struct Apple;\n");
        file("b/mod.rs", "pub mod nested;\n#[cfg(test)]\nmod tests {\n    use crate::c::C;\n}\n");
        file("b/nested.rs", "pub struct Deep;\n");
        file("c.rs", "fn f() -> u8 {\n    crate::b::nested::make();\n    super::Apple::new()\n}\n");
        let root = dir.path().join("lib.rs");
        assert!(loops(&root).is_empty(), "{:?}", loops(&root));
        file("b/nested.rs", "use std::fs;\nuse crate::Apple;\npub struct Deep;\n");
        let found = loops(&root);
        assert!(
            found.len() == 2 && found[0].ends_with("nested.rs: Deep") && found[1].ends_with("a.rs: Apple"),
            "{found:?}"
        );
    }

    #[test]
    fn folders_that_import_each_other_are_found_without_a_loop_of_files() {
        let dir = tempfile::tempdir().expect("a folder");
        let file = |name: &str, text: &str| {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("a file");
        };
        file("lib.rs", "mod high;\nmod low;\n");
        file("high/mod.rs", "mod user;\npub mod word;\n");
        file("high/user.rs", "use crate::low::net::Net;\n");
        file("high/word.rs", "pub struct Word;\n");
        file("low/mod.rs", "pub mod net;\n");
        file("low/net.rs", "pub struct Net;\n");
        let root = dir.path().join("lib.rs");
        assert!(folder_loops(&root).is_empty(), "{:?}", folder_loops(&root));
        file("low/net.rs", "use crate::high::word::Word;\npub struct Net;\n");
        assert!(loops(&root).is_empty());
        let found = folder_loops(&root);
        assert!(found.len() == 2 && found[0].ends_with("low: Net") && found[1].ends_with("high: Word"), "{found:?}");
    }
}
