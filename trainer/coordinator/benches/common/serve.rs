//! A server for measurements from another process.

use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;

use access::Tokens;
use coordinator::{Allowances, Config, Coordinator};
use registry::{Holder, Store};

/// Calls a second of one token: a measurement is of calls, not of their limit.
const CALLS: u32 = 1_000_000;

/// Serves a store until standard input ends. Prints the server's address and a token with all scopes, each in a line.
pub(crate) async fn serve(dir: &Path) -> std::result::Result<(), Box<dyn std::error::Error + Send + Sync>> {
    coordinator::shell::raise_descriptor_limit();
    let store = Store::open(dir, Holder::this_process("serve")).await?;
    let config = Config {
        allowances: Allowances { calls: CALLS, ..Allowances::default() },
        ..Config::server(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), Tokens::default())
    };
    let handle = Coordinator::start(store, config).await?;
    let mut out = std::io::stdout();
    writeln!(out, "{}\n{}", handle.url(), handle.token().secret())?;
    out.flush()?;
    tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new())).await??;
    handle.shutdown().await;
    Ok(())
}
