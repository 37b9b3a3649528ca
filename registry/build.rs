//! Embeds the migrations of both databases, and provides the text of `--version`.

use std::fmt::Write as _;
use std::{env, fs};

include!("../ops/version.rs");

fn main() {
    println!("cargo::rerun-if-changed=../migrations");
    println!("cargo::rerun-if-changed=../ops/version.rs");
    let mut lists = String::new();
    for (name, database) in [("SQLITE", "sqlite"), ("POSTGRES", "postgres")] {
        let files = migrations(database);
        writeln!(lists, "pub(super) const {name}: [Embedded; {}] = [", files.len()).expect("text");
        for (version, description, path) in files {
            writeln!(lists, "    ({version}, {description:?}, include_str!({path:?})),").expect("text");
        }
        writeln!(lists, "];").expect("text");
    }
    let out = env::var("OUT_DIR").expect("cargo names it");
    fs::write(Path::new(&out).join("migrations.rs"), lists).expect("the folder is ours");
    print_version();
}

/// Returns number, description and path of each file `NNNN_DESCRIPTION.sql`, in order.
fn migrations(database: &str) -> Vec<(i64, String, String)> {
    let dir = Path::new(&env::var("CARGO_MANIFEST_DIR").expect("cargo names it")).join("../migrations").join(database);
    let mut files = Vec::new();
    for entry in fs::read_dir(&dir).expect("the folder of the migrations") {
        let path = entry.expect("its files").path();
        let name = path.file_stem().and_then(|name| name.to_str()).expect("a name");
        let (version, description) = name.split_once('_').expect("`NNNN_DESCRIPTION.sql`");
        let version = version.parse().expect("a number");
        files.push((version, description.replace('_', " "), path.display().to_string()));
    }
    files.sort();
    files
}
