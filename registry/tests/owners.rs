//! Tests of owners of models and runs: registration, and the view of a group.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{artifact, open, result, version};
use protocol::{ArtifactKind, Digest, Group, ModelName, Owner};
use registry::{QueryError, RunListQuery, RunOrder, RunPage, Store, Write, WriteError};
use serde_json::json;

fn owner(name: &str, project: Option<&str>, admin: bool) -> Owner {
    Owner { name: name.into(), project: project.map(str::to_owned), promotes: true, admin }
}

fn model(store: &Store, content: &str) -> Digest {
    artifact(store.blobs(), ArtifactKind::Model, content)
}

fn own(model: &str, owner: Owner) -> Write {
    Write::ModelOwner { model: model.into(), owner }
}

#[tokio::test]
async fn a_model_is_its_owners_to_add_to() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let made = |n: u64| model(&store, &n.to_string());
    let (motion, speech) = (owner("alice", Some("motion"), false), owner("bob", Some("speech"), false));
    store.write(vec![own("walks", motion.clone()), version("walks", made(1), 0.3)]).await.unwrap();
    store
        .write(vec![own("walks", owner("anna", Some("motion"), false)), version("walks", made(2), 0.2)])
        .await
        .unwrap();
    // A model without an owner belongs to the store.
    store.write(vec![version("imported", made(3), 0.1)]).await.unwrap();
    for (name, who) in [("walks", &speech), ("walks", &owner("alice", None, false)), ("imported", &motion)] {
        let refused = store.write(vec![own(name, who.clone()), version(name, made(4), 0.0)]).await.unwrap_err();
        assert!(matches!(&refused, WriteError::Conflict(why) if why.contains("another owner")), "{name}: {refused}");
    }
    assert_eq!(store.versions(&ModelName::new("walks")).await.unwrap().len(), 2, "nothing was registered");
    for name in ["walks", "imported"] {
        store.write(vec![own(name, owner("root", None, true)), version(name, made(5), 0.0)]).await.unwrap();
    }
    let owners = store.model_owners(None).await.unwrap();
    assert_eq!(owners.get(&ModelName::new("walks")), Some(&motion.group()), "it keeps its owner");
    assert_eq!(owners.len(), 1, "{owners:?}");
}

#[tokio::test]
async fn a_group_sees_its_own_models_and_names_no_others() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let (motion, speech) = (owner("alice", Some("motion"), false), owner("bob", Some("speech"), false));
    let output = model(&store, "walks");
    store
        .write(vec![own("walks", motion.clone()), result("key", output), version("walks", output, 0.3)])
        .await
        .unwrap();
    store.write(vec![own("talks", speech.clone()), version("talks", model(&store, "talks"), 0.3)]).await.unwrap();
    // The stage that made it belongs to another project.
    store.write(vec![Write::RunOwner { run: "r".into(), owner: motion.group() }]).await.unwrap();

    let seen = store.seen_by(&speech.group());
    let names =
        |models: Vec<registry::Model>| models.into_iter().map(|model| model.model.to_string()).collect::<Vec<_>>();
    assert_eq!(names(seen.models().await.unwrap()), ["talks"]);
    assert_eq!(names(store.models().await.unwrap()), ["talks", "walks"]);
    for reference in ["walks:1", "walks@best", "none:1"] {
        let unknown = seen.resolve(reference).await.unwrap_err();
        let QueryError::NotFound(why) = &unknown else { panic!("{unknown}") };
        assert!(why.ends_with("there are `talks`"), "{why}");
    }
    assert!(seen.versions(&ModelName::new("walks")).await.unwrap().is_empty());
    assert!(seen.history(&ModelName::new("walks"), None).await.unwrap().is_empty());
    let run = |nodes: Vec<registry::LineageNode>| nodes[0].run.clone();
    assert_eq!(run(seen.lineage(output).await.unwrap()), None);
    assert_eq!(run(store.seen_by(&motion.group()).lineage(output).await.unwrap()).as_deref(), Some("r"));
    assert_eq!(run(store.lineage(output).await.unwrap()).as_deref(), Some("r"));
}

#[tokio::test]
async fn an_ended_run_is_seen_by_its_group_and_forgotten_with_its_owner() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let group = Group::of("alice", None);
    for run in ["mine-1", "others-2", "nobodys-3"] {
        let write = Write::Run {
            run: run.into(),
            pipeline: json!({}),
            source: String::new(),
            state: "running".into(),
            idempotency_key: Some(format!("{run}-key")),
        };
        let view = json!({"stages": []}).to_string();
        let ended = Write::RunEnded { run: run.into(), state: "failed".into(), view: view.clone(), archive: view };
        store.write(vec![write, ended]).await.unwrap();
    }
    store.write(vec![Write::RunOwner { run: "mine-1".into(), owner: group.clone() }]).await.unwrap();
    store.write(vec![Write::RunOwner { run: "others-2".into(), owner: Group::of("bob", None) }]).await.unwrap();
    let seen = store.seen_by(&group);
    let names = |page: RunPage| page.rows.into_iter().map(|row| row.run.to_string()).collect::<Vec<_>>();
    let all = RunListQuery { limit: 10, order: RunOrder::Oldest, ..RunListQuery::default() };
    let of = |owner: &Group| RunListQuery { owner: Some(owner.clone()), ..all.clone() };
    assert_eq!(names(seen.run_list(&all).await.unwrap()), ["mine-1"]);
    assert_eq!(names(store.run_list(&all).await.unwrap()), ["mine-1", "others-2", "nobodys-3"]);
    assert_eq!(names(store.run_list(&of(&Group::of("bob", None))).await.unwrap()), ["others-2"]);
    assert!(names(seen.run_list(&of(&Group::of("bob", None))).await.unwrap()).is_empty(), "asked for by another");
    let found = RunListQuery { words: "OTHERS".into(), ..all.clone() };
    assert_eq!(
        (names(seen.run_list(&found).await.unwrap()).len(), names(store.run_list(&found).await.unwrap()).len()),
        (0, 1)
    );
    assert!(
        seen.ended(&"mine-1".into()).await.unwrap().is_some()
            && seen.ended(&"others-2".into()).await.unwrap().is_none()
    );
    assert!(seen.run(&"others-2".into()).await.unwrap().is_none());
    assert!(seen.run_by_key("others-2-key").await.unwrap().is_none());
    assert_eq!(seen.runs().await.unwrap().len(), 1);
    store.forget(&"mine-1".into()).await.unwrap();
    assert!(store.run_owners(&["mine-1".into()]).await.unwrap().is_empty());
    assert_eq!(names(store.run_list(&all).await.unwrap()), ["others-2", "nobodys-3"]);
}
