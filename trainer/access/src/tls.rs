//! TLS configuration of servers and clients.

use std::path::Path;
use std::sync::Arc;

use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, ConfigBuilder, RootCertStore, ServerConfig, WantsVerifier};

use crate::file::read_regular;
use crate::secret::{FileError, read_secret};

/// Limit of a certificate file in bytes.
const CERTIFICATE_BYTES: u64 = 16 << 20;

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// Creates a server's configuration from its `certificate` chain and private `key`.
pub fn server(certificate: &Path, key: &Path) -> Result<Arc<ServerConfig>, FileError> {
    let chain = certificates(certificate)?;
    let pem = read_secret(key)?;
    let secret = PrivateKeyDer::from_pem_slice(pem.as_bytes())
        .map_err(|error| FileError::new(key, format!("has no private key in PEM format: {error}")))?;
    let config = ServerConfig::builder_with_provider(provider()).with_safe_default_protocol_versions();
    let config = config.and_then(|config| config.with_no_client_auth().with_single_cert(chain, secret));
    let mut config = config.map_err(|error| {
        FileError::new(certificate, format!("does not match the key in `{}`: {error}", key.display()))
    })?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(Arc::new(config))
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
