//! Changes to a store's files between two runs: an emptied database, and changed blobs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use cluster_tests::cluster::Cluster;
use cluster_tests::{Said, digests, states};
use serde_json::Value;

use crate::hardship::Random;

/// The strictest collection: data without a row is deleted, however new it is.
const COLLECT: [&str; 4] = ["registry", "gc", "--grace", "0"];
/// Number of damaged results.
const RESULTS: usize = 3;

/// Empties the database, then damages results of the finished run `view`. Checks that each damage is noticed, named and
/// recomputed, and that nothing else changes.
pub(crate) fn between_runs(
    cluster: &mut Cluster,
    random: &mut Random,
    view: &Value,
    submit: impl Fn(&Cluster) -> String,
    workers: &[&str],
) -> Result<(), String> {
    for worker in workers {
        cluster.kill(worker);
    }
    cluster.kill_server();
    emptied(cluster)?;

    let store = cluster.bench().store();
    let before = blobs(&store);
    let damaged = damage(random, view, &store)?;
    let fsck = cluster.bench().run(&["registry", "fsck"]);
    for (stage, path, how) in &damaged {
        println!("  a blob of stage {stage} {how}");
        let digest = digest(path);
        if fsck.code == Some(0) || !(fsck.stdout.contains(&digest) || fsck.stderr.contains(&digest)) {
            return Err(format!("fsck does not name {digest}, which {how}:\n{}{}", fsck.stdout, fsck.stderr));
        }
    }
    let gc = understood(cluster.bench().run(&COLLECT))?;
    println!("  gc beside the damage: exit code {:?}", gc.code);

    cluster.serve();
    for worker in workers {
        cluster.join(worker);
    }
    let run = submit(cluster);
    let again = cluster.wait_end(&run);
    if digests(&again) != digests(view) {
        return Err(format!("other digests after the damage:\n{:#?}\nexpected {:#?}", digests(&again), digests(view)));
    }
    let states = states(&again);
    let stages: BTreeSet<&str> = damaged.iter().map(|(stage, ..)| stage.as_str()).collect();
    if let Some(reused) = stages.iter().find(|stage| states[**stage] == "cached") {
        return Err(format!("stage {reused} was taken as it was, though a blob of it is damaged"));
    }
    let after = blobs(&store);
    if let Some((lost, _)) =
        before.iter().find(|(path, _)| view_needs(view, &store, path) && !after.contains_key(*path))
    {
        return Err(format!("{} is gone", lost.display()));
    }
    println!("  {} stages noticed their damage and were computed again with equal digests", stages.len());
    Ok(())
}

/// Checks that the command line itself was understood, so that a refusal counts.
fn understood(said: Said) -> Result<Said, String> {
    if said.stderr.contains("try '--help'") {
        Err(format!("the command line is wrong:\n{}", said.stderr))
    } else {
        Ok(said)
    }
}

/// Checks that with an empty database nothing is served, collected or reported as intact.
fn emptied(cluster: &Cluster) -> Result<(), String> {
    let (bench, store) = (cluster.bench(), cluster.bench().store());
    let before = blobs(&store);
    let kept = store.join("kept");
    fs::create_dir(&kept).map_err(|e| e.to_string())?;
    let files: Vec<PathBuf> = ["stride.db", "stride.db-wal", "stride.db-shm"].iter().map(|f| store.join(f)).collect();
    let copy = |path: &Path| kept.join(path.file_name().expect("a file"));
    for file in files.iter().filter(|file| file.exists()) {
        fs::copy(file, copy(file)).map_err(|e| e.to_string())?;
        fs::remove_file(file).map_err(|e| e.to_string())?;
    }
    fs::File::create(&files[0]).map_err(|e| e.to_string())?;
    for command in [&["registry", "fsck"][..], &COLLECT, &["serve", "--bind", "127.0.0.1:0"]] {
        let said = understood(bench.run(command))?;
        if said.code == Some(0) {
            return Err(format!("`{}` takes an emptied database for a store:\n{}", command.join(" "), said.stdout));
        }
        println!("  emptied database: `{}` exits with {:?}", command.join(" "), said.code);
    }
    if blobs(&store) != before {
        return Err("blobs changed beside an emptied database".into());
    }
    for file in &files {
        let _absent = fs::remove_file(file);
        if copy(file).exists() {
            fs::copy(copy(file), file).map_err(|e| e.to_string())?;
        }
    }
    fs::remove_dir_all(kept).map_err(|e| e.to_string())
}

/// All blobs with their lengths.
fn blobs(store: &Path) -> BTreeMap<PathBuf, u64> {
    let folders = fs::read_dir(store.join("blobs/sha256")).into_iter().flatten().flatten();
    let files = folders.flat_map(|folder| fs::read_dir(folder.path()).into_iter().flatten().flatten());
    files.map(|file| (file.path(), file.metadata().map_or(0, |m| m.len()))).collect()
}

fn digest(blob: &Path) -> String {
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    name(blob.parent().expect("a folder")) + &name(blob)
}

fn blob(store: &Path, digest: &str) -> Option<PathBuf> {
    let hex = digest.strip_prefix("sha256:")?;
    let path = store.join("blobs/sha256").join(hex.get(..2)?).join(hex.get(2..)?);
    path.exists().then_some(path)
}

/// The blobs of a stage's own outputs: manifests and the files that they list. Data that a manifest only mentions, such
/// as the model that a report measured, belongs to another stage.
fn own(outputs: &Value, store: &Path) -> BTreeSet<PathBuf> {
    let digests = outputs.as_object().into_iter().flat_map(|outputs| outputs.values()).filter_map(Value::as_str);
    let mut found = BTreeSet::new();
    for path in digests.filter_map(|digest| blob(store, digest)) {
        let manifest: Option<Value> = fs::read(&path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
        let files = manifest.as_ref().and_then(|manifest| manifest["files"].as_object()).into_iter().flatten();
        found.extend(files.filter_map(|(_, file)| blob(store, file["digest"].as_str()?)));
        found.insert(path);
    }
    found
}

/// The blobs that a value names, directly and through other blobs.
fn named(value: &Value, store: &Path, found: &mut BTreeSet<PathBuf>) {
    match value {
        Value::String(text) => {
            if let Some(path) = blob(store, text)
                && found.insert(path.clone())
                && let Some(manifest) = fs::read(&path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok())
            {
                // The lineage of a manifest belongs to other stages.
                named(&without_lineage(manifest), store, found);
            }
        }
        Value::Array(items) => items.iter().for_each(|item| named(item, store, found)),
        Value::Object(fields) => fields.values().for_each(|item| named(item, store, found)),
        _ => {}
    }
}

fn without_lineage(mut manifest: Value) -> Value {
    if let Some(fields) = manifest.as_object_mut() {
        fields.retain(|key, _| !matches!(key.as_str(), "inputs" | "parents" | "lineage"));
    }
    manifest
}

fn view_needs(view: &Value, store: &Path, path: &Path) -> bool {
    let mut all = BTreeSet::new();
    for outputs in digests(view).values() {
        named(outputs, store, &mut all);
    }
    all.contains(path)
}

/// Stage, blob and kind of damage.
type Damaged = (String, PathBuf, &'static str);

fn damage(random: &mut Random, view: &Value, store: &Path) -> Result<Vec<Damaged>, String> {
    let mut choices: Vec<(String, Vec<PathBuf>)> = Vec::new();
    let stages: Vec<(String, BTreeSet<PathBuf>)> =
        digests(view).into_iter().map(|(stage, outputs)| (stage, own(&outputs, store))).collect();
    // A model lists the files of its parts. Once a part is recomputed, its damage can no longer be noticed, so shared
    // blobs are excluded.
    let is_shared = |path: &PathBuf| stages.iter().filter(|(_, all)| all.contains(path)).count() > 1;
    for (stage, all) in &stages {
        let alone: Vec<PathBuf> = all.iter().filter(|path| !is_shared(path)).cloned().collect();
        if !alone.is_empty() {
            choices.push((stage.clone(), alone));
        }
    }
    let mut damaged: Vec<Damaged> = Vec::new();
    while damaged.len() < RESULTS && !choices.is_empty() {
        let (stage, blobs) = choices.swap_remove(random.index(choices.len()));
        let path = blobs[random.index(blobs.len())].clone();
        if damaged.iter().any(|(_, other, _)| *other == path) {
            continue;
        }
        let mut bytes = fs::read(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        let how = match random.index(3) {
            0 if !bytes.is_empty() => {
                let at = random.index(bytes.len());
                bytes[at] ^= 1 << random.index(8);
                "has a flipped bit"
            }
            1 => {
                bytes.truncate(bytes.len() / 2);
                "has lost its second half"
            }
            _ => {
                bytes.clear();
                "is empty"
            }
        };
        // Blobs are read-only, but the harness can replace them.
        fs::remove_file(&path)
            .and_then(|()| fs::write(&path, bytes))
            .map_err(|e| format!("{}: {e}", path.display()))?;
        damaged.push((stage, path, how));
    }
    Ok(damaged)
}
