//! Rebuilds after a new migration, because the macro that embeds them tracks only existing files. Provides the text of
//! `--version`.

include!("../ops/version.rs");

fn main() {
    println!("cargo::rerun-if-changed=../migrations");
    println!("cargo::rerun-if-changed=../ops/version.rs");
    print_version();
}
