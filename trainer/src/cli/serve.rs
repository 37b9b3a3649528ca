//! `trainer serve`: the coordinator as a server.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use access::{Scopes, TokenOptions, Tokens};
use clap::Args;
use coordinator::{Config, Coordinator};
use registry::{Holder, Store};
use tokio::signal::unix::{SignalKind, signal};

use super::allowance_args::AllowanceArgs;
use super::door::DoorArgs;
use crate::problem::{Problem, Result};
use crate::{client, print};

const TOKENS: &str = "\
A token file has a line `NAME SCOPES TOKEN` for each caller, such as `alice submit,promote` and what `openssl rand -hex 32`
prints. Scopes: read, submit, worker, promote, admin. `workers=nodes-*` behind the token limits the names of its workers.
A token alone, in a file or as --token, may do everything. Without any, one is made for this user at every start and lies
in the store's folder; beyond this machine a token is required.";

#[derive(Debug, Args)]
#[command(after_help = TOKENS)]
pub(crate) struct ServeArgs {
    /// Where to listen
    #[arg(long, env = "STRIDE_BIND", default_value_t = SocketAddr::from((Ipv4Addr::LOCALHOST, access::PORT)), value_name = "HOST:PORT")]
    bind: SocketAddr,
    #[command(flatten)]
    token: TokenOptions,
    #[command(flatten)]
    door: DoorArgs,
    /// Listen beyond this machine without TLS: anybody who sees the traffic has the tokens
    #[arg(long)]
    insecure: bool,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    #[command(flatten)]
    blobs: super::args::BlobArgs,
    #[command(flatten)]
    allowances: AllowanceArgs,
}

impl ServeArgs {
    fn config(&self) -> Result<Config> {
        let mut tokens = match &self.token.token_file {
            Some(path) => Tokens::read(path)?,
            None => Tokens::default(),
        };
        if let Some(token) = &self.token.token {
            tokens.add("admin", Scopes::all(), token);
        }
        let mut config = self.door.config(self.bind, tokens, self.insecure)?;
        self.allowances.set(&mut config);
        Ok(config)
    }
}

pub(crate) async fn serve(args: ServeArgs) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot listen for signals: {error}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    coordinator::shell::raise_descriptor_limit();
    let config = args.config()?;
    // Said before the store is made.
    config.check()?;
    let open = config.tokens.is_empty();
    let store = Store::open_with(&args.store, args.blobs.blobs.as_ref(), Holder::this_process("trainer serve")).await?;
    let handle = Coordinator::start(store.clone(), config).await?;
    let announced = client::announce(&store, &handle)?;
    let token = if open { format!(" --token-file {}", args.store.join("token").display()) } else { String::new() };
    let url = handle.url();
    print::note(&format!(
        "listening on {url} with the store {}\n  trainer worker join {url}{token}\n  trainer submit PIPELINE --server {url}{token}",
        args.store.display(),
    ));
    let failure = tokio::select! {
        _ = interrupt.recv() => None,
        _ = terminate.recv() => None,
        why = handle.failed() => Some(why),
    };
    drop(announced);
    // Workers keep training without us and re-attach to the next server.
    handle.shutdown().await;
    match failure {
        None => Ok(0),
        Some(why) => Err(Problem::coordinator_failed(why).hint(
            "what was acknowledged is stored: start the server again, and workers re-attach; please report this",
        )),
    }
}
