//! The tokens of a server, which may change while it runs.

use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use access::{Caller, Token, Tokens};
use protocol::Digest;
use tokio::sync::watch;

use super::clock::wall_clock;

/// Interval at which an active call checks whether its token has expired.
const LOOK_AGAIN: Duration = Duration::from_secs(10);

/// The current table, and the tokens that this process made for its own user.
#[derive(Debug)]
pub(crate) struct TokenTable {
    tokens: RwLock<Arc<Tokens>>,
    own: Vec<(Caller, Token)>,
    changed: watch::Sender<u64>,
}

/// The reason why a token is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Unknown {
    /// The call has no token.
    Missing,
    /// No line has the token.
    Nobody,
    /// The token has expired.
    Expired(Arc<Caller>),
}

impl TokenTable {
    pub(crate) fn new(tokens: Tokens, own: Vec<(Caller, Token)>) -> Self {
        let table = Self { tokens: RwLock::default(), own, changed: watch::Sender::new(0) };
        table.replace(tokens);
        table
    }

    /// Replaces the table. Active calls with a removed token are aborted.
    pub(crate) fn replace(&self, mut tokens: Tokens) {
        for (caller, token) in &self.own {
            tokens.insert(caller.clone(), token);
        }
        *self.tokens.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(tokens);
        self.changed.send_modify(|version| *version += 1);
    }

    /// The current table.
    pub(crate) fn current(&self) -> Arc<Tokens> {
        Arc::clone(&self.tokens.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// The digest of the token that this process made for its own user.
    pub(crate) fn users_own(&self) -> Option<Digest> {
        self.own.first().map(|(_, token)| token.digest())
    }

    /// The caller whose token has this digest, if it is valid now.
    pub(crate) fn find(&self, token: Digest) -> Result<Arc<Caller>, Unknown> {
        let caller = self.current().find_digest(token).cloned().ok_or(Unknown::Nobody)?;
        let is_over = caller.expires.as_ref().is_some_and(|expires| expires.is_over(wall_clock().0));
        if is_over { Err(Unknown::Expired(caller)) } else { Ok(caller) }
    }
}

/// The validity of a call's token; it ends when the token is revoked, changed or expired.
#[derive(Debug, Clone)]
pub struct Standing {
    table: Arc<TokenTable>,
    token: Digest,
    caller: Arc<Caller>,
    seen: watch::Receiver<u64>,
}

impl Standing {
    pub(crate) fn new(table: Arc<TokenTable>, token: Digest, caller: Arc<Caller>) -> Self {
        let seen = table.changed.subscribe();
        Self { table, token, caller, seen }
    }

    /// The digest of the token that it hangs on.
    pub(crate) fn token(&self) -> Digest {
        self.token
    }

    fn holds(&self) -> bool {
        self.table.find(self.token).is_ok_and(|caller| caller == self.caller)
    }

    /// Returns true if the token is still valid and unchanged. Cheap while the table is unchanged and the token has no
    /// expiry.
    pub(crate) fn still_holds(&mut self) -> bool {
        let changed = self.seen.has_changed().unwrap_or(true);
        if !changed && self.caller.expires.is_none() {
            return true;
        }
        self.seen.mark_unchanged();
        self.holds()
    }

    /// Waits until the token is revoked, changed or expired.
    pub async fn lost(mut self) {
        while self.holds() {
            if self.caller.expires.is_none() {
                // An error means that the server has ended, which ends its calls too.
                if self.seen.changed().await.is_err() {
                    return;
                }
            } else {
                // Both events require the same check.
                let _ = tokio::time::timeout(LOOK_AGAIN, self.seen.changed()).await;
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use access::{Scope, Scopes, digest_of};

    use super::*;

    fn table(lines: &[(&str, Scopes, &str)]) -> Tokens {
        let mut tokens = Tokens::default();
        for (name, scopes, token) in lines {
            assert!(tokens.add(*name, *scopes, &token.parse().unwrap()));
        }
        tokens
    }

    #[tokio::test]
    async fn a_call_ends_with_its_token_and_with_no_other() {
        let a = "0123456789abcdef";
        let b = "fedcba9876543210";
        let read = Scopes::of(&[Scope::Read]);
        let tokens = Arc::new(TokenTable::new(table(&[("a", read, a), ("b", read, b)]), Vec::new()));
        let find = |token| tokens.find(digest_of(token));
        let standing = |token| Standing::new(Arc::clone(&tokens), digest_of(token), find(token).unwrap());
        let mut first = standing(a);
        let second = standing(b);
        assert!(first.still_holds());
        let lost = tokio::spawn(second.lost());
        tokens.replace(table(&[("a", read, a)]));
        lost.await.unwrap();
        assert!(first.still_holds() && find(b) == Err(Unknown::Nobody));
        tokens.replace(table(&[("a", Scopes::of(&[Scope::Worker]), a)]));
        assert!(!first.still_holds(), "it may do something else now");
    }

    #[test]
    fn the_process_keeps_its_own_token() {
        let own: Token = "0123456789abcdef".parse().unwrap();
        let caller = Caller::new("me", Scopes::all());
        let tokens = TokenTable::new(Tokens::default(), vec![(caller.clone(), own.clone())]);
        tokens.replace(Tokens::default());
        assert_eq!(tokens.find(own.digest()).as_deref(), Ok(&caller));
    }
}
