//! The tokens of a server, which may change while it runs.

use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use access::{Caller, Token, Tokens};
use tokio::sync::watch;

use super::clock::wall_clock;

/// How often a call under way looks whether its token has expired.
const LOOK_AGAIN: Duration = Duration::from_secs(10);

/// The newest table, and the tokens that this process made for its own user.
#[derive(Debug)]
pub(crate) struct TokenTable {
    tokens: RwLock<Arc<Tokens>>,
    own: Vec<(Caller, Token)>,
    changed: watch::Sender<u64>,
}

/// Why a token lets its bearer do nothing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Unknown {
    /// No line has it.
    Nobody,
    /// Its time is over.
    Expired(Arc<Caller>),
}

impl TokenTable {
    pub(crate) fn new(tokens: Tokens, own: Vec<(Caller, Token)>) -> Self {
        let table = Self { tokens: RwLock::default(), own, changed: watch::Sender::new(0) };
        table.replace(tokens);
        table
    }

    /// Takes another table in the place of the one before. Calls under way whose token is not in it end.
    pub(crate) fn replace(&self, mut tokens: Tokens) {
        for (caller, token) in &self.own {
            tokens.insert(caller.clone(), token);
        }
        *self.tokens.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(tokens);
        self.changed.send_modify(|version| *version += 1);
    }

    /// The newest table.
    pub(crate) fn current(&self) -> Arc<Tokens> {
        Arc::clone(&self.tokens.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// The bearer of a token that is valid now.
    pub(crate) fn find(&self, token: &str) -> Result<Arc<Caller>, Unknown> {
        let caller = self.current().find(token).cloned().ok_or(Unknown::Nobody)?;
        let is_over = caller.expires.as_ref().is_some_and(|expires| expires.is_over(wall_clock().0));
        if is_over { Err(Unknown::Expired(caller)) } else { Ok(caller) }
    }
}

/// A call's right to be answered: it ends when its token is revoked, changed or over.
#[derive(Debug, Clone)]
pub struct Standing {
    table: Arc<TokenTable>,
    token: Arc<str>,
    caller: Arc<Caller>,
    seen: watch::Receiver<u64>,
}

impl Standing {
    pub(crate) fn new(table: Arc<TokenTable>, token: &str, caller: Arc<Caller>) -> Self {
        let seen = table.changed.subscribe();
        Self { table, token: token.into(), caller, seen }
    }

    fn holds(&self) -> bool {
        self.table.find(&self.token).is_ok_and(|caller| caller == self.caller)
    }

    /// Whether the token still lets its bearer do what it did. Costs nothing while no table came and the token does not expire.
    pub(crate) fn still_holds(&mut self) -> bool {
        let changed = self.seen.has_changed().unwrap_or(true);
        if !changed && self.caller.expires.is_none() {
            return true;
        }
        self.seen.mark_unchanged();
        self.holds()
    }

    /// Returns once the token is revoked, changed or over.
    pub async fn lost(mut self) {
        while self.holds() {
            if self.caller.expires.is_none() {
                // An error means that the server is gone, which ends its calls too.
                if self.seen.changed().await.is_err() {
                    return;
                }
            } else {
                // Either ends the wait; which one does not matter.
                let _ = tokio::time::timeout(LOOK_AGAIN, self.seen.changed()).await;
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use access::{Scope, Scopes};

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
        let (a, b) = ("0123456789abcdef", "fedcba9876543210");
        let read = Scopes::of(&[Scope::Read]);
        let tokens = Arc::new(TokenTable::new(table(&[("a", read, a), ("b", read, b)]), Vec::new()));
        let standing = |token| Standing::new(Arc::clone(&tokens), token, tokens.find(token).unwrap());
        let (mut first, second) = (standing(a), standing(b));
        assert!(first.still_holds());
        let lost = tokio::spawn(second.lost());
        tokens.replace(table(&[("a", read, a)]));
        lost.await.unwrap();
        assert!(first.still_holds() && tokens.find(b) == Err(Unknown::Nobody));
        tokens.replace(table(&[("a", Scopes::of(&[Scope::Worker]), a)]));
        assert!(!first.still_holds(), "it may do something else now");
    }

    #[test]
    fn the_process_keeps_its_own_token() {
        let own: Token = "0123456789abcdef".parse().unwrap();
        let caller = Caller::new("me", Scopes::all());
        let tokens = TokenTable::new(Tokens::default(), vec![(caller.clone(), own.clone())]);
        tokens.replace(Tokens::default());
        assert_eq!(tokens.find(own.secret()).as_deref(), Ok(&caller));
    }
}
