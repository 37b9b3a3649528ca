//! The description of a call, used by the table in `api` and by the code that admits callers.

use std::time::Duration;

use access::Scope;

/// A call and the scopes that allow it.
#[derive(Debug, Clone, Copy)]
pub struct Route {
    /// `GET`, `POST`, `PUT` or `DELETE`.
    pub method: &'static str,
    /// The path with `{names}` of parameters.
    pub path: &'static str,
    /// Accepted scopes; a token needs one of them. Each registry command also checks a scope of its own.
    pub scopes: &'static [Scope],
    pub(crate) body: usize,
    pub(crate) time: Duration,
}
