//! Builds again when a migration is added; the macro that embeds them sees only those it knows. Gives the program the text of `--version`.

include!("../ops/version.rs");

fn main() {
    println!("cargo::rerun-if-changed=../migrations");
    println!("cargo::rerun-if-changed=../ops/version.rs");
    print_version();
}
