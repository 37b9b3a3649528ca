//! Every refusal is a document of RFC 9457, from all parts of the server.

use access::Scope;
use coordinator::shell::routes;
use protocol::message::{CODES, Problem};

use super::page::http::{Answer, call, token, with_tokens};

fn problem(answer: &Answer, what: &str) -> Problem {
    assert_eq!(answer.header("content-type"), Problem::CONTENT_TYPE, "{what}: {}", answer.status);
    let problem: Problem = serde_json::from_slice(&answer.body).unwrap();
    assert_eq!(problem.status, answer.status, "{what}");
    let title = CODES.iter().find(|(code, _)| *code == problem.code).map(|(_, title)| *title);
    assert_eq!(
        (title, problem.kind),
        (Some(problem.title.as_str()), format!("urn:stride:problem:{}", problem.code)),
        "{what}"
    );
    assert!(!problem.detail.is_empty(), "{what}");
    Problem { kind: String::new(), ..problem }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_refusal_is_a_problem_with_a_code() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    let admin = format!("Bearer {}", token(Scope::Admin));
    let reader = format!("Bearer {}", token(Scope::Read));
    let json = ("content-type", "application/json");
    // Method, path, headers; status, code, words of the answer.
    type Case<'a> = (&'a str, &'a str, Vec<(&'a str, &'a str)>, u16, &'a str, &'a str);
    let cases: Vec<Case<'_>> = vec![
        ("GET", "/v1/runs?limit=abc", vec![], 400, "invalid", "limit"),
        ("GET", "/v1/runs?limit=0", vec![], 400, "invalid", "`limit` is 0"),
        ("GET", "/v1/runs?limit=1&limit=2", vec![], 400, "invalid", "limit"),
        ("GET", "/v1/runs?limti=1", vec![], 400, "invalid", "limti"),
        ("GET", "/v1/runs?state=broken", vec![], 400, "invalid", "`broken`"),
        ("GET", "/v1/runs?after=x", vec![], 400, "invalid", "`after` is `x`"),
        ("GET", "/v1/runs?sort=best", vec![], 400, "invalid", "best"),
        ("GET", "/v1/history?after=1e9", vec![], 400, "invalid", "after"),
        ("GET", "/v1/metrics?run=r&x=years", vec![], 400, "invalid", "`x`"),
        ("GET", "/v1/runs/%ff", vec![], 400, "invalid", "the path does not read"),
        ("GET", "/v1/runs/none", vec![], 404, "not-found", "`none`"),
        ("GET", "/v1/none", vec![], 404, "not-found", "no such path"),
        ("DELETE", "/v1/runs", vec![], 405, "method", "`DELETE`"),
        ("POST", "/v1/runs/r/none", vec![], 404, "not-found", "`none`"),
        ("POST", "/v1/runs", vec![("content-type", "text/plain")], 415, "invalid", "application/json"),
        ("POST", "/v1/runs", vec![json], 400, "invalid", "cannot parse the body"),
        ("GET", "/v1/runs", vec![("authorization", "Bearer x")], 401, "unauthorized", "token"),
        ("POST", "/v1/runs", vec![("authorization", &reader)], 403, "forbidden", "`the-read`"),
        ("GET", "/v1/runs", vec![("origin", "http://evil.example")], 403, "origin", "evil.example"),
        ("GET", "/v1/runs", vec![("host", "evil.example")], 421, "host", "evil.example"),
        ("GET", "/page/none/none.js", vec![], 404, "not-found", "no such file"),
    ];
    for (method, path, mut headers, status, code, words) in cases {
        if !headers.iter().any(|(name, _)| *name == "authorization") {
            headers.push(("authorization", &admin));
        }
        let answer = call(address, method, path, &headers);
        let what = format!("{method} {path}");
        assert_eq!(answer.status, status, "{what}");
        let problem = problem(&answer, &what);
        assert_eq!(problem.code, code, "{what}");
        assert!(problem.detail.contains(words), "{what}: {}", problem.detail);
    }
    // Each path names the methods that it has.
    for route in routes() {
        let path = route.path.replace(['{', '}'], "");
        let answer = call(address, "PATCH", &path, &[("authorization", &admin)]);
        assert_eq!(answer.status, 405, "{path}");
        assert_eq!(problem(&answer, &path).code, "method", "{path}");
        assert!(
            answer.header("allow").split(',').any(|method| method.trim() == route.method),
            "{path}: {:?}",
            answer.headers
        );
    }
    handle.shutdown().await;
}
