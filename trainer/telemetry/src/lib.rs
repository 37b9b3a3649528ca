//! Log lines and traces of a process: lines to standard error and, with the feature `otel`, spans to the
//! collector that the standard variables of OpenTelemetry name.
//!
//! Spans have the target [`SPANS`] at the level `TRACE`, so that no line shows them unless `RUST_LOG` asks for it. A
//! span that is not sent costs one comparison.

#[cfg(feature = "otel")]
mod export;

use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::{SubscriberInitExt as _, TryInitError};
use tracing_subscriber::{EnvFilter, Layer as _, fmt, registry};

/// Target of all spans: requests of the server, tasks and stages of a worker.
pub const SPANS: &str = "spans";

/// A library that logs each certificate that it refuses. Our own errors name the cause.
const QUIET: &str = "rustls_platform_verifier";

/// Sends the last spans when it is dropped.
#[derive(Debug, Default)]
#[must_use]
pub struct Traces {
    #[cfg(feature = "otel")]
    provider: Option<opentelemetry_sdk::trace::SdkTracerProvider>,
}

/// Logs to standard error what `RUST_LOG` or else `filter` lets through, and begins to send spans of `service`.
///
/// A log line that cannot be written is dropped. Otherwise the subscriber would report that error, fail again, and panic.
///
/// # Errors
/// Another subscriber is set already.
pub fn init(service: &'static str, filter: &str, ansi: bool) -> Result<Traces, TryInitError> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(format!("{filter},{QUIET}=off")));
    let lines = fmt::layer().with_writer(std::io::stderr).with_ansi(ansi).log_internal_errors(false);
    let lines = registry().with(lines.with_filter(filter));
    #[cfg(feature = "otel")]
    {
        let (layer, provider) = export::layer(service, SPANS);
        lines.with(layer).try_init()?;
        Ok(Traces { provider })
    }
    #[cfg(not(feature = "otel"))]
    {
        let _ = service;
        lines.try_init()?;
        Ok(Traces::default())
    }
}

/// Puts a span into the trace of a run, which all workers share. Has no effect without the feature `otel`.
pub fn join_run(span: &tracing::Span, run: &str) {
    #[cfg(feature = "otel")]
    export::join_run(span, run);
    #[cfg(not(feature = "otel"))]
    let _ = (span, run);
}

#[cfg(feature = "otel")]
impl Drop for Traces {
    fn drop(&mut self) {
        // A collector that does not answer must not keep a process that ends.
        if let Some(provider) = &self.provider
            && let Err(error) = provider.shutdown_with_timeout(std::time::Duration::from_secs(2))
        {
            tracing::debug!(%error, "the last spans were not sent");
        }
    }
}
