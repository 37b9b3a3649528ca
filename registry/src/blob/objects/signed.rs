//! Signed requests: a worker reads and writes objects itself and has no credentials.
//!
//! A signed put contains the blob's SHA-256 (`x-amz-checksum-sha256`) and `If-None-Match: *`. It stores the blob under a
//! name that belongs to one process and task, so that a worker which has no bytes learns nothing and names nothing. The
//! bucket's server computes the SHA-256, and its answer to a request for metadata says so (`attests`). Then it copies the
//! object to its final name. Other clouds compute no SHA-256, so their blobs are only read by signed requests.
//!
//! A copy of another's object would have the same SHA-256, and some servers make one if a put has a further header. So the
//! put also signs the name as metadata (`x-amz-meta-stride`), and that a copy keeps the metadata of its source.

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use object_store::Error;
use object_store::path::Path;
use object_store::signer::{HeaderName, HeaderValue, Method, SignedUrlOptions};
use protocol::Digest;
use protocol::proof::SignedRequest;

use super::remote::{LOCAL, Remote, innermost};

/// Validity of a signature. A request that began in time may take longer.
const VALID: Duration = Duration::from_secs(300);
/// Time limit of a request of this process by a signature.
const OWN: Duration = Duration::from_secs(10);

const CHECKSUM: HeaderName = HeaderName::from_static("x-amz-checksum-sha256");
const CHECKSUM_MODE: HeaderName = HeaderName::from_static("x-amz-checksum-mode");
/// The name that a signed put was made for, as metadata of the object.
const OWNER: HeaderName = HeaderName::from_static("x-amz-meta-stride");
const DIRECTIVE: HeaderName = HeaderName::from_static("x-amz-metadata-directive");
const IF_NONE_MATCH: HeaderName = HeaderName::from_static("if-none-match");

/// Bytes of the object that tests a signed put.
const TEST: &[u8] = b"Shows whether the server checks what a signed request stores.\n";

fn checksum(digest: Digest) -> String {
    STANDARD.encode(digest.as_bytes())
}

impl Remote {
    pub(super) fn sign_read(&self, path: &Path) -> Option<SignedRequest> {
        self.sign(Method::GET, path, &[])
    }

    pub(super) fn sign_write(&self, name: &str, digest: Digest) -> Option<SignedRequest> {
        let sum = checksum(digest);
        let signed = [(CHECKSUM, &*sum), (IF_NONE_MATCH, "*"), (OWNER, name), (DIRECTIVE, "COPY")];
        self.sign(Method::PUT, &self.arriving(name), &signed)
    }

    /// Returns `None` if the credentials in use cannot sign, for instance because they lack the permission.
    fn sign(&self, method: Method, path: &Path, headers: &[(HeaderName, &str)]) -> Option<SignedRequest> {
        let signer = self.signer.clone()?;
        let mut options = SignedUrlOptions::new();
        for (name, value) in headers {
            options = options.with_signed_header(name.clone(), HeaderValue::from_str(value).ok()?);
        }
        let wanted = path.clone();
        let signed = self.run(async move { signer.signed_url_opts(method, &wanted, VALID, &options).await });
        let headers = headers.iter().map(|(name, value)| (name.to_string(), (*value).to_owned())).collect();
        match signed {
            Ok(url) => Some(SignedRequest { url: url.into(), headers }),
            Err(error) => {
                tracing::debug!("no request for `{}` can be signed: {}", self.shown(path), innermost(&error));
                None
            }
        }
    }

    /// Returns true if the server reports that the object at `path` was put for `name` and that its bytes hash to `digest`.
    pub(super) fn attests(&self, path: &Path, name: &str, digest: Digest) -> bool {
        let Some(signed) = self.sign(Method::HEAD, path, &[(CHECKSUM_MODE, "ENABLED")]) else { return false };
        let answer = self.send(reqwest::Method::HEAD, &signed, &[]);
        let reported = |header: HeaderName| answer.as_ref()?.headers().get(header.as_str())?.to_str().ok();
        reported(CHECKSUM) == Some(&checksum(digest)) && reported(OWNER) == Some(name)
    }

    /// Returns true if the server stores what a signed request sends and reports its SHA-256. Asks it once.
    pub(super) fn takes_signed_puts(&self) -> bool {
        if !self.is_s3() || self.signer.is_none() {
            return false;
        }
        if let Some(takes) = self.takes_puts.get() {
            return *takes;
        }
        let (path, digest) = (self.path("SIGNED"), Digest::of(TEST));
        let sum = checksum(digest);
        let signed = self.sign(Method::PUT, &path, &[(CHECKSUM, &*sum), (OWNER, "test"), (DIRECTIVE, "COPY")]);
        // A server that does not answer is asked again later.
        let Some(put) = signed.and_then(|signed| self.send(reqwest::Method::PUT, &signed, TEST)) else { return false };
        let takes = put.status().is_success() && self.attests(&path, "test", digest);
        if self.takes_puts.set(takes).is_ok() {
            let way = if takes { "directly" } else { "through this server, because the bucket reports no SHA-256" };
            tracing::info!("workers write the blobs of `{}` {way}", self.url);
        }
        takes
    }

    /// Sends a signed request and returns its answer.
    fn send(&self, method: reqwest::Method, signed: &SignedRequest, body: &'static [u8]) -> Option<reqwest::Response> {
        let made = || reqwest::Client::builder().redirect(reqwest::redirect::Policy::none()).timeout(OWN).build().ok();
        let mut request = self.http.get_or_init(made).as_ref()?.request(method, &signed.url).body(body);
        for (name, value) in &signed.headers {
            request = request.header(name, value);
        }
        let local = |e: reqwest::Error| Error::Generic { store: LOCAL, source: e.without_url().into() };
        let sent = self.run(async move { request.send().await.map_err(local) });
        sent.inspect_err(|error| tracing::debug!("a signed request failed: {}", innermost(error))).ok()
    }
}
