//! The text of `/metrics` is what Prometheus reads: by rules of its own format here, and by its own tool where it is
//! installed.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write as _;
use std::process::{Command, Stdio};

/// Series without a bound would grow with use, so no label may have many values.
const MOST_SERIES: usize = 50;

/// Checks a text of the version 0.0.4; returns the number of its metrics.
pub(crate) fn check(text: &str) -> usize {
    let mut kinds: BTreeMap<&str, &str> = BTreeMap::new();
    let (mut helped, mut samples) = (BTreeSet::new(), BTreeMap::<&str, BTreeSet<&str>>::new());
    assert!(text.ends_with('\n'), "{text}");
    for line in text.lines() {
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').expect(line);
            assert!(helped.insert(name) && !help.is_empty(), "{line}");
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').expect(line);
            assert!(helped.contains(name) && kinds.insert(name, kind).is_none(), "{line}");
        } else {
            assert!(!line.starts_with('#'), "{line}");
            let (series, value) = line.rsplit_once(' ').expect(line);
            value.parse::<f64>().expect(line);
            let name = series.split('{').next().expect(line);
            let parts = [name, family(name)];
            let family = parts.into_iter().find(|name| kinds.contains_key(name)).expect(line);
            assert!(samples.entry(family).or_default().insert(series), "twice: {line}");
        }
    }
    for (name, kind) in &kinds {
        assert!(name.starts_with("stride_"), "{name}");
        assert_eq!(*kind == "counter", name.ends_with("_total"), "{name} is a {kind}");
    }
    for (name, series) in &samples {
        assert!(series.len() <= MOST_SERIES, "{name} has {} series", series.len());
        if kinds[name] == "histogram" {
            for end in ["_bucket{le=\"+Inf\"}", "_sum", "_count"] {
                assert!(series.contains(format!("{name}{end}").as_str()), "{name}{end} is missing");
            }
        }
    }
    samples.len()
}

/// The name of a histogram's family.
fn family(name: &str) -> &str {
    ["_bucket", "_sum", "_count"].iter().find_map(|end| name.strip_suffix(end)).unwrap_or(name)
}

/// `promtool check metrics` has nothing to say about a text.
pub(crate) fn check_with_promtool(text: &str) {
    let promtool =
        Command::new("promtool").args(["check", "metrics"]).stdin(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let mut promtool = match promtool {
        Ok(promtool) => promtool,
        Err(_) => return fixtures::skip("no promtool here: install Debian's package `prometheus`"),
    };
    promtool.stdin.take().expect("a pipe").write_all(text.as_bytes()).expect("promtool reads");
    let said = promtool.wait_with_output().expect("promtool ends");
    assert!(said.status.success() && said.stderr.is_empty(), "{}\n{text}", String::from_utf8_lossy(&said.stderr));
}

#[test]
fn a_broken_text_is_refused() {
    let whole = "# HELP stride_a_total A.\n# TYPE stride_a_total counter\nstride_a_total 1\n";
    assert_eq!(check(whole), 1);
    for (broken, with) in [
        ("counter", "gauge"),
        ("stride_a_total 1\n", "stride_a_total one\n"),
        ("# HELP stride_a_total A.\n", ""),
        ("stride_a_total 1\n", "stride_a_total 1\nstride_a_total 2\n"),
        ("stride_a_total 1\n", "stride_b 1\n"),
    ] {
        let text = whole.replace(broken, with);
        assert!(std::panic::catch_unwind(|| check(&text)).is_err(), "{text}");
    }
}
