//! Tests of TLS: clients trust the right certificate and no other.

use std::fs;
use std::net::{Ipv4Addr, SocketAddr};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use access::{Scopes, Server, Token, Tokens, explain, tls};
use coordinator::{Config, Coordinator, Handle};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use registry::{Holder, Store};
use reqwest::Method;

pub(crate) struct Files {
    pub(crate) ca: PathBuf,
    certificate: PathBuf,
    key: PathBuf,
}

impl Files {
    pub(crate) fn server(&self) -> tls::ServerTls {
        tls::ServerTls::read(&self.certificate, &self.key).unwrap()
    }
}

/// Creates an authority and its certificate for `localhost`.
pub(crate) fn authority(dir: &Path, name: &str) -> Files {
    let files = Files {
        ca: dir.join(format!("{name}.ca.pem")),
        certificate: dir.join(format!("{name}.pem")),
        key: dir.join(format!("{name}.key")),
    };
    let ca_key = KeyPair::generate().unwrap();
    let mut ca = CertificateParams::new(Vec::<String>::new()).unwrap();
    ca.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    ca.distinguished_name.push(rcgen::DnType::CommonName, name);
    fs::write(&files.ca, ca.self_signed(&ca_key).unwrap().pem()).unwrap();
    let issuer = Issuer::new(ca, ca_key);
    let key = KeyPair::generate().unwrap();
    let leaf = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
    fs::write(&files.certificate, leaf.signed_by(&key, &issuer).unwrap().pem()).unwrap();
    fs::write(&files.key, key.serialize_pem()).unwrap();
    fs::set_permissions(&files.key, fs::Permissions::from_mode(0o600)).unwrap();
    files
}

async fn start(dir: &Path, files: &Files, token: &Token) -> Handle {
    start_with(dir, files, token, |_| {}).await
}

pub(crate) async fn start_with(dir: &Path, files: &Files, token: &Token, change: impl FnOnce(&mut Config)) -> Handle {
    let store = Store::open(dir, Holder::this_process("a test")).await.unwrap();
    let mut tokens = Tokens::default();
    tokens.add("me", Scopes::all(), token);
    let tls = Some(files.server());
    let mut config = Config { tls, ..Config::server(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), tokens) };
    change(&mut config);
    Coordinator::start(store, config).await.unwrap()
}

async fn ask(url: &str, token: &Token, ca: Option<&Path>) -> Result<(u16, String), String> {
    let server = Server::new(url, Some(token.clone()), ca).map_err(|e| e.to_string())?;
    let answer = server.request(Method::GET, "/v1/runs").send().await.map_err(|e| explain(&e))?;
    Ok((answer.status().as_u16(), answer.text().await.unwrap()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_the_pinned_authority_is_believed() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (authority(dir.path(), "ours"), authority(dir.path(), "theirs"));
    let token = Token::random();
    let handle = start(&dir.path().join("store"), &ours, &token).await;
    let port = handle.address().port();
    let url = format!("https://localhost:{port}");
    assert!(handle.url().starts_with("https://"));

    assert_eq!(ask(&url, &token, Some(&ours.ca)).await.unwrap().0, 200);
    let wrong = ask(&url, &token, Some(&theirs.ca)).await.unwrap_err();
    assert!(wrong.contains("--ca"), "{wrong}");
    let system = ask(&url, &token, None).await.unwrap_err();
    assert!(system.contains("certificate") || system.contains("UnknownIssuer"), "{system}");
    let by_address = ask(&format!("https://127.0.0.1:{port}"), &token, Some(&ours.ca)).await.unwrap_err();
    assert!(by_address.contains("another name"), "{by_address}");

    // A session that is bought here is sent here alone, and never without TLS.
    let server = Server::new(&url, Some(token.clone()), Some(&ours.ca)).unwrap();
    let bought = server.request(Method::POST, "/v1/session").send().await.unwrap();
    let cookie = bought.headers()["set-cookie"].to_str().unwrap().to_owned();
    assert!(cookie.starts_with(&format!("__Host-stride-{port}=")) && cookie.contains("; Secure"), "{cookie}");

    // A plain HTTP request gets advice and never reaches a route.
    let (status, text) = ask(&format!("http://localhost:{port}"), &token, None).await.unwrap();
    assert!(status == 400 && text.contains("this server speaks TLS"), "{status} {text}");
    let refused = ask(&format!("http://localhost:{port}"), &token, Some(&ours.ca)).await.unwrap_err();
    assert!(refused.contains("not encrypted"), "{refused}");

    // Commands on this machine use an address without TLS; `https` there gives a clear error.
    assert_eq!(ask(&handle.local_url(), handle.token(), None).await.unwrap().0, 200);
    let local = handle.local_url().replace("http://127.0.0.1", "https://localhost");
    let plain = ask(&local, &token, Some(&ours.ca)).await.unwrap_err();
    assert!(plain.contains("does not speak TLS"), "{plain}");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_is_replaced_without_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let (old, new) = (authority(dir.path(), "old"), authority(dir.path(), "new"));
    let token = Token::random();
    let handle = start(&dir.path().join("store"), &old, &token).await;
    let url = format!("https://localhost:{}", handle.address().port());
    let opened = Server::new(&url, Some(token.clone()), Some(&old.ca)).unwrap();
    let asked = || async { opened.request(Method::GET, "/v1/runs").send().await.unwrap().status() };
    assert_eq!(asked().await, 200);

    // Only one of the two files is there: nothing changes.
    fs::copy(&new.certificate, &old.certificate).unwrap();
    let refused = handle.reload_certificate().unwrap_err().to_string();
    assert!(refused.contains("does not match the key"), "{refused}");
    assert_eq!(ask(&url, &token, Some(&old.ca)).await.unwrap().0, 200);

    fs::copy(&new.key, &old.key).unwrap();
    handle.reload_certificate().unwrap();
    assert_eq!(ask(&url, &token, Some(&new.ca)).await.unwrap().0, 200);
    ask(&url, &token, Some(&old.ca)).await.unwrap_err();
    assert_eq!(asked().await, 200, "an open connection goes on");
    handle.shutdown().await;
}

#[test]
fn keys_that_everybody_can_read_and_files_that_do_not_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (authority(dir.path(), "ours"), authority(dir.path(), "theirs"));
    assert!(tls::ServerTls::read(&ours.certificate, &ours.key).is_ok());
    let mixed = tls::ServerTls::read(&ours.certificate, &theirs.key).unwrap_err().to_string();
    assert!(mixed.contains("does not match the key"), "{mixed}");
    let swapped = tls::ServerTls::read(&ours.key, &ours.key).unwrap_err().to_string();
    assert!(swapped.contains("no certificate in PEM"), "{swapped}");
    fs::set_permissions(&ours.key, fs::Permissions::from_mode(0o644)).unwrap();
    let open = tls::ServerTls::read(&ours.certificate, &ours.key).unwrap_err();
    assert!(open.to_string().contains("open to every user") && open.advice().is_some(), "{open}");
}
