//! A call of the server, as the table in `api` and those who admit it know it.

use std::time::Duration;

use access::Scope;

/// A call that can be made, and by whom.
#[derive(Debug, Clone, Copy)]
pub struct Route {
    /// `GET`, `POST` or `PUT`.
    pub method: &'static str,
    /// With `{names}` for what varies.
    pub path: &'static str,
    /// A token needs one of these. For commands of the registry, each command then asks for its own.
    pub scopes: &'static [Scope],
    pub(crate) body: usize,
    pub(crate) time: Duration,
}
