//! Tickets by which a page's browser enters a stream of another process.

use std::net::SocketAddr;

use access::{Scope, Scopes, Token, Tokens};
use axum::routing::get;
use coordinator::shell::{RouteServer, StreamOffer};
use coordinator::{Config, Handle};
use tokio::sync::watch;

use super::http::{call, start, token, tokens, with_tokens};

/// Asks for a ticket as the page of a signed-in user does.
fn ask(handle: &Handle, scope: Scope) -> super::http::Answer {
    let address = handle.address();
    let bearer = format!("Bearer {}", token(scope));
    let cookie = call(address, "POST", "/v1/session", &[("authorization", &bearer)]).cookie();
    let page = format!("http://{address}");
    call(address, "POST", "/v1/tickets", &[("cookie", &cookie), ("origin", &page), ("x-stride-page", "1")])
}

/// The subprotocols of an answer with a ticket, as a browser sends them.
fn protocols(answer: &super::http::Answer) -> String {
    let answer = answer.json();
    let both = answer["protocols"].as_array().unwrap().iter().map(|word| word.as_str().unwrap());
    both.collect::<Vec<_>>().join(", ")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_ticket_enters_a_stream_once_and_for_its_own_page() {
    let viewer = Token::random();
    let mut table = Tokens::default();
    table.add("another", Scopes::of(&[Scope::Read]), &Token::random());
    table.add("viewer", Scopes::of(&[Scope::Read]), &viewer);
    let here = SocketAddr::from(([127, 0, 0, 1], 0));
    let streams = RouteServer::bind(&Config::server(here, table)).await.unwrap();
    let (address, (stop, stopped)) = (streams.address(), watch::channel(false));
    let serving = tokio::spawn(streams.serve("/v1/stream", &[Scope::Read], get(|| async { "entered" }), stopped));

    let dir = tempfile::tempdir().unwrap();
    let offer = StreamOffer::new(&format!("ws://{address}"), viewer).unwrap();
    let config = Config { tokens: tokens(), stream: Some(offer), ..Config::embedded() };
    let handle = start(dir.path(), config).await;
    let page = format!("http://{}", handle.address());
    let enter = |origin: &str, protocols: &str| {
        let headers = [("origin", origin), ("sec-websocket-protocol", protocols)];
        call(address, "GET", "/v1/stream", &headers).status
    };

    assert_eq!(ask(&handle, Scope::Read).status, 403, "a stream computes, as a draw does");
    let given = ask(&handle, Scope::Submit);
    assert_eq!((given.status, given.json()["url"].as_str()), (200, Some(format!("ws://{address}/v1/stream").as_str())));
    let good = protocols(&given);
    assert_eq!(enter(&page, "stride-stream"), 403, "without a ticket a page of elsewhere is refused");
    assert_eq!(enter("http://evil.example", &good), 403, "the ticket of another page");
    assert_eq!(enter(&page, &good.replace("stride-ticket.1", "stride-ticket.2")), 403, "its time was changed");
    assert_eq!(call(address, "GET", "/v1/stream", &[("sec-websocket-protocol", &good)]).status, 401, "no page");
    assert_eq!(enter(&page, &good), 200);
    assert_eq!(enter(&page, &good), 401, "once");
    assert_eq!(enter(&page, &protocols(&ask(&handle, Scope::Submit))), 200, "another one");

    // Only the document's scripts may open the stream, and no other address.
    let policy = call(handle.address(), "GET", "/", &[]);
    let policy = policy.header("content-security-policy");
    assert!(policy.contains(&format!("connect-src 'self' ws://{address};")), "{policy}");
    handle.shutdown().await;
    stop.send_replace(true);
    serving.await.unwrap();

    let handle = with_tokens(dir.path()).await;
    assert_eq!(ask(&handle, Scope::Submit).status, 404, "no stream is offered");
    let policy = call(handle.address(), "GET", "/", &[]);
    assert!(policy.header("content-security-policy").contains("connect-src 'self';"));
    handle.shutdown().await;
}
