//! The client's side of a connection to a server.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use reqwest::{Method, Request, RequestBuilder, Response, StatusCode, Url};

use crate::secret::{FileError, Token};
use crate::tls;

/// Shorter than the idle timeout of a server, so that no request meets a closed connection.
const IDLE: Duration = Duration::from_secs(10);

/// Errors that prevent a request from being sent.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// The address is not a server's.
    #[error("`{url}` is not the address of a server: {why}; expected `http://HOST:PORT` or `https://HOST:PORT`")]
    Url { url: String, why: String },
    /// A certificate is pinned, but the connection is not encrypted.
    #[error("`{0}` is not encrypted, so --ca has no effect; expected `https://`")]
    Plain(String),
    /// The token would be readable on the network.
    #[error("the token would cross the network to `{0}` unencrypted")]
    Unencrypted(String),
    /// A file with a secret or a certificate cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// The store is held by a process of another user.
    #[error("cannot read the token of the process that holds `{}`: {error}; run this as the user who started that process", dir.display())]
    Holder {
        /// The store's folder.
        dir: PathBuf,
        error: std::io::Error,
    },
    /// The HTTP client cannot be built.
    #[error("cannot create an HTTP client: {0}")]
    Client(String),
}

impl ConnectError {
    /// The user's next action, if there is a general one.
    pub fn advice(&self) -> Option<&str> {
        match self {
            Self::Unencrypted(_) => Some(
                "use `https://`, with --ca FILE if its certificate is your own; on a private or encrypted network, use --insecure",
            ),
            Self::File(file) => file.advice(),
            Self::Url { .. } | Self::Plain(_) | Self::Holder { .. } | Self::Client(_) => None,
        }
    }
}

/// Most addresses of a server: the leader's and those of its stand-bys.
const ADDRESSES: usize = 8;

/// A server's addresses, the token sent to it and the certificates trusted for it. With several addresses, one process
/// serves at a time: the leader. Clones share the address that answered last.
#[derive(Debug, Clone)]
pub struct Server {
    http: reqwest::Client,
    addresses: Arc<[Address]>,
    current: Arc<AtomicUsize>,
    token: Option<Token>,
}

#[derive(Debug)]
struct Address {
    url: Url,
    /// The URL as text, without a trailing slash.
    text: String,
}

impl Address {
    fn read(text: &str) -> Result<Self, ConnectError> {
        let wrong = |why: String| ConnectError::Url { url: text.to_owned(), why };
        let base = text.trim().trim_end_matches('/');
        let base = if base.contains("://") { base.to_owned() } else { format!("http://{base}") };
        let url = Url::parse(&base).map_err(|error| wrong(error.to_string()))?;
        if !matches!(url.scheme(), "http" | "https") || url.host().is_none() {
            return Err(wrong("unsupported scheme or missing host".to_owned()));
        }
        if !matches!(url.path(), "" | "/") || url.query().is_some() || !url.username().is_empty() {
            return Err(wrong("it must not have a path, a query or a user name".to_owned()));
        }
        Ok(Self { url, text: base })
    }

    fn is_local(&self) -> bool {
        let host = self.url.host_str().unwrap_or_default();
        let name = host.trim_end_matches('.');
        match host.trim_matches(['[', ']']).parse::<IpAddr>() {
            Ok(address) => address.is_loopback() || address.is_unspecified(),
            Err(_) => name.eq_ignore_ascii_case("localhost"),
        }
    }

    fn is_of(&self, url: &Url) -> bool {
        self.url.origin() == url.origin()
    }
}

impl Server {
    /// Creates a client of the server at `url`; `HOST:PORT` alone means `http://`. Several URLs are separated by commas.
    /// With `ca`, only certificates signed by it are trusted.
    ///
    /// # Errors
    /// [`ConnectError::Unencrypted`] if the token would leave this machine over plain HTTP; errors for invalid
    /// addresses and files.
    pub fn new(url: &str, token: Option<Token>, ca: Option<&Path>) -> Result<Self, ConnectError> {
        let server = Self::insecure(url, token, ca)?;
        let exposed = server.addresses.iter().find(|address| !address.is_local());
        match exposed.filter(|_| server.token.is_some() && !server.is_encrypted()) {
            Some(address) => Err(ConnectError::Unencrypted(address.text.clone())),
            None => Ok(server),
        }
    }

    /// Like [`Server::new`], but allows the token to cross a network unencrypted.
    pub fn insecure(url: &str, token: Option<Token>, ca: Option<&Path>) -> Result<Self, ConnectError> {
        let wrong = |why: String| ConnectError::Url { url: url.to_owned(), why };
        let addresses = url.split(',').map(Address::read).collect::<Result<Vec<_>, _>>()?;
        let scheme = addresses.first().map_or("http", |address| address.url.scheme());
        if addresses.iter().any(|address| address.url.scheme() != scheme) {
            return Err(wrong("some addresses are encrypted and others are not".to_owned()));
        }
        if addresses.len() > ADDRESSES {
            return Err(wrong(format!("it has {} addresses, at most {ADDRESSES} are allowed", addresses.len())));
        }
        let http = reqwest::Client::builder()
            .connect_timeout(Duration::from_secs(5))
            .pool_idle_timeout(IDLE)
            .tcp_nodelay(true)
            // Redirects are not followed: the server never sends any, and another host must not get the token.
            .redirect(reqwest::redirect::Policy::none());
        let http = match (scheme, ca) {
            ("https", Some(ca)) => {
                http.tls_backend_preconfigured(tls::pinned(ca).map_err(|error| error.named_by("--ca or STRIDE_CA"))?)
            }
            ("https", None) => {
                tls::install_provider();
                http
            }
            (_, Some(_)) => return Err(ConnectError::Plain(url.to_owned())),
            (_, None) => http.tls_backend_preconfigured(tls::nobody()),
        };
        let http = http.build().map_err(|error| ConnectError::Client(explain(&error)))?;
        Ok(Self { http, addresses: addresses.into(), current: Arc::default(), token })
    }

    fn current(&self) -> &Address {
        &self.addresses[self.current.load(Ordering::Relaxed) % self.addresses.len()]
    }

    /// The address that answered last, without a trailing slash.
    pub fn url(&self) -> &str {
        &self.current().text
    }

    /// All addresses, separated by commas.
    pub fn urls(&self) -> String {
        let texts: Vec<&str> = self.addresses.iter().map(|address| address.text.as_str()).collect();
        texts.join(",")
    }

    /// Returns true if the connection uses TLS.
    pub fn is_encrypted(&self) -> bool {
        self.current().url.scheme() == "https"
    }

    /// Returns true if all addresses are on this machine, so that no packet leaves it. The only name accepted is
    /// `localhost`.
    pub fn is_local(&self) -> bool {
        self.addresses.iter().all(Address::is_local)
    }

    /// Builds a request of `path`, which starts with a slash.
    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.url()));
        match &self.token {
            Some(token) => request.bearer_auth(token.secret()),
            None => request,
        }
    }

    /// Sends a request of [`Self::request`]. An address that accepts no connection is left for the next one, at once. One
    /// that breaks off, is silent or no longer leads is left too, but not asked again: the call may have been done there.
    pub async fn send(&self, request: RequestBuilder) -> reqwest::Result<Response> {
        let mut request = request.build()?;
        let mut more = self.addresses.len();
        loop {
            more -= 1;
            let url = request.url().clone();
            let spare = request.try_clone();
            let sent = self.http.execute(request).await;
            let is_left = match &sent {
                Ok(answer) => answer.status() == StatusCode::SERVICE_UNAVAILABLE,
                Err(_) => true,
            };
            if !is_left {
                return sent;
            }
            self.leave(&url);
            let refused = sent.as_ref().is_err_and(reqwest::Error::is_connect);
            match spare.filter(|_| refused && more > 0) {
                Some(spare) => request = self.moved(spare),
                None => return sent,
            }
        }
    }

    /// Turns to the address after the one of `url`, unless another call has done so.
    fn leave(&self, url: &Url) {
        let here = self.current.load(Ordering::Relaxed) % self.addresses.len();
        if self.addresses[here].is_of(url) {
            let next = (here + 1) % self.addresses.len();
            let _ = self.current.compare_exchange(here, next, Ordering::Relaxed, Ordering::Relaxed);
        }
    }

    /// The same request at the current address.
    fn moved(&self, mut request: Request) -> Request {
        let mut url = self.current().url.clone();
        url.set_path(request.url().path());
        url.set_query(request.url().query());
        *request.url_mut() = url;
        request
    }
}

/// The delay that an overloaded server asks for in `Retry-After`, limited to 1 to 60 seconds.
pub fn retry_after(answer: &reqwest::Response) -> Duration {
    let seconds =
        answer.headers().get(reqwest::header::RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    Duration::from_secs(seconds.unwrap_or(1).clamp(1, 60))
}

/// Advice if a server does not answer.
pub const UNREACHABLE: &str = "start it with `trainer serve`, or give its address with --server";

/// Errors of TLS by a part of their text, with advice.
const TLS_ADVICE: [(&str, &str); 4] = [
    ("InvalidContentType", "the server does not speak TLS there; try `http://`"),
    (
        "UnknownIssuer",
        "its certificate is not signed by a trusted authority; check the file of --ca, or name its certificate there",
    ),
    ("not valid for name", "its certificate is for another name; use a name in the certificate"),
    ("certificate expired", "renew the certificate, or correct the clock"),
];

/// Describes a failed request down to its root cause, with advice for TLS errors.
pub fn explain(error: &reqwest::Error) -> String {
    match describe(error) {
        (text, Some(advice)) => format!("{text}; {advice}"),
        (text, None) => text,
    }
}

/// The root cause of a failed request, and advice for TLS errors. `reqwest` alone says only "error sending request".
pub fn describe(error: &reqwest::Error) -> (String, Option<&'static str>) {
    let mut text = error.to_string();
    let mut root = text.clone();
    let mut cause: Option<&dyn std::error::Error> = std::error::Error::source(error);
    while let Some(error) = cause {
        let more = error.to_string();
        root.clone_from(&more);
        if !text.contains(&more) {
            text.push_str(": ");
            text.push_str(&more);
        }
        cause = error.source();
    }
    let advice = TLS_ADVICE.iter().find(|(sign, _)| text.contains(sign)).map(|(_, advice)| *advice);
    // The intermediate causes only repeat that connecting to this address failed.
    (if error.is_connect() { root } else { text }, advice)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_whole_and_nothing_more() {
        let url = |text: &str| Server::new(text, None, None).map(|server| server.url().to_owned());
        assert_eq!(url("127.0.0.1:7700/").unwrap(), "http://127.0.0.1:7700");
        assert_eq!(url("a:1, b:2").unwrap(), "http://a:1");
        assert_eq!(Server::new("a:1, b:2/", None, None).unwrap().urls(), "http://a:1,http://b:2");
        assert!(matches!(url("http://a:1,https://b:2"), Err(ConnectError::Url { .. })));
        assert_eq!(url("http://[::1]:7700").unwrap(), "http://[::1]:7700");
        for wrong in ["", "ftp://host", "http://host/path", "http://user@host:1", "http://host?x", "unix:///run"] {
            assert!(matches!(url(wrong), Err(ConnectError::Url { .. })), "{wrong}");
        }
    }

    #[test]
    fn a_token_leaves_this_machine_encrypted_or_by_wish() {
        let token: Token = "0123456789abcdef".parse().unwrap();
        let new = |url: &str| Server::new(url, Some(token.clone()), None);
        for far in [
            "10.0.0.7:7700",
            "http://stride.lab",
            "http://localhost.evil.example",
            "http://[2001:db8::1]:1",
            "http://127.0.0.1.nip.io",
        ] {
            let error = new(far).unwrap_err();
            assert!(matches!(error, ConnectError::Unencrypted(_)), "{far}: {error}");
            assert!(error.advice().unwrap().contains("--insecure"));
            assert!(!error.to_string().contains("0123"), "{error}");
            assert!(Server::new(far, None, None).is_ok(), "{far}: no token, nothing to protect");
            assert!(Server::insecure(far, Some(token.clone()), None).is_ok(), "{far}");
        }
        for near in
            ["127.0.0.1:7700", "http://127.8.9.1", "http://[::1]:7700", "http://LOCALHOST:1", "https://stride.lab"]
        {
            assert!(new(near).is_ok(), "{near}");
        }
    }

    #[test]
    fn a_pinned_certificate_is_never_ignored() {
        let error = Server::new("http://host:1", None, Some(Path::new("ca.pem"))).unwrap_err();
        assert!(error.to_string().contains("not encrypted"), "{error}");
    }
}
