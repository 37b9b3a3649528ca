//! Sessions: what buys one, what it lets a browser do, and what ends it.

use std::net::SocketAddr;

use access::{Scope, Scopes, Tokens};
use coordinator::Config;

use super::http::{Answer, call, start, token, tokens, with_tokens};

fn buy(address: SocketAddr, word: &str) -> Answer {
    call(address, "POST", "/v1/session", &[("authorization", word)])
}

fn bearer(scope: Scope) -> String {
    format!("Bearer {}", token(scope))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_buys_a_cookie_with_its_own_rights() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    let bought = buy(address, &bearer(Scope::Read));
    assert_eq!(bought.status, 200);
    let given = bought.header("set-cookie");
    for part in
        [&format!("stride-{}=", address.port()), "; HttpOnly", "; SameSite=Strict", "; Path=/", "; Max-Age=43200"]
    {
        assert!(given.contains(part), "{given}");
    }
    assert!(!given.contains("Secure") && !given.contains(&token(Scope::Read)), "{given}");
    let cookie = bought.cookie();
    let with = [("cookie", cookie.as_str())];
    let who = call(address, "GET", "/v1/session", &with).json();
    assert_eq!((&who["name"], &who["scopes"]), (&"the-read".into(), &serde_json::json!(["read"])));
    assert!(who["until_ms"].as_u64() > who["now_ms"].as_u64());
    assert_eq!(call(address, "GET", "/v1/runs", &with).status, 200);
    // A header that is there counts alone.
    assert_eq!(
        call(address, "GET", "/v1/runs", &[with[0], ("authorization", "Bearer nothing-of-the-kind")]).status,
        401
    );

    let page = format!("http://{address}");
    let write = [with[0], ("origin", page.as_str()), ("x-stride-page", "1")];
    assert_eq!(call(address, "POST", "/v1/runs", &write).status, 403, "it may only read");
    assert_eq!(buy(address, &bearer(Scope::Worker)).status, 403, "there is nothing for it to see");
    for wrong in ["Bearer nothing-of-the-kind", "Key nothing-of-the-kind", "Basic dG9rZW4=", ""] {
        assert_eq!(buy(address, wrong).status, 401, "{wrong}");
    }
    assert_eq!(call(address, "GET", "/v1/session", &[("cookie", &cookie[..cookie.len() - 1])]).status, 401);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cookie_changes_something_for_our_own_page_alone() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    let (cookie, page) = (buy(address, &bearer(Scope::Submit)).cookie(), format!("http://{address}"));
    let (cookie, origin, header) = (("cookie", cookie.as_str()), ("origin", page.as_str()), ("x-stride-page", "1"));
    let control = |headers: &[(&str, &str)]| call(address, "POST", "/v1/runs/none-1/cancel", headers);
    assert_eq!(control(&[cookie, origin, header]).status, 404, "it is let in, and there is no such run");
    for refused in [
        vec![cookie],
        vec![cookie, origin],
        vec![cookie, header],
        vec![cookie, header, ("origin", "http://evil.example")],
        vec![cookie, header, ("origin", "null")],
        // Another server of the same machine is the same site to a browser.
        vec![cookie, header, ("origin", "http://127.0.0.1:1")],
        vec![cookie, origin, header, ("sec-fetch-site", "same-site")],
    ] {
        let answer = control(&refused);
        assert_eq!((answer.status, answer.json()["code"].as_str()), (403, Some("origin")), "{refused:?}");
    }
    // Reading needs neither, but not for a page of elsewhere.
    for (from, status) in [("same-origin", 200), ("none", 200), ("same-site", 403), ("cross-site", 403)] {
        assert_eq!(call(address, "GET", "/v1/runs", &[cookie, ("sec-fetch-site", from)]).status, status, "{from}");
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_ends_with_its_token_or_when_it_is_signed_out_and_not_with_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let port = handle.address().port();
    let (read, submit) =
        (buy(handle.address(), &bearer(Scope::Read)).cookie(), buy(handle.address(), &bearer(Scope::Submit)).cookie());
    let own = buy(handle.address(), &format!("Bearer {}", handle.token().secret())).cookie();
    handle.shutdown().await;

    let config = Config { listen: SocketAddr::from(([127, 0, 0, 1], port)), tokens: tokens(), ..Config::embedded() };
    let handle = start(dir.path(), config).await;
    let address = handle.address();
    let status = |cookie: &str| call(address, "GET", "/v1/session", &[("cookie", cookie)]).status;
    assert_eq!([status(&read), status(&submit), status(&own)], [200; 3], "after a restart");
    let who = call(address, "GET", "/v1/session", &[("cookie", &own)]).json();
    assert_eq!(who["scopes"].as_array().map(Vec::len), Some(Scope::ALL.len()), "{who}");

    let page = format!("http://{address}");
    let out = call(address, "DELETE", "/v1/session", &[("cookie", &read), ("origin", &page), ("x-stride-page", "1")]);
    assert_eq!(out.status, 200);
    assert!(out.header("set-cookie").contains("Max-Age=0"), "{}", out.header("set-cookie"));
    assert_eq!([status(&read), status(&submit)], [401, 200], "of one alone");

    let mut fewer = Tokens::default();
    fewer.add("the-read", Scopes::of(&[Scope::Read]), &token(Scope::Read).parse().unwrap());
    handle.replace_tokens(fewer);
    assert_eq!([status(&submit), status(&own)], [401, 200], "its token was revoked");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_printed_link_signs_its_user_in_once_and_does_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let handle = with_tokens(dir.path()).await;
    let address = handle.address();
    let link = handle.page_link();
    let (url, key) = link.split_once("/#key=").unwrap();
    assert_eq!(url, handle.url());
    let word = format!("Key {key}");
    for (method, path) in [("GET", "/v1/runs"), ("GET", "/v1/session"), ("POST", "/v1/runs"), ("DELETE", "/v1/session")]
    {
        assert_eq!(call(address, method, path, &[("authorization", &word)]).status, 401, "{method} {path}");
    }
    assert_eq!(call(address, "GET", "/v1/runs", &[("authorization", &format!("Bearer {key}"))]).status, 401);
    let bought = buy(address, &word);
    assert_eq!(bought.json()["scopes"].as_array().map(Vec::len), Some(Scope::ALL.len()));
    assert_eq!(call(address, "GET", "/v1/runs", &[("cookie", &bought.cookie())]).status, 200);
    assert_eq!(buy(address, &word).status, 401, "once");
    handle.shutdown().await;
}
