//! `trainer serve`: the coordinator as a server.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;
use coordinator::{Config, Coordinator};
use registry::{Holder, Store};
use tokio::signal::unix::{SignalKind, signal};

use crate::print;
use crate::problem::{Problem, Result};

#[derive(Debug, Args)]
pub(crate) struct ServeArgs {
    /// Where to listen
    #[arg(long, env = "STRIDE_BIND", default_value = "127.0.0.1:7700", value_name = "HOST:PORT")]
    bind: SocketAddr,
    /// What callers must bear; required beyond this machine
    #[arg(long, env = "STRIDE_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
}

pub(crate) async fn serve(args: ServeArgs) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot listen for signals: {error}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    if !args.bind.ip().is_loopback() && args.token.as_deref().is_none_or(str::is_empty) {
        // Said before the store is made.
        return Err(coordinator::StartError::NoToken(args.bind).into());
    }
    let store = Store::open(&args.store, Holder::this_process("trainer serve")).await?;
    let handle = Coordinator::start(store.clone(), Config::server(args.bind, args.token)).await?;
    store.set_address(handle.url()).map_err(|error| Problem::usage(format!("cannot write to the store: {error}")))?;
    print::note(&format!(
        "listening on {} with the store {}\n  trainer worker join {}\n  trainer submit PIPELINE --server {}",
        handle.url(),
        args.store.display(),
        handle.url(),
        handle.url()
    ));
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    // Workers keep training without us and re-attach to the next server.
    handle.shutdown().await;
    Ok(0)
}
