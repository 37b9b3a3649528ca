//! Serves a store for measurements by other programs, without the training library, so that a release build takes minutes:
//! `cargo run --release -p coordinator --example serve -- STORE PIPELINE`.
//!
//! Prints three lines: the pipeline as JSON, the server's address, and a token with all scopes. Ends when its standard input ends.

#[path = "../benches/common/serve.rs"]
mod serve;

use std::io::Write as _;
use std::path::PathBuf;

#[tokio::main]
async fn main() -> std::result::Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let mut args = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(dir), Some(file)) = (args.next(), args.next()) else { return Err("usage: serve STORE PIPELINE".into()) };
    let text = std::fs::read_to_string(&file)?;
    let pipeline = pipeline::read(&file.to_string_lossy(), &text, &[]).map_err(|mistakes| mistakes.to_string())?;
    writeln!(std::io::stdout(), "{}", serde_json::to_string(&pipeline)?)?;
    serve::serve(&dir).await
}
