//! Errors about a file never quote it.

use hostile::{canary, targets};

/// Excluded: a pipeline is its user's own text, and the last three read no file.
const OTHERS: [&str; 4] = ["pipeline", "bvh_out", "glb", "html"];

#[test]
fn no_error_quotes_a_file() {
    let places = if fixtures::long("a canary at 150 places of each file") { 150 } else { 40 };
    let read: Vec<_> = targets::TARGETS.iter().filter(|target| !OTHERS.contains(&target.name)).collect();
    assert_eq!(read.len() + OTHERS.len(), targets::TARGETS.len());
    for target in read {
        let begun = std::time::Instant::now();
        canary::run(target, places);
        println!("{}: {:.1} s", target.name, begun.elapsed().as_secs_f64());
    }
}

#[test]
#[should_panic(expected = "an error quotes the file")]
fn an_error_that_does_is_found() {
    canary::expect_absent("clip `qzCanaryZq` is unknown");
}
