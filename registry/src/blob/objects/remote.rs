//! Requests to an object store, and the messages when they fail.

use std::fmt;
use std::sync::mpsc;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use checkpoint::BlobError;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey, S3ConditionalPut};
use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
use object_store::multipart::MultipartStore;
use object_store::path::Path;
use object_store::signer::Signer;
use object_store::{BackoffConfig, ClientConfigKey, Error, ObjectStore, ObjectStoreExt as _, RetryConfig};
use protocol::Digest;
use tokio::runtime::Runtime;

use super::health::Health;
use crate::blob::Problem;

/// Time limit of a connection attempt. A machine in the same building answers in milliseconds.
const CONNECT: &str = "5 seconds";
/// Time limit of one request: a part of 8 MiB at 1.1 Mbit/s.
const REQUEST: &str = "60 seconds";
/// Total time of retries of one request; then the caller gets the error.
const RETRY: Duration = Duration::from_secs(30);
const RETRIES: usize = 6;

/// Marks an error as local instead of the object store's.
pub(super) const LOCAL: &str = "local";

/// Supported object stores, with the schemes of their URLs and the sources of their credentials.
const KINDS: [Kind; 3] = [
    Kind {
        scheme: "s3",
        credentials: "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_REGION",
        endpoint: "AWS_ENDPOINT_URL",
        http: "AWS_ALLOW_HTTP=true",
    },
    Kind {
        scheme: "gs",
        credentials: "GOOGLE_SERVICE_ACCOUNT or GOOGLE_APPLICATION_CREDENTIALS",
        endpoint: "GOOGLE_BASE_URL",
        http: "GOOGLE_ALLOW_HTTP=true",
    },
    Kind {
        scheme: "az",
        credentials: "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
        endpoint: "AZURE_ENDPOINT",
        http: "AZURE_ALLOW_HTTP=true",
    },
];

#[derive(Debug)]
struct Kind {
    scheme: &'static str,
    credentials: &'static str,
    endpoint: &'static str,
    http: &'static str,
}

/// Splits `SCHEME://BUCKET/PREFIX` into bucket and prefix, or describes the mistake.
fn split(url: &str) -> Result<(&'static Kind, &str, &str), String> {
    let of = |kind: &'static Kind| Some((kind, url.strip_prefix(kind.scheme)?.strip_prefix("://")?));
    let (kind, rest) =
        KINDS.iter().find_map(of).ok_or("expected s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX")?;
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    if bucket.contains(['@', ':']) {
        return Err(format!("credentials do not belong in the URL; set {} in the environment", kind.credentials));
    }
    if bucket.is_empty() || !bucket.chars().all(plain) {
        return Err(format!("`{bucket}` is not a bucket name"));
    }
    let prefix = prefix.trim_end_matches('/');
    let is_folder = |name: &str| !name.is_empty() && name.chars().all(plain) && !matches!(name, "." | "..");
    if !prefix.is_empty() && !prefix.split('/').all(is_folder) {
        return Err(format!(
            "`{prefix}` is not a prefix: expected names of letters, digits, `-`, `_` and `.` with `/` between them"
        ));
    }
    Ok((kind, bucket, prefix))
}

/// Checks a URL that should name a place in an object store.
pub(in crate::blob) fn check_url(url: &str) -> Result<(), String> {
    split(url).map(|_| ())
}

/// An object store that names its uploads in parts, so that another process can end them.
pub trait Bucket: ObjectStore + MultipartStore {}

impl<S: ObjectStore + MultipartStore> Bucket for S {}

/// A prefix in a bucket, with its own runtime for requests, so that calls may block in any thread.
pub struct Remote {
    pub(super) url: String,
    kind: &'static Kind,
    bucket: String,
    prefix: String,
    pub(super) store: Arc<dyn Bucket>,
    /// Signs requests of workers.
    pub(super) signer: Option<Arc<dyn Signer>>,
    /// The client of signed requests of this process. `None` inside if it cannot be made.
    pub(super) http: OnceLock<Option<reqwest::Client>>,
    /// Answer of the server to a first signed put; `None` before it.
    pub(super) takes_puts: OnceLock<bool>,
    health: Health,
    /// `None` only while it is dropped.
    runtime: Option<Runtime>,
}

impl fmt::Debug for Remote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Remote").field("url", &self.url).finish_non_exhaustive()
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Some threads that may drop this must not block; no request is under way by now.
            runtime.shutdown_background();
        }
    }
}

impl Remote {
    /// Connects to the place that `url` names. Credentials and endpoint come from the environment variables of the
    /// clouds' own tools. Sends no request yet.
    pub fn connect(url: &str) -> Result<Self, BlobError> {
        let wrong =
            |message: &dyn fmt::Display| BlobError::Storage(format!("`{url}` is not a place for blobs: {message}"));
        let (kind, bucket, _) = split(url).map_err(|e| wrong(&e))?;
        // rustls needs a default provider; one that is already installed works as well.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let retry = RetryConfig {
            backoff: BackoffConfig { max_backoff: Duration::from_secs(5), ..BackoffConfig::default() },
            max_retries: RETRIES,
            retry_timeout: RETRY,
        };
        let connect = ClientConfigKey::ConnectTimeout;
        let request = ClientConfigKey::Timeout;
        match kind.scheme {
            "s3" => Self::signing(
                url,
                AmazonS3Builder::from_env()
                    .with_bucket_name(bucket)
                    .with_conditional_put(S3ConditionalPut::ETagMatch)
                    .with_config(AmazonS3ConfigKey::Client(connect), CONNECT)
                    .with_config(AmazonS3ConfigKey::Client(request), REQUEST)
                    .with_retry(retry)
                    .build()
                    .map_err(|e| wrong(&e))?,
            ),
            "gs" => Self::signing(
                url,
                GoogleCloudStorageBuilder::from_env()
                    .with_bucket_name(bucket)
                    .with_config(GoogleConfigKey::Client(connect), CONNECT)
                    .with_config(GoogleConfigKey::Client(request), REQUEST)
                    .with_retry(retry)
                    .build()
                    .map_err(|e| wrong(&e))?,
            ),
            _ => Self::signing(
                url,
                MicrosoftAzureBuilder::from_env()
                    .with_container_name(bucket)
                    .with_config(AzureConfigKey::Client(connect), CONNECT)
                    .with_config(AzureConfigKey::Client(request), REQUEST)
                    .with_retry(retry)
                    .build()
                    .map_err(|e| wrong(&e))?,
            ),
        }
    }

    /// Makes the place that `url` names, over an object store that signs requests.
    pub fn signing(url: &str, store: impl Bucket + Signer) -> Result<Self, BlobError> {
        let store = Arc::new(store);
        let mut remote = Self::over(url, Arc::clone(&store) as Arc<dyn Bucket>)?;
        remote.signer = Some(store);
        Ok(remote)
    }

    /// Makes the place that `url` names, over any object store.
    pub fn over(url: &str, store: Arc<dyn Bucket>) -> Result<Self, BlobError> {
        let wrong =
            |message: &dyn fmt::Display| BlobError::Storage(format!("`{url}` is not a place for blobs: {message}"));
        let (kind, bucket, prefix) = split(url).map_err(|e| wrong(&e))?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("blobs")
            .enable_all()
            .build()
            .map_err(|e| BlobError::Unavailable(format!("cannot start threads for requests to `{url}`: {e}")))?;
        Ok(Self {
            url: url.trim_end_matches('/').to_owned(),
            kind,
            bucket: bucket.to_owned(),
            prefix: prefix.to_owned(),
            store,
            signer: None,
            http: OnceLock::new(),
            takes_puts: OnceLock::new(),
            health: Health::default(),
            runtime: Some(runtime),
        })
    }

    /// Returns the path of the object `rest` under the prefix.
    pub(super) fn path(&self, rest: &str) -> Path {
        if self.prefix.is_empty() { Path::from(rest) } else { Path::from(format!("{}/{rest}", self.prefix)) }
    }

    pub(super) fn blob(&self, digest: Digest) -> Path {
        let hex = digest.hex();
        self.path(&format!("sha256/{}/{}", &hex[..2], &hex[2..]))
    }

    /// Returns the path of a blob that a signed request stores.
    pub(super) fn arriving(&self, name: &str) -> Path {
        self.path(&format!("arriving/{name}"))
    }

    /// Deletes an object, if it exists.
    pub(super) fn forget(&self, path: &Path) -> Result<(), BlobError> {
        let store = Arc::clone(&self.store);
        let wanted = path.clone();
        match self.wait(async move { store.delete(&wanted).await }) {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(e) => Err(self.error("remove", path, &e)),
        }
    }

    /// Returns the digest in an object's name, if the object is a blob.
    pub(super) fn digest(&self, location: &Path) -> Option<Digest> {
        let rest = location.as_ref().strip_prefix(self.path("sha256").as_ref())?.strip_prefix('/')?;
        let (start, end) = rest.split_once('/')?;
        (start.len() == 2).then(|| format!("sha256:{start}{end}").parse().ok()).flatten()
    }

    /// Formats an object's path for users.
    pub(super) fn shown(&self, path: &Path) -> String {
        format!("{}://{}/{path}", self.kind.scheme, self.bucket)
    }

    /// Returns the current problem of the store, if there is one.
    pub(super) fn problem(&self) -> Option<Problem> {
        let problem = self.health.problem()?;
        Some(Problem { what: format!("`{}` cannot be used: {}", self.url, problem.what), ..problem })
    }

    /// Runs a short request and blocks until it ends. May be called in any thread.
    pub(super) fn wait<T: Send + 'static>(
        &self,
        request: impl Future<Output = Result<T, Error>> + Send + 'static,
    ) -> Result<T, Error> {
        let _waiting = self.health.begin();
        self.wait_long(request)
    }

    /// Runs a request that may take minutes because it moves many bytes. Blocks until it ends.
    pub(super) fn wait_long<T: Send + 'static>(
        &self,
        request: impl Future<Output = Result<T, Error>> + Send + 'static,
    ) -> Result<T, Error> {
        let ended = self.run(request);
        match &ended {
            Ok(_) | Err(Error::NotFound { .. } | Error::AlreadyExists { .. } | Error::Precondition { .. }) => {
                self.health.answered();
            }
            // A local error, not one of the store.
            Err(Error::Generic { store: LOCAL, .. }) => {}
            Err(e) => self.health.failed(|| shortened(&innermost(e))),
        }
        ended
    }

    /// Returns true for buckets of the S3 protocol.
    pub(super) fn is_s3(&self) -> bool {
        self.kind.scheme == "s3"
    }

    /// Runs a request without recording its result as the health of the store, and blocks until it ends.
    pub(super) fn run<T: Send + 'static>(
        &self,
        request: impl Future<Output = Result<T, Error>> + Send + 'static,
    ) -> Result<T, Error> {
        let ended = || Error::Generic { store: LOCAL, source: "the request ended early".into() };
        let Some(runtime) = &self.runtime else { return Err(ended()) };
        let (answer, answered) = mpsc::sync_channel(1);
        runtime.spawn(async move {
            // The receiver below is still waiting, so sending cannot fail.
            let _ = answer.send(request.await);
        });
        answered.recv().map_err(|_| ended())?
    }

    /// Translates a failed request into a message with a remedy; `did` names the operation on the object at `path`.
    pub(super) fn error(&self, did: &str, path: &Path, e: &Error) -> BlobError {
        let text = innermost(e);
        let kind = self.kind;
        let bucket = &self.bucket;
        let what = format!("failed to {did} `{}`", self.shown(path));
        let mentions = |words: &[&str]| words.iter().any(|word| text.contains(word));
        if mentions(&["NoSuchBucket", "ContainerNotFound", "bucket does not exist"]) {
            let advice = "create it, or name another one with `--blobs`";
            return BlobError::Storage(format!("{what}: there is no bucket `{bucket}`; {advice}"));
        }
        if mentions(&["169.254.169.254", "metadata.google.internal", "MissingCredentials"]) {
            let set = kind.credentials;
            return BlobError::Storage(format!("{what}: there are no credentials in the environment; set {set}"));
        }
        if mentions(&["URL scheme is not allowed"]) {
            let endpoint = kind.endpoint;
            let http = kind.http;
            return BlobError::Storage(format!("{what}: {endpoint} is not https; use https, or set {http}"));
        }
        // A refused listing arrives as a generic error.
        let is_refusal = matches!(e, Error::PermissionDenied { .. } | Error::Unauthenticated { .. });
        if is_refusal
            || mentions(&["SignatureDoesNotMatch", "InvalidAccessKeyId", "AccessDenied", "AuthenticationFailed"])
        {
            return BlobError::Storage(format!(
                "{what}: access was refused ({}); check {}, and their permission to list, read, write and delete in `{}`",
                shortened(&text),
                kind.credentials,
                self.url
            ));
        }
        match e {
            Error::NotImplemented { .. } | Error::NotSupported { .. } => {
                BlobError::Storage(format!("{what}: the server does not support the request ({})", shortened(&text)))
            }
            _ => BlobError::Unreachable(format!(
                "{what}: {}; check the network and {}, and that the server runs",
                shortened(&text),
                kind.endpoint
            )),
        }
    }

    /// Error of a server that overwrites an object despite a condition.
    pub(super) fn no_conditions(&self, path: &Path) -> BlobError {
        BlobError::Storage(format!(
            "`{}` was overwritten despite `If-None-Match: *`: the server ignores conditions, so two stores could claim the \
             same blobs; use a server with conditional writes",
            self.shown(path)
        ))
    }
}

/// Formats an error with its causes, omitting repeated ones.
pub(super) fn innermost(error: &Error) -> String {
    let mut cause: &dyn std::error::Error = error;
    let mut text = error.to_string();
    while let Some(next) = cause.source() {
        cause = next;
        let said = cause.to_string();
        if !text.contains(&said) {
            text = format!("{text}: {said}");
        }
    }
    text
}

/// Formats a server's answer without XML, shortened to one line.
fn shortened(text: &str) -> String {
    let element = |name: &str| {
        let (_, rest) = text.split_once(&format!("<{name}>"))?;
        rest.split_once(&format!("</{name}>")).map(|(inner, _)| inner)
    };
    match (element("Code"), element("Message")) {
        (Some(code), Some(message)) => format!("{code}: {message}"),
        (Some(code), None) => code.to_owned(),
        _ => {
            let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
            if line.chars().count() <= 400 { line } else { line.chars().take(400).chain(['…']).collect() }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn places_read_and_what_is_wrong_with_others_is_said() {
        assert_eq!(split("s3://b/p/q/").map(|(_, b, p)| (b, p)).unwrap(), ("b", "p/q"));
        assert_eq!(split("gs://b").map(|(k, b, p)| (k.scheme, b, p)).unwrap(), ("gs", "b", ""));
        for (url, says) in [
            ("http://b/p", "expected s3://"),
            ("s3:/b/p", "expected s3://"),
            ("s3:///p", "not a bucket name"),
            ("s3://key:secret@b/p", "AWS_ACCESS_KEY_ID"),
            ("az://c@account/p", "AZURE_STORAGE_ACCOUNT_NAME"),
            ("s3://b/../p", "not a prefix"),
            ("s3://b/p//q", "not a prefix"),
            ("s3://b/p?x=1", "not a prefix"),
        ] {
            let wrong = split(url).err().unwrap();
            assert!(wrong.contains(says), "{url}: {wrong}");
        }
    }

    #[test]
    fn answers_are_said_without_their_xml() {
        let xml = "status 403: <Error><Code>InvalidAccessKeyId</Code><Message>no such key</Message></Error>";
        assert_eq!(shortened(xml), "InvalidAccessKeyId: no such key");
        assert_eq!(shortened("a\n  b"), "a b");
        assert_eq!(shortened(&"x".repeat(1000)).chars().count(), 401);
    }
}
