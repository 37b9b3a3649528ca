//! The files of the page as they are served.

use super::http::{call, with_tokens};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_is_shown_without_a_token_and_may_load_nothing_from_elsewhere() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    for view in [
        "/",
        "/runs",
        "/runs/a-1",
        "/runs/a-1/vae",
        "/models",
        "/models/m",
        "/compare",
        "/draw",
        "/data",
        "/data/d",
        "/workers",
        "/store",
    ] {
        let answer = call(address, "GET", view, &[]);
        assert_eq!(answer.status, 200, "{view}");
        assert_eq!(answer.body, page::index().bytes, "{view}");
        assert_eq!(answer.header("content-type"), "text/html; charset=utf-8");
        assert_eq!(answer.header("cache-control"), "no-cache");
        let policy = answer.header("content-security-policy");
        for part in [
            "default-src 'none'",
            "script-src 'self'",
            "frame-ancestors 'none'",
            "form-action 'none'",
            "base-uri 'none'",
        ] {
            assert!(policy.contains(part), "{policy}");
        }
        assert!(!policy.contains("unsafe") && !policy.contains('*'), "{policy}");
        for (name, value) in [
            ("x-content-type-options", "nosniff"),
            ("referrer-policy", "no-referrer"),
            ("cross-origin-opener-policy", "same-origin"),
            ("cross-origin-resource-policy", "same-origin"),
        ] {
            assert_eq!(answer.header(name), value, "{view}: {name}");
        }
    }
    for other in ["/none", "/page/x/main.js", &format!("/page/{}/none.js", page::folder()), "/page/", "/workers/x"] {
        let answer = call(address, "GET", other, &[]);
        assert_eq!((answer.status, answer.json()["code"].as_str()), (404, Some("not-found")), "{other}");
    }
    // A name that was rebound to our address has no page either.
    assert_eq!(call(address, "GET", "/", &[("host", "evil.example")]).status, 421);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_is_loaded_once_and_compressed() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    for file in page::files() {
        let path = format!("/page/{}/{}", page::folder(), file.name);
        let plain = call(address, "GET", &path, &[]);
        assert_eq!((plain.status, &plain.body), (200, &file.bytes), "{path}");
        assert_eq!(plain.header("content-type"), file.kind);
        assert!(plain.header("cache-control").contains("immutable"), "{path}");
        assert_eq!(plain.header("content-encoding"), "");
        let small = call(address, "GET", &path, &[("accept-encoding", "br, gzip;q=0.9")]);
        assert_eq!((small.header("content-encoding"), &small.body), ("gzip", &file.gzip), "{path}");
        assert_eq!(small.header("vary"), "accept-encoding");
        let known = call(address, "GET", &path, &[("if-none-match", plain.header("etag"))]);
        assert_eq!((known.status, known.body.len()), (304, 0), "{path}");
        assert_eq!(call(address, "GET", &path, &[("if-none-match", "\"other\"")]).status, 200);
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_book_is_shown_without_a_token_and_runs_no_script() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    for file in book::files() {
        let answer = call(address, "GET", &format!("/book/{}", file.name), &[]);
        assert_eq!((answer.status, &answer.body), (200, &file.bytes), "{}", file.name);
        assert_eq!(answer.header("content-type"), file.kind);
        assert_eq!(answer.header("content-security-policy"), book::CONTENT_POLICY);
        assert_eq!(answer.header("x-content-type-options"), "nosniff");
    }
    let first = call(address, "GET", "/book/", &[]);
    assert_eq!((first.status, &first.body), (200, &book::find(book::FIRST).unwrap().bytes));
    let moved = call(address, "GET", "/book", &[]);
    assert_eq!((moved.status, moved.header("location")), (308, "/book/"));
    for other in ["/book/none.html", "/book/SUMMARY.md", "/book/../page/x/main.js"] {
        let answer = call(address, "GET", other, &[]);
        assert_eq!((answer.status, answer.json()["code"].as_str()), (404, Some("not-found")), "{other}");
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_call_answers_is_never_shown_as_a_page() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let bearer = format!("Bearer {}", handle.token().secret());
    for (path, headers) in [
        ("/v1/runs", vec![("authorization", bearer.as_str())]),
        ("/v1/runs", vec![]),
        ("/v1/health", vec![]),
        ("/none", vec![]),
    ] {
        let answer = call(handle.address(), "GET", path, &headers);
        assert_eq!(answer.header("x-content-type-options"), "nosniff", "{path}");
        assert_eq!(answer.header("cache-control"), "no-store", "{path}");
        assert!(answer.header("content-security-policy").ends_with("sandbox"), "{path}");
    }
    handle.shutdown().await;
}
