//! Spans to a collector, by OTLP over HTTP.

use opentelemetry::trace::{
    SpanContext, SpanId, TraceContextExt as _, TraceFlags, TraceId, TraceState, TracerProvider as _,
};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{SdkTracerProvider, SpanLimits, Tracer};
use sha2::{Digest as _, Sha256};
use tracing::Subscriber;
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt as _};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::registry::LookupSpan;

/// The variables that switch traces on, by the specification of OpenTelemetry.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"];

/// The layer that reads spans of the target `spans`, and their sender. Both are missing where no variable names a collector.
pub(crate) fn layer<S>(service: &'static str, spans: &'static str) -> (Option<impl Layer<S>>, Option<SdkTracerProvider>)
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let provider = provider(service);
    let layer = provider.as_ref().map(|provider| {
        let layer: OpenTelemetryLayer<S, Tracer> = tracing_opentelemetry::layer().with_tracer(provider.tracer(service));
        // Lines within a span become its events.
        let wanted = Targets::new().with_default(LevelFilter::INFO).with_target(spans, LevelFilter::TRACE);
        layer.with_location(false).with_threads(false).with_tracked_inactivity(false).with_filter(wanted)
    });
    (layer, provider)
}

fn provider(service: &'static str) -> Option<SdkTracerProvider> {
    ENDPOINTS.iter().find(|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))?;
    access::tls::install_provider();
    match SpanExporter::builder().with_http().build() {
        Ok(exporter) => {
            let mut resource = Resource::builder();
            if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
                resource = resource.with_service_name(service);
            }
            let resource = resource.with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
            let builder = SdkTracerProvider::builder().with_resource(resource.build());
            Some(builder.with_span_limits(SpanLimits::default()).with_batch_exporter(exporter).build())
        }
        Err(error) => {
            // Before the subscriber, so not by a log line.
            let _ = std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("no traces are sent: {error}\n"));
            None
        }
    }
}

/// Bytes that follow from a run alone, so that all workers agree on them.
pub(crate) fn join_run(span: &tracing::Span, run: &str) {
    let digest: [u8; 32] = Sha256::digest(run.as_bytes()).into();
    let mut trace = [0; 16];
    let mut parent = [0; 8];
    trace.copy_from_slice(&digest[..16]);
    parent.copy_from_slice(&digest[16..24]);
    let trace = TraceId::from_bytes(trace);
    let parent = SpanId::from_bytes(parent);
    let context = SpanContext::new(trace, parent, TraceFlags::SAMPLED, true, TraceState::default());
    // An error means that this span is not sent.
    let _ = span.set_parent(Context::new().with_remote_span_context(context));
}
