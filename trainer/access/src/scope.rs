//! Permissions of tokens.

use std::fmt;
use std::str::FromStr;

/// A class of calls. The coordinator's table of routes assigns each call to one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scope {
    /// Reading runs, logs, metrics, models and their files.
    Read,
    /// Submitting, pausing, resuming and cancelling runs; importing models.
    Submit,
    /// Joining, polling and uploading as a worker.
    Worker,
    /// Moving aliases, by a command or by a pipeline.
    Promote,
    /// Seeing how many workers are wanted, to start them.
    Launch,
    /// Operations on everyone's data, such as garbage collection and verification; includes all other scopes.
    Admin,
}

impl Scope {
    pub const ALL: [Self; 6] = [Self::Read, Self::Submit, Self::Worker, Self::Promote, Self::Launch, Self::Admin];

    /// The word for it in a token file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Submit => "submit",
            Self::Worker => "worker",
            Self::Promote => "promote",
            Self::Launch => "launch",
            Self::Admin => "admin",
        }
    }

    fn bit(self) -> u8 {
        1 << self as u8
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The bit for [`Scopes::read_all`], above those of the scopes.
const READ_ALL: u8 = 1 << 7;

/// The scopes of one token. `admin` includes all others. `submit` and `promote` include reading the caller's own data;
/// only an explicit `read` includes everyone's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scopes(u8);

impl Scopes {
    /// The set of these scopes and of all that they imply.
    pub fn of(scopes: &[Scope]) -> Self {
        let one = |scope: Scope| match scope {
            Scope::Read => scope.bit() | READ_ALL,
            Scope::Worker | Scope::Launch => scope.bit(),
            Scope::Submit | Scope::Promote => scope.bit() | Scope::Read.bit(),
            Scope::Admin => Scope::ALL.iter().fold(READ_ALL, |all, scope| all | scope.bit()),
        };
        Self(scopes.iter().fold(0, |all, scope| all | one(*scope)))
    }

    /// The set with every scope.
    pub fn all() -> Self {
        Self::of(&[Scope::Admin])
    }

    /// Returns true if it may read the data of other owners, because `read` is given explicitly.
    pub fn read_all(self) -> bool {
        self.0 & READ_ALL != 0
    }

    /// Returns true if calls of this class are allowed.
    pub fn allow(self, scope: Scope) -> bool {
        self.0 & scope.bit() != 0
    }
}

impl fmt::Display for Scopes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = Scope::ALL.into_iter().filter(|scope| self.allow(*scope)).map(Scope::name).collect();
        f.write_str(&names.join(","))
    }
}

impl FromStr for Scopes {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let one = |word: &str| {
            Scope::ALL.into_iter().find(|scope| scope.name() == word).ok_or_else(|| {
                let known = Scope::ALL.map(Scope::name).join(", ");
                format!("`{word}` is not a scope; expected some of {known}, separated by commas")
            })
        };
        Ok(Self::of(&text.split(',').map(one).collect::<Result<Vec<_>, _>>()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scope_implies_no_more_than_it_needs() {
        let allowed = |text: &str| text.parse::<Scopes>().map(|scopes| scopes.to_string());
        assert_eq!(allowed("read").as_deref(), Ok("read"));
        assert_eq!(allowed("worker").as_deref(), Ok("worker"));
        assert_eq!(allowed("launch").as_deref(), Ok("launch"));
        assert_eq!(allowed("submit").as_deref(), Ok("read,submit"));
        assert_eq!(allowed("promote").as_deref(), Ok("read,promote"));
        assert_eq!(allowed("worker,submit").as_deref(), Ok("read,submit,worker"));
        assert_eq!(allowed("admin").as_deref(), Ok("read,submit,worker,promote,launch,admin"));
        let read_all = |text: &str| text.parse::<Scopes>().map(Scopes::read_all);
        assert_eq!(
            ["read", "submit", "promote", "worker", "submit,read", "admin"].map(|text| read_all(text) == Ok(true)),
            [true, false, false, false, true, true]
        );
        for wrong in ["", "root", "read,", "Read"] {
            assert!(allowed(wrong).is_err_and(|error| error.contains("read, submit, worker")), "{wrong}");
        }
    }
}
