//! Sessions of browsers: a token buys a cookie with the same rights, which a script of the page cannot read.
//!
//! A cookie is `HOLDER.UNTIL.NONCE.PROOF`: the digest of the token that bought it, or `own` for the user whom this process belongs to,
//! whose token is another at every start. The proof is made with the server's key, so that a session outlives a restart and nothing of it
//! is stored. It ends at its time, with its token, or when it is signed out; what was signed out is forgotten at a restart.
//!
//! The user's own session can also be bought with a key that works once. It is the fragment of a printed link.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use access::Token;
use axum::http::{HeaderMap, header};
use protocol::Digest;

use super::clock::wall_clock;
use super::secrets::Secrets;

/// Lifetime of a session.
pub(crate) const LASTS_S: u64 = 12 * 3600;
/// Lifetime of a printed link.
const KEY_MS: u64 = 3_600_000;
/// Links and ended sessions that are remembered.
const REMEMBERED: usize = 10_000;
/// The holder in the cookies of the user whom this process belongs to.
const OWN: &str = "own";

/// Makes and recognises cookies.
#[derive(Debug)]
pub(crate) struct Sessions {
    secrets: Secrets,
    lists: Mutex<Lists>,
}

#[derive(Debug, Default)]
struct Lists {
    /// Keys that are good once, with the times until which they are.
    keys: HashMap<Digest, u64>,
    /// Sessions that were signed out, with the times at which they would have ended.
    ended: HashMap<String, u64>,
}

/// The owner of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Holder {
    /// The user whom this process belongs to.
    Own,
    /// The caller whose token has this digest.
    Token(Digest),
}

/// A session that is valid now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Session {
    pub(crate) holder: Holder,
    /// Until when, in milliseconds since 1970.
    pub(crate) until_ms: u64,
    nonce: String,
}

impl Holder {
    fn digest(self) -> Option<Digest> {
        match self {
            Self::Own => None,
            Self::Token(digest) => Some(digest),
        }
    }
}

impl Sessions {
    pub(crate) fn new(secrets: Secrets) -> Self {
        Self { secrets, lists: Mutex::default() }
    }

    /// A new session, and the value of its cookie.
    pub(crate) fn begin(&self, holder: Holder) -> (Session, String) {
        let until_ms = wall_clock().0.saturating_add(LASTS_S * 1000);
        let nonce = Token::random().secret()[..32].to_owned();
        let proof = self.secrets.of_session(holder.digest(), until_ms, &nonce);
        let name = holder.digest().map_or_else(|| OWN.to_owned(), |digest| digest.hex());
        let value = format!("{name}.{until_ms}.{nonce}.{proof}");
        (Session { holder, until_ms, nonce }, value)
    }

    /// The session of a cookie's value, if this server issued it and it is still valid.
    pub(crate) fn find(&self, value: &str) -> Option<Session> {
        let mut words = value.split('.');
        let (Some(holder), Some(until), Some(nonce), Some(proof), None) =
            (words.next(), words.next(), words.next(), words.next(), words.next())
        else {
            return None;
        };
        let holder = match holder {
            OWN => Holder::Own,
            hex => Holder::Token(format!("sha256:{hex}").parse().ok()?),
        };
        let until_ms: u64 = until.parse().ok()?;
        if !self.secrets.is_session(holder.digest(), until_ms, nonce, proof) || wall_clock().0 >= until_ms {
            return None;
        }
        let ended = self.lists.lock().unwrap_or_else(PoisonError::into_inner).ended.contains_key(nonce);
        (!ended).then(|| Session { holder, until_ms, nonce: nonce.to_owned() })
    }

    /// Ends a session before its time.
    pub(crate) fn end(&self, session: &Session) {
        let mut lists = self.lists.lock().unwrap_or_else(PoisonError::into_inner);
        remember(&mut lists.ended, session.nonce.clone(), session.until_ms);
    }

    /// A key that buys one session of this process's user.
    pub(crate) fn key(&self) -> String {
        let key = Token::random();
        let until_ms = wall_clock().0.saturating_add(KEY_MS);
        let mut lists = self.lists.lock().unwrap_or_else(PoisonError::into_inner);
        remember(&mut lists.keys, key.digest(), until_ms);
        key.secret().to_owned()
    }

    /// Consumes `key`. Returns true if it was valid.
    pub(crate) fn redeem(&self, key: &str) -> bool {
        let until_ms = self.lists.lock().unwrap_or_else(PoisonError::into_inner).keys.remove(&access::digest_of(key));
        until_ms.is_some_and(|until_ms| wall_clock().0 < until_ms)
    }
}

/// Adds what is over at a time, and forgets what is over now.
pub(super) fn remember<K: std::hash::Hash + Eq + Clone>(list: &mut HashMap<K, u64>, what: K, until_ms: u64) {
    let now_ms = wall_clock().0;
    list.retain(|_, until| *until > now_ms);
    if list.len() >= REMEMBERED
        && let Some(first) = list.iter().min_by_key(|(_, until)| **until).map(|(what, _)| what.clone())
    {
        list.remove(&first);
    }
    list.insert(what, until_ms);
}

/// The name of our cookie at the address that a request names. Cookies of one host are shared by its ports, so the port is part of it.
pub(crate) fn cookie_name(headers: &HeaderMap, encrypted: bool) -> String {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let port: String =
        host.rsplit_once(':').map_or("", |(_, port)| port).chars().filter(char::is_ascii_digit).collect();
    // Browsers take a name with this beginning over TLS alone, and from no other host.
    format!("{}stride-{port}", if encrypted { "__Host-" } else { "" })
}

/// The value of the cookie `name` among the headers.
pub(crate) fn cookie<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let lines = headers.get_all(header::COOKIE).into_iter().filter_map(|line| line.to_str().ok());
    let mut pairs = lines.flat_map(|line| line.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(known, _)| *known == name).map(|(_, value)| value)
}

/// The header that gives a browser a cookie for so many seconds; 0 takes it away.
pub(crate) fn set_cookie(name: &str, value: &str, seconds: u64, encrypted: bool) -> String {
    let secure = if encrypted { "; Secure" } else { "" };
    format!("{name}={value}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}")
}

/// A session beside the call that it lets in.
pub(crate) type Current = Arc<Session>;

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    fn sessions(key: u8) -> Sessions {
        Sessions::new(Secrets::new([key; 32]))
    }

    #[test]
    fn a_cookie_is_known_to_every_server_with_the_key_until_it_is_signed_out() {
        let sessions_of_1 = sessions(1);
        for holder in [Holder::Own, Holder::Token(Digest::of(b"a token"))] {
            let (session, value) = sessions_of_1.begin(holder);
            assert_eq!(sessions_of_1.find(&value), Some(session.clone()));
            assert_eq!(sessions(1).find(&value), Some(session.clone()), "after a restart");
            assert_eq!(sessions(2).find(&value), None, "another server's");
            sessions_of_1.end(&session);
            assert_eq!(sessions_of_1.find(&value), None);
        }
    }

    #[test]
    fn no_part_of_a_cookie_can_be_changed() {
        let sessions = sessions(1);
        let (session, value) = sessions.begin(Holder::Token(Digest::of(b"a token")));
        let words: Vec<&str> = value.split('.').collect();
        let later = (session.until_ms + 1).to_string();
        for (place, other) in [(0, OWN), (1, later.as_str()), (2, "0"), (3, words[2])] {
            let mut changed = words.clone();
            changed[place] = other;
            assert_eq!(sessions.find(&changed.join(".")), None, "{place}");
        }
        for wrong in ["", "....", "own", &value[1..], &format!("{value}."), &value[..value.len() - 1]] {
            assert_eq!(sessions.find(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_session_is_over_after_its_time() {
        let sessions = sessions(1);
        let over = wall_clock().0 - 1;
        let proof = sessions.secrets.of_session(None, over, "n");
        assert_eq!(sessions.find(&format!("{OWN}.{over}.n.{proof}")), None);
    }

    #[test]
    fn a_key_is_good_once() {
        let sessions = sessions(1);
        let one = sessions.key();
        let other = sessions.key();
        assert!(sessions.redeem(&one) && !sessions.redeem(&one));
        assert!(sessions.redeem(&other) && !sessions.redeem(""));
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut list = HashMap::new();
        let later = wall_clock().0 + 100_000;
        for i in 0..REMEMBERED as u64 + 10 {
            remember(&mut list, i, later + i);
        }
        assert_eq!(list.len(), REMEMBERED);
        assert!(!list.contains_key(&0) && list.contains_key(&(REMEMBERED as u64)));
    }

    #[test]
    fn cookies_of_two_servers_of_a_machine_differ() {
        let headers = |host: &str, cookie: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, host.parse().unwrap());
            headers.insert(header::COOKIE, cookie.parse().unwrap());
            headers
        };
        let one = headers("localhost:7700", "a=b; stride-7700=one; stride-7701=two");
        assert_eq!(cookie(&one, &cookie_name(&one, false)), Some("one"));
        let other = headers("[::1]:7701", "stride-7700=one;stride-7701=two");
        assert_eq!(cookie(&other, &cookie_name(&other, false)), Some("two"));
        assert_eq!(cookie(&other, &cookie_name(&other, true)), None, "what was bought without TLS is no good with it");
        assert_eq!(cookie_name(&headers("stride.lab", ""), true), "__Host-stride-");
    }
}
