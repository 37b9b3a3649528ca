//! Gives the program the text of `--version`.

include!("../ops/version.rs");

fn main() {
    println!("cargo::rerun-if-changed=../ops/version.rs");
    print_version();
}
