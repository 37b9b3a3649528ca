//! Both ends of TLS: what a server shows, and whom a client believes.

use std::path::Path;
use std::sync::Arc;

use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, ConfigBuilder, RootCertStore, ServerConfig, WantsVerifier};

use crate::file::read_regular;
use crate::secret::{FileError, read_secret};

/// Bytes of a file of certificates.
const CERTIFICATE_BYTES: u64 = 16 << 20;

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// For a server that shows the certificate (and those that sign it) in `certificate`, and has its `key`.
pub fn server(certificate: &Path, key: &Path) -> Result<Arc<ServerConfig>, FileError> {
    let chain = certificates(certificate)?;
    let pem = read_secret(key)?;
    let secret = PrivateKeyDer::from_pem_slice(pem.as_bytes())
        .map_err(|error| FileError::new(key, format!("has no private key in PEM: {error}")))?;
    let config = ServerConfig::builder_with_provider(provider()).with_safe_default_protocol_versions();
    let config = config.and_then(|config| config.with_no_client_auth().with_single_cert(chain, secret));
    let mut config = config.map_err(|error| {
        FileError::new(certificate, format!("does not serve with the key in `{}`: {error}", key.display()))
    })?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}

/// For a client that believes only what the certificates in `ca` sign.
pub(crate) fn pinned(ca: &Path) -> Result<ClientConfig, FileError> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates(ca)? {
        roots.add(certificate).map_err(|error| FileError::new(ca, error))?;
    }
    Ok(believing(roots))
}

/// For a client that never speaks TLS: reading the system's certificates takes time, and some machines have none.
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

/// Lets a client that believes the system's certificates find the cryptography; once is enough.
pub fn install_provider() {
    // Refused if there is one already, which does as well.
    let _ = ring::default_provider().install_default();
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, FileError> {
    let wrong = |error: &dyn std::fmt::Display| FileError::new(path, format!("has no certificate in PEM: {error}"));
    let bytes = read_regular(path, CERTIFICATE_BYTES).map_err(|error| FileError::new(path, error))?;
    let all: Vec<_> =
        CertificateDer::pem_slice_iter(&bytes).collect::<Result<_, _>>().map_err(|error| wrong(&error))?;
    if all.is_empty() {
        return Err(wrong(&"no `BEGIN CERTIFICATE`"));
    }
    Ok(all)
}
