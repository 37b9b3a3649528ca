//! TLS configuration of servers and clients.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};

use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{ClientConfig, ConfigBuilder, RootCertStore, ServerConfig, WantsVerifier};

use crate::file::read_regular;
use crate::secret::{FileError, read_secret};

/// Limit of a certificate file in bytes.
const CERTIFICATE_BYTES: u64 = 16 << 20;

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// TLS of a server. Its certificate can be read again while it runs; open connections keep theirs.
#[derive(Debug, Clone)]
pub struct ServerTls {
    config: Arc<ServerConfig>,
    current: Arc<Current>,
    certificate: PathBuf,
    key: PathBuf,
}

/// The certificate of new connections.
#[derive(Debug)]
struct Current(RwLock<Arc<CertifiedKey>>);

impl ResolvesServerCert for Current {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner)))
    }
}

impl ServerTls {
    /// Reads a `certificate` chain and its private `key`, both PEM.
    ///
    /// # Errors
    /// A file cannot be read or has other content, the key is readable for other users, or the two do not match.
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, FileError> {
        let current = Arc::new(Current(RwLock::new(certified(certificate, key)?)));
        let config = ServerConfig::builder_with_provider(provider()).with_safe_default_protocol_versions();
        let config = config.expect("the provider speaks the default versions").with_no_client_auth();
        let mut config = config.with_cert_resolver(Arc::<Current>::clone(&current));
        config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
        Ok(Self { config: Arc::new(config), current, certificate: certificate.to_owned(), key: key.to_owned() })
    }

    /// The configuration for connections.
    pub fn config(&self) -> Arc<ServerConfig> {
        Arc::clone(&self.config)
    }

    /// Reads both files again, for new connections.
    ///
    /// # Errors
    /// As for [`ServerTls::read`]; the server then keeps its certificate.
    pub fn reload(&self) -> Result<(), FileError> {
        let new = certified(&self.certificate, &self.key)?;
        *self.current.0.write().unwrap_or_else(PoisonError::into_inner) = new;
        Ok(())
    }
}

fn certified(certificate: &Path, key: &Path) -> Result<Arc<CertifiedKey>, FileError> {
    let chain = certificates(certificate)?;
    let pem = read_secret(key)?;
    let secret = PrivateKeyDer::from_pem_slice(pem.as_bytes())
        .map_err(|error| FileError::new(key, format!("has no private key in PEM format: {error}")))?;
    let certified = CertifiedKey::from_der(chain, secret, &provider()).map_err(|error| {
        FileError::new(certificate, format!("does not match the key in `{}`: {error}", key.display()))
    })?;
    Ok(Arc::new(certified))
}

/// Creates a client's configuration that trusts only certificates signed by those in `ca`.
pub(crate) fn pinned(ca: &Path) -> Result<ClientConfig, FileError> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(ca)? {
        roots.add(certificate).map_err(|error| FileError::new(ca, error))?;
    }
    Ok(believing(roots))
}

/// Creates a configuration for clients without TLS. It loads no system certificates: that takes time, and some machines
/// have none.
pub(crate) fn nobody() -> ClientConfig {
    believing(RootCertStore::empty())
}

fn believing(roots: RootCertStore) -> ClientConfig {
    client().with_root_certificates(roots).with_no_client_auth()
}

fn client() -> ConfigBuilder<ClientConfig, WantsVerifier> {
    ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .expect("the provider speaks the default versions")
}

/// Installs the default cryptography provider for clients that trust the system's certificates. Repeated calls have no
/// effect.
pub fn install_provider() {
    // An error means that a provider is already installed, which is just as good.
    let _ = ring::default_provider().install_default();
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, FileError> {
    let wrong =
        |error: &dyn std::fmt::Display| FileError::new(path, format!("has no certificate in PEM format: {error}"));
    let bytes = read_regular(path, CERTIFICATE_BYTES).map_err(|error| FileError::new(path, error))?;
    let all: Vec<_> =
        CertificateDer::pem_slice_iter(&bytes).collect::<Result<_, _>>().map_err(|error| wrong(&error))?;
    if all.is_empty() {
        return Err(wrong(&"no `BEGIN CERTIFICATE`"));
    }
    Ok(all)
}
