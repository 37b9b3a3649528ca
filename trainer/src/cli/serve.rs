//! `trainer serve`: the coordinator as a server.

use std::io::IsTerminal as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use access::{Scopes, Token, TokenOptions, Tokens};
use clap::Args;
use coordinator::shell::StreamOffer;
use coordinator::{Coordinator, Handle};
use registry::catalog::PostgresAddress;
use registry::{Holder, OpenError, PostgresCatalog, Store};
use tokio::signal::unix::{SignalKind, signal};
use webhooks::Hooks;

use super::allowance_args::AllowanceArgs;
use super::endpoint_args::EndpointArgs;
use crate::client;
use crate::report::print;
use crate::report::problem::{Problem, Result};

/// Pause before a stand-by tries to lead again.
const AGAIN: Duration = Duration::from_millis(100);

const TOKENS: &str = "\
A token file has one line `NAME SCOPES TOKEN` per caller, such as `alice submit,promote` and the output of
`openssl rand -hex 32`. Scopes: read, submit, worker, promote, launch, admin. After the token, a line may have
`workers=nodes-*`, `project=NAME` and `expires=2026-12-31`. With a line `protect ALIAS=NAME,NAME`, only these callers
may move the alias. On SIGHUP, the server reads this file and the certificate again. A single token, in a file or as
--token, has all scopes. Without a token, the server creates one for this user at every start, in the store's folder.
Other machines need a token.

Example:
  trainer serve --bind 127.0.0.1:7700";

#[derive(Debug, Args)]
#[command(after_help = TOKENS)]
pub(crate) struct ServeArgs {
    /// Address to listen on
    #[arg(long, env = "STRIDE_BIND", default_value_t = SocketAddr::from((Ipv4Addr::LOCALHOST, access::PORT)), value_name = "ADDRESS:PORT", value_parser = address)]
    bind: SocketAddr,
    #[command(flatten)]
    token: TokenOptions,
    #[command(flatten)]
    endpoint: EndpointArgs,
    /// Listen beyond this machine without TLS: everyone who sees the traffic can read the tokens
    #[arg(long)]
    insecure: bool,
    /// The store's folder
    #[arg(long, env = "STRIDE_STORE", default_value = ".stride", value_name = "DIR")]
    store: PathBuf,
    /// File with lines `NAME URL SECRET [on=failed,stalled] [project=NAME]`: addresses that get a signed message when a
    /// run ends or stands still and when a model is promoted
    #[arg(long, env = "STRIDE_WEBHOOKS", value_name = "FILE")]
    webhooks: Option<PathBuf>,
    /// Address of a `trainer generate --stream --listen`: the page offers its stream to those who may submit
    #[arg(long, env = "STRIDE_STREAM", value_name = "ws://HOST:PORT", requires = "stream_token_file")]
    stream: Option<String>,
    /// File with a token of that process, closed to other users
    #[arg(long, env = "STRIDE_STREAM_TOKEN_FILE", value_name = "FILE")]
    stream_token_file: Option<PathBuf>,
    /// Keep the catalog in PostgreSQL: postgres://USER@HOST/DATABASE?password-file=FILE. Several servers may have it, each
    /// with its own `--store`; one leads. The blobs must be in a place that all reach (`--blobs`)
    #[arg(long, env = "STRIDE_CATALOG", value_name = "ADDRESS", hide_env_values = true)]
    catalog: Option<PostgresAddress>,
    /// Wait while another server leads the catalog, and take over when it is lost
    #[arg(long, requires = "catalog")]
    stand_by: bool,
    #[command(flatten)]
    blobs: super::args::BlobArgs,
    #[command(flatten)]
    allowances: AllowanceArgs,
}

/// Parses an address of this machine with a port.
fn address(text: &str) -> std::result::Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        "expected an address and a port, such as 127.0.0.1:7700, or 0.0.0.0:7700 for all networks of this machine"
            .to_owned()
    })
}

impl ServeArgs {
    fn tokens(&self) -> Result<Tokens> {
        let mut tokens = match &self.token.token_file {
            Some(path) => Tokens::read(path)?,
            None => Tokens::default(),
        };
        if let Some(token) = &self.token.token {
            tokens.add("admin", Scopes::all(), token);
        }
        Ok(tokens)
    }

    /// Opens the store. A stand-by first waits until it can lead.
    async fn open(&self) -> Result<Store> {
        let (blobs, holder) = (self.blobs.blobs.as_ref(), || Holder::this_process("trainer serve"));
        let Some(address) = &self.catalog else { return Ok(Store::open_with(&self.store, blobs, holder()).await?) };
        let catalog = PostgresCatalog::from(address.clone());
        if self.stand_by {
            print::note(&format!("standing by for {address}"));
        }
        loop {
            if self.stand_by {
                Store::wait_to_lead(&catalog).await;
            }
            match Store::open_on(&catalog, &self.store, blobs, holder()).await {
                // Another stand-by was faster, or the leader stalls inside a transaction.
                Err(OpenError::Busy { .. }) if self.stand_by => tokio::time::sleep(AGAIN).await,
                opened => return Ok(opened?),
            }
        }
    }

    fn hooks(&self) -> Result<Hooks> {
        Ok(self.webhooks.as_deref().map(Hooks::read).transpose()?.unwrap_or_default())
    }

    /// The stream that the page offers.
    fn stream(&self) -> Result<Option<StreamOffer>> {
        let Some((url, file)) = self.stream.as_deref().zip(self.stream_token_file.as_deref()) else { return Ok(None) };
        StreamOffer::new(url, Token::from_file(file)?).map(Some).map_err(Problem::usage)
    }

    /// Reads the files of the certificate, tokens and webhooks again. A file with an error changes nothing.
    async fn reload(&self, handle: &Handle) {
        if let Err(error) = handle.reload_certificate() {
            print::note(&format!("keeping the earlier certificate: {error}"));
        }
        match self.hooks() {
            Ok(hooks) => {
                if let Err(error) = handle.replace_hooks(hooks).await {
                    print::note(&format!("keeping the earlier webhooks: {error}"));
                }
            }
            Err(problem) => print::note(&format!("keeping the earlier webhooks: {:#}", problem.error)),
        }
        match self.tokens() {
            Ok(tokens) => {
                handle.replace_tokens(tokens);
                print::note("read the token file again");
            }
            Err(problem) => print::note(&format!("keeping the earlier tokens: {:#}", problem.error)),
        }
    }
}

/// The address of the page. The key that signs this user in is shown on a terminal alone: a log may have other readers.
fn page(handle: &Handle, url: &str) -> String {
    if std::io::stderr().is_terminal() { handle.page_link_at(url) } else { format!("{url}/ (sign in with a token)") }
}

pub(crate) async fn serve(args: ServeArgs) -> Result<u8> {
    let failed = |error| Problem::failed(format!("cannot listen for signals: {error}"));
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(failed)?;
    coordinator::shell::raise_descriptor_limit();
    let mut config = args.endpoint.config(args.bind, args.tokens()?, args.insecure)?;
    args.allowances.set(&mut config);
    config.hooks = args.hooks()?;
    config.stream = args.stream()?;
    // Report errors before the store is created.
    config.check()?;
    let open = config.tokens.is_empty();
    let store = tokio::select! {
        store = args.open() => store?,
        _ = interrupt.recv() => return Ok(0),
        _ = terminate.recv() => return Ok(0),
    };
    let handle = Coordinator::start(store.clone(), config).await?;
    let announced = client::announce(&store, &handle)?;
    let token = if open { args.store.join("token").display().to_string() } else { "FILE".to_owned() };
    let url = args.endpoint.url(&handle);
    print::note(&format!(
        "listening on {} with the store {}\n  page {}\n  trainer worker join {url} --token-file {token}\n  trainer submit PIPELINE --server {url} --token-file {token}",
        handle.url(),
        args.store.display(),
        page(&handle, &url),
    ));
    let failure = loop {
        tokio::select! {
            _ = interrupt.recv() => break None,
            _ = terminate.recv() => break None,
            _ = hangup.recv() => args.reload(&handle).await,
            why = handle.failed() => break Some(why),
        }
    };
    drop(announced);
    // Workers continue training and connect to the next server.
    handle.shutdown().await;
    match failure {
        None => Ok(0),
        Some(why) => Err(Problem::coordinator_failed(why)
            .hint("acknowledged work is stored: start the server again, and workers reconnect; please report this")),
    }
}
