//! Random requests with each kind of valid token. None changes another owner's data or reveals its text.
//!
//! Sends 10,000 requests per token (20 s), or `STRIDE_FUZZ_REQUESTS`, and a tenth of them over HTTP/2; `STRIDE_FUZZ_SEED` varies them. Some requests
//! guess the name of a run, which the answer may repeat. Only answers to requests without the text are therefore
//! searched for it.

use coordinator::shell::routes;
use serde_json::{Value, json};

use crate::front::Protocol;

use super::lab::{CANARY, KINDS, Kind, Lab, Project, TestResult, pipeline, submission};

/// Over HTTP/2, one request for so many over HTTP/1.1: the routes behind both are the same.
const OVER_HTTP2: u64 = 10;

/// Source: the SplitMix64 algorithm.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        usize::try_from(self.next() % bound as u64).unwrap()
    }

    fn pick<'a>(&mut self, from: &[&'a str]) -> &'a str {
        from[self.below(from.len())]
    }
}

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().map_or(default, |text| text.parse().unwrap())
}

struct Request {
    method: &'static str,
    path: String,
    body: String,
}

fn path(lab: &Lab, random: &mut Random, template: &str) -> String {
    let [motion, speech] = Project::ALL.map(|project| lab.runs[&project].to_string());
    let [walks, talks] = Project::ALL.map(|project| lab.artifacts[&project].to_string());
    let runs = [motion.as_str(), speech.as_str(), "speech-00000000-1", "..", "%2e%2e", "a%2fb", "%00", "@last"];
    let zeros = "sha256:00".repeat(4);
    let digests = [talks.as_str(), "sha256:0", zeros.as_str(), "x", &walks[..20]];
    let queries = ["", "?limit=0", "?limit=4294967295&after=-1", "?stage=vae", "?stage=%27--", "?limit=-1", "?x"];
    let foreign = format!("?run={motion}&run={speech}&key=&buckets=1");
    let queries = [&queries[..], &[foreign.as_str()]].concat();
    let actions = ["pause", "resume", "cancel", "delete", "Pause", ""];
    let path = template.replace("{run}", random.pick(&runs)).replace("{digest}", random.pick(&digests));
    let path =
        path.replace("{action}", random.pick(&actions)).replace("{worker}", random.pick(&["a", "b", "..", "node"]));
    format!("{path}{}", random.pick(&queries))
}

fn command(random: &mut Random) -> Value {
    let [walks, talks] = Project::ALL.map(Project::model);
    let model = random.pick(&[walks.as_str(), talks.as_str(), "none", "", "*", "zq%"]).to_owned();
    let reference =
        format!("{model}{}", random.pick(&["", ":1", ":2", "@prod", "@staging", "@best", "@latest", ":0", "@@"]));
    let alias = random.pick(&["prod", "staging", "new", "best", "", "../x"]);
    let style = random.pick(&["text", "markdown", "latex", "x"]);
    match random.below(13) {
        0 => json!({"command": "list"}),
        1 => json!({"command": "show", "reference": reference}),
        2 => json!({"command": "history", "model": model, "alias": random.pick(&["prod", "none"])}),
        3 => json!({"command": "promote", "reference": reference, "to": alias, "require": [], "reason": "fuzz"}),
        4 => json!({"command": "rollback", "model": model, "alias": alias, "to": random.below(4), "reason": "fuzz"}),
        5 => {
            json!({"command": "compare", "left": reference, "right": random.pick(&["talks:1", "talks"]), "style": style})
        }
        6 => {
            json!({"command": "leaderboard", "of": random.pick(&["humanml3d", "kit", "talks", model.as_str()]), "published": true, "style": style})
        }
        7 => json!({"command": "lineage", "reference": reference}),
        8 => json!({"command": random.pick(&["fsck", "audit", "list "]), "limit": 10}),
        9 => json!({"command": "gc", "dry_run": random.below(2) == 0, "grace_minutes": 0}),
        10 => json!({"command": "forget", "run": model}),
        11 => json!({"command": "forget", "ended_before": i64::MAX}),
        _ => json!({"command": "forget", "leftovers_before": i64::MAX}),
    }
}

fn body(random: &mut Random, template: &str, submissions: &mut usize) -> TestResult<String> {
    if random.below(4) == 0 {
        return Ok(random.pick(&["", "?", "{}", "[]", "null", "{\"command\": 1}", "\u{0}"]).to_owned());
    }
    Ok(match template {
        "/v1/registry" => command(random).to_string(),
        "/v1/runs" if *submissions > 0 && random.below(4) == 0 => {
            *submissions -= 1;
            let mut submit = submission(&pipeline(Project::Speech))?;
            submit.idempotency_key = Some(random.pick(&["once", "twice"]).to_owned());
            // Another owner's version, or a guess.
            let version = format!("{CANARY}-walks:1");
            let vae = random.pick(&["vae", "talks:1", version.as_str()]);
            let more = format!("  more: {{kind: train.mld, vae: {vae}}}\n");
            let text = pipeline(Project::Speech) + &more;
            if let Ok(other) = submission(&text) {
                submit.pipeline = other.pipeline;
            }
            serde_json::to_string(&submit)?
        }
        _ => {
            let grant = json!({"task": "speech-1/vae", "attempt": 1, "fence": random.below(9), "worker": "a", "incarnation": 1});
            json!({"worker": "a", "grant": grant, "rows": [], "lines": [], "first": 0, "incarnation": random.below(3), "doing": [], "ready": [], "version": 0}).to_string()
        }
    })
}

/// Projects whose data this token may not change; the others are not compared.
fn others(kind: &Kind) -> Vec<Project> {
    let is_other = |project: &Project| !kind.controls.contains(project) && !kind.moves_prod.contains(project);
    Project::ALL.into_iter().filter(is_other).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_request_changes_or_shows_what_is_anothers() -> TestResult {
    try_requests(Protocol::Http1, number("STRIDE_FUZZ_REQUESTS", 10_000)).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_request_over_http2_changes_or_shows_what_is_anothers() -> TestResult {
    try_requests(Protocol::Http2, number("STRIDE_FUZZ_REQUESTS", 10_000) / OVER_HTTP2).await
}

async fn try_requests(protocol: Protocol, requests: u64) -> TestResult {
    let lab = Lab::over(protocol).await?;
    let seed = number("STRIDE_FUZZ_SEED", 1);
    // Other tests vary the bodies of worker calls. Here a worker's token tries all calls, and only it may use these.
    let routes = routes();
    let (mut answers, mut searched, begun) = (0, 0, std::time::Instant::now());
    let names = Project::ALL.map(|project| lab.runs[&project].to_string());
    for kind in KINDS.iter().filter(|kind| !others(kind).is_empty()) {
        let mut random = Random(seed ^ (kind.name.len() as u64) ^ (u64::from(kind.name.as_bytes()[0]) << 8));
        let (mut submissions, mut done) = (10, 0);
        let mut before = Vec::new();
        for project in others(kind) {
            before.push((project, lab.settled(project).await?));
        }
        for _ in 0..requests {
            let route = &routes[random.below(routes.len())];
            if route.method == "PUT"
                || route.path.ends_with("/gone")
                || (kind.name == "node" && route.path == "/v1/workers/{worker}/poll")
            {
                continue;
            }
            let request = Request {
                method: route.method,
                path: match route.path {
                    // A stream without an end would be waited for.
                    "/v1/events" => {
                        format!("/v1/events?lasts=0&after=0&run={}", random.pick(&names.each_ref().map(String::as_str)))
                    }
                    template => path(&lab, &mut random, template),
                },
                body: body(&mut random, route.path, &mut submissions)?,
            };
            let (status, text) = lab.send(kind.name, request.method, &request.path, &request.body).await?;
            assert_ne!(status.as_u16(), 401, "{}", request.path);
            assert!(status.as_u16() < 500, "{} {} {}: {status} {text}", kind.name, request.path, request.body);
            answers += 1;
            done += usize::from(status.is_success());
            let sees = kind.sees.contains(&Project::Motion);
            if !sees && !request.path.contains(CANARY) && !request.body.contains(CANARY) {
                searched += 1;
                assert!(!text.contains(CANARY), "{} {} {}: {text}", kind.name, request.path, request.body);
            }
        }
        // Calls of workers need secrets, which `server/workers` guesses.
        assert!(done > 0 || kind.name == "node", "{}: no request did anything", kind.name);
        for (project, standing) in before {
            assert_eq!(lab.standing(project).await?, standing, "{} changed what is {project:?}'s", kind.name);
        }
    }
    println!("{answers} answers, {searched} searched for `{CANARY}`, {:.1?}", begun.elapsed());
    lab.handle.shutdown().await;
    Ok(())
}
