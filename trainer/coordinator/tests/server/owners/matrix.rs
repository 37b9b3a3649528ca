//! Every client call with every kind of token, on its own, another owner's and protected objects. The calls come from
//! the server's table; a new call without a rule here fails the test. `server/access.rs` tests each call by scope,
//! without objects.

use coordinator::shell::routes;
use reqwest::StatusCode;
use serde_json::{Value, json};

use crate::front::Protocol;

use super::lab::{CANARY, KINDS, Kind, Lab, Project, TestResult, promote, rollback};

/// The expected result of a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Expected {
    /// The call succeeds.
    Done,
    /// The object seems not to exist.
    Hidden,
    /// The object is visible but may not be changed, or the scope is missing.
    Forbidden,
    /// The answer omits objects that are invisible to the caller.
    Filtered,
}

struct Case {
    method: &'static str,
    path: String,
    body: Value,
    expected: Expected,
}

fn reads(kind: &Kind, project: Project) -> Expected {
    if !kind.has("read") {
        Expected::Forbidden
    } else if kind.sees.contains(&project) {
        Expected::Done
    } else {
        Expected::Hidden
    }
}

fn changes(kind: &Kind, scope: &str, project: Project) -> Expected {
    match reads(kind, project) {
        _ if !kind.has(scope) => Expected::Forbidden,
        Expected::Done if kind.controls.contains(&project) => Expected::Done,
        Expected::Done => Expected::Forbidden,
        other => other,
    }
}

fn moves(kind: &Kind, alias: &str, project: Project) -> Expected {
    match changes(kind, "promote", project) {
        Expected::Hidden => Expected::Hidden,
        _ if alias == "prod" && kind.moves_prod.contains(&project) => Expected::Done,
        _ if alias == "prod" => Expected::Forbidden,
        other => other,
    }
}

/// The cases of a call; `None` for worker calls, which `server/workers` covers.
fn cases(lab: &Lab, kind: &Kind, method: &'static str, path: &'static str) -> Option<Vec<Case>> {
    let admin = if kind.has("admin") { Expected::Done } else { Expected::Forbidden };
    let filtered = if kind.has("read") { Expected::Filtered } else { Expected::Forbidden };
    let mut cases = Vec::new();
    let mut case = |path: String, body: Value, expected| cases.push(Case { method, path, body, expected });
    match (method, path) {
        // A session's calls change only the caller's own session; a token has none.
        ("GET" | "POST" | "DELETE", "/v1/session") => case(path.to_owned(), Value::Null, filtered),
        ("GET", "/metrics" | "/v1/runs" | "/v1/workers") => case(path.to_owned(), Value::Null, filtered),
        ("GET", "/v1/demand") => {
            let expected = if kind.has("launch") { Expected::Filtered } else { Expected::Forbidden };
            case(path.to_owned(), Value::Null, expected);
        }
        (
            "GET",
            "/v1/runs/{run}"
            | "/v1/runs/{run}/logs"
            | "/v1/runs/{run}/metrics"
            | "/v1/runs/{run}/settings"
            | "/v1/runs/{run}/checkpoints",
        ) => {
            for project in Project::ALL {
                case(path.replace("{run}", lab.runs[&project].as_str()), Value::Null, reads(kind, project));
            }
        }
        ("GET", "/v1/history") => {
            case(path.to_owned(), Value::Null, filtered);
            for project in Project::ALL {
                case(format!("{path}?run={}", lab.runs[&project]), Value::Null, reads(kind, project));
            }
        }
        ("GET", "/v1/events") => {
            case(format!("{path}?after=0&lasts=0"), Value::Null, filtered);
            for project in Project::ALL {
                case(format!("{path}?lasts=0&run={}", lab.runs[&project]), Value::Null, reads(kind, project));
            }
        }
        ("GET", "/v1/metrics") => {
            for project in Project::ALL {
                case(format!("{path}?run={}", lab.runs[&project]), Value::Null, reads(kind, project));
            }
        }
        ("POST", "/v1/runs/{run}/{action}") => {
            for project in Project::ALL {
                for action in ["pause", "resume"] {
                    let path = path.replace("{run}", lab.runs[&project].as_str()).replace("{action}", action);
                    case(path, Value::Null, changes(kind, "submit", project));
                }
            }
        }
        // Only a digest gives access to a blob, and the next test shows that other digests are not revealed. Reads of
        // workers are tested in `server/workers`.
        ("GET", "/v1/blobs/{digest}") if !kind.has("read") => return None,
        ("GET", "/v1/blobs/{digest}") => {
            for project in Project::ALL {
                case(path.replace("{digest}", &lab.artifacts[&project].to_string()), Value::Null, Expected::Done);
            }
        }
        ("GET", "/v1/storage") => case(path.to_owned(), Value::Null, admin),
        // No cases here: `promotion` tests submissions, `draws` tests draws, `registry` tests bundles, and `page` tests
        // tickets, which name no object.
        ("POST", "/v1/runs" | "/v1/draws" | "/v1/tickets" | "/v1/bundles") => {}
        ("POST", "/v1/registry") => {
            for project in Project::ALL {
                let model = project.model();
                let mut command = |command: Value, expected| case(path.to_owned(), command, expected);
                for reading in [
                    json!({"command": "show", "reference": model}),
                    json!({"command": "show", "reference": format!("{model}@prod")}),
                    json!({"command": "history", "model": model, "alias": null}),
                    json!({"command": "lineage", "reference": format!("{model}:1")}),
                    json!({"command": "compare", "left": format!("{model}:1"), "right": format!("{model}:2"), "style": "text"}),
                    json!({"command": "leaderboard", "of": model, "published": false, "style": "text"}),
                ] {
                    command(reading, reads(kind, project));
                }
                for alias in ["staging", "prod"] {
                    command(promote(&model, 2, alias), moves(kind, alias, project));
                    command(rollback(&model, 1, alias), moves(kind, alias, project));
                }
            }
            case(path.to_owned(), json!({"command": "list"}), filtered);
            case(
                path.to_owned(),
                json!({"command": "leaderboard", "of": "humanml3d", "published": false, "style": "text"}),
                filtered,
            );
            let run = &lab.runs[&Project::Motion];
            for command in [
                json!({"command": "fsck"}),
                json!({"command": "gc", "dry_run": true, "grace_minutes": null}),
                json!({"command": "forget", "ended_before": 0}),
                json!({"command": "forget", "leftovers_before": 0}),
                json!({"command": "audit", "limit": 5}),
            ] {
                case(path.to_owned(), command, admin);
            }
            // Refused for an active run even to the admin, and to others for lack of the scope.
            if admin == Expected::Forbidden {
                case(path.to_owned(), json!({"command": "forget", "run": run}), admin);
            }
        }
        ("POST", "/v1/workers" | "/v1/workers/{worker}/poll" | "/v1/workers/{worker}/gone")
        | ("POST", "/v1/metrics" | "/v1/logs" | "/v1/checkpoints" | "/v1/outcomes")
        | ("PUT", "/v1/blobs/{digest}")
        | ("GET", "/v1/blobs/{digest}/staged")
        | ("POST", "/v1/blobs/{digest}/sent") => return None,
        other => panic!("{other:?} is in the table of calls and has no rule here: say whose objects it names"),
    }
    Some(cases)
}

/// The result of a call, from its status or the code of a registry's answer.
fn came_of(status: StatusCode, answer: &Value) -> Expected {
    match (status.as_u16(), answer["error"]["code"].as_str()) {
        (200, Some("not-found")) | (404, _) => Expected::Hidden,
        // No command of this test fails because of its gates or order.
        (200, Some("conflict" | "invalid") | None) => Expected::Done,
        (403, _) => Expected::Forbidden,
        other => panic!("{other:?}: {answer}"),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_call_shows_and_changes_what_is_its_callers_own() -> TestResult {
    every_call(Protocol::Http1).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_call_over_http2_shows_and_changes_what_is_its_callers_own() -> TestResult {
    every_call(Protocol::Http2).await
}

async fn every_call(protocol: Protocol) -> TestResult {
    let lab = Lab::over(protocol).await?;
    let mut tried = [0; 4];
    for kind in &KINDS {
        for route in routes() {
            let Some(cases) = cases(&lab, kind, route.method, route.path) else { continue };
            for case in cases {
                let before = [lab.standing(Project::Motion).await?, lab.standing(Project::Speech).await?];
                let (status, answer) = lab.call(kind.name, case.method, &case.path, &case.body).await?;
                let shown = format!("{} as {}: {} {} {}", route.path, kind.name, case.path, case.body, answer);
                let wanted = if case.expected == Expected::Filtered { Expected::Done } else { case.expected };
                assert_eq!(came_of(status, &answer), wanted, "{shown}");
                tried[case.expected as usize] += 1;
                let named = format!("{} {}", case.path, case.body);
                let text = answer.to_string();
                if !kind.sees.contains(&Project::Motion) && !named.contains(CANARY) && !case.path.contains("/blobs/") {
                    assert!(!text.contains(CANARY), "{shown}");
                }
                if case.expected != Expected::Done {
                    let after = [lab.standing(Project::Motion).await?, lab.standing(Project::Speech).await?];
                    assert_eq!(after, before, "{shown}");
                }
            }
        }
    }
    let [done, hidden, forbidden, filtered] = tried;
    println!("{done} calls done, {hidden} hidden, {forbidden} forbidden, {filtered} filtered");
    assert!(tried.iter().all(|count| *count >= 10), "{tried:?}");
    lab.handle.shutdown().await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lists_hold_what_is_seen_and_all_of_it() -> TestResult {
    let lab = Lab::new().await?;
    for kind in KINDS.iter().filter(|kind| kind.has("read")) {
        let expect =
            |text: &dyn Fn(Project) -> String| kind.sees.iter().map(|project| text(*project)).collect::<Vec<_>>();
        let names = |list: &Value, field: &str| {
            let names =
                list.as_array().into_iter().flatten().map(|one| one[field].as_str().unwrap_or_default().to_owned());
            let mut names: Vec<String> = names.collect();
            names.sort_by_key(|name| !name.contains(CANARY));
            names
        };
        let runs = lab.call(kind.name, "GET", "/v1/runs", &Value::Null).await?.1;
        assert_eq!(names(&runs["items"], "run"), expect(&|project| lab.runs[&project].to_string()), "{}", kind.name);
        let models = lab.registry(kind.name, &json!({"command": "list"})).await?.1;
        assert_eq!(names(&models["data"]["models"], "model"), expect(&Project::model), "{}", kind.name);
        // The worker is visible to all; its task only to callers who see the run.
        let workers = lab.call(kind.name, "GET", "/v1/workers", &Value::Null).await?.1;
        assert_eq!(workers[0]["state"], "working", "{workers}");
        assert_eq!(workers[0]["task"].is_string(), kind.sees.contains(&Project::Motion), "{}: {workers}", kind.name);
        // Errors about an unknown model or alias do not list another owner's names.
        let unknown = lab.registry(kind.name, &json!({"command": "show", "reference": "none"})).await?.1;
        assert_eq!(
            unknown.to_string().contains(CANARY),
            kind.sees.contains(&Project::Motion),
            "{}: {unknown}",
            kind.name
        );
    }
    // An ended run still belongs to its owner.
    let run = &lab.runs[&Project::Motion];
    assert_eq!(
        lab.call("anna", "POST", &format!("/v1/runs/{run}/cancel"), &Value::Null).await?.0,
        200,
        "of its project"
    );
    for (name, status, count) in
        [("bob", 404, 1), ("anna", 200, 1), ("carol", 200, 2), ("rita", 404, 1), ("mona", 404, 0)]
    {
        let path = format!("/v1/runs/{run}");
        assert_eq!(lab.call(name, "GET", &path, &Value::Null).await?.0, status, "{name}");
        assert_eq!(lab.call(name, "GET", &format!("{path}/logs"), &Value::Null).await?.0, status, "{name}");
        let runs = lab.call(name, "GET", "/v1/runs", &Value::Null).await?.1;
        assert_eq!(runs["items"].as_array().map(Vec::len), Some(count), "{name}: {runs}");
    }
    for (name, status) in [("bob", 404), ("carol", 403), ("alice", 200)] {
        let resumed = lab.call(name, "POST", &format!("/v1/runs/{run}/resume"), &Value::Null).await?;
        assert_eq!(resumed.0, status, "{name}: {}", resumed.1);
    }
    lab.handle.shutdown().await;
    Ok(())
}
