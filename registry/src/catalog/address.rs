//! Address of a catalog in PostgreSQL. Its password is never shown and never written to a file.

use std::fmt;
use std::fs;
use std::path::PathBuf;
use std::str::FromStr;

use reqwest::Url;
use sqlx::postgres::PgConnectOptions;

/// Parameters that an address may have.
const KNOWN: [&str; 9] =
    ["sslmode", "sslrootcert", "sslcert", "sslkey", "host", "port", "options", "application_name", PASSWORD_FILE];
/// Parameter that names a file with the password.
const PASSWORD_FILE: &str = "password-file";

/// The address of a database, such as `postgres://stride@db.example.org/stride?password-file=/run/secrets/stride`.
#[derive(Clone, PartialEq, Eq)]
pub struct PostgresAddress {
    /// The address without the file of the password.
    url: Url,
    password_file: Option<PathBuf>,
}

impl PostgresAddress {
    /// Returns the options of a connection. Reads the file of the password each time, so that it may be changed.
    pub(crate) fn options(&self) -> Result<PgConnectOptions, String> {
        // The parser's error may quote the address.
        let options: PgConnectOptions =
            self.url.as_str().parse().map_err(|_| format!("`{self}` is not an address of PostgreSQL"))?;
        let options = match &self.password_file {
            None => options,
            Some(path) => {
                let password = fs::read_to_string(path)
                    .map_err(|e| format!("cannot read the password in `{}`: {e}", path.display()))?;
                options.password(password.trim_end_matches(['\n', '\r']))
            }
        };
        Ok(options.statement_cache_capacity(200))
    }

    /// Returns the text for a file: the address without its password. A file of the password is named.
    pub(crate) fn to_remember(&self) -> String {
        let mut url = self.url.clone();
        // This fails for addresses without a host, which have no password.
        let _ = url.set_password(None);
        if let Some(path) = &self.password_file {
            url.query_pairs_mut().append_pair(PASSWORD_FILE, &path.display().to_string());
        }
        url.into()
    }

    /// Returns true if both name the same database.
    pub(crate) fn is_same_database(&self, other: &Self) -> bool {
        self.place() == other.place()
    }

    /// Returns host, port, path and options, which tell databases apart.
    fn place(&self) -> (Option<String>, String, String, Option<String>) {
        let url = &self.url;
        let query = |key: &str| url.query_pairs().find(|(k, _)| k == key).map(|(_, value)| value.into_owned());
        let host = query("host").or_else(|| url.host_str().map(str::to_owned));
        let port = query("port").or_else(|| url.port().map(|port| port.to_string()));
        (host, port.unwrap_or_else(|| "5432".into()), url.path().to_owned(), query("options"))
    }
}

impl fmt::Display for PostgresAddress {
    /// Shows host and database alone.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "postgres://{}", self.url.host_str().unwrap_or("localhost"))?;
        if let Some(port) = self.url.port() {
            write!(f, ":{port}")?;
        }
        f.write_str(self.url.path())
    }
}

impl fmt::Debug for PostgresAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

impl FromStr for PostgresAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // The text may have a password, so no message quotes it.
        let expected = "expected an address such as `postgres://USER@HOST/DATABASE?password-file=FILE`";
        let mut url = Url::parse(text).map_err(|e| format!("{expected}: {e}"))?;
        if !matches!(url.scheme(), "postgres" | "postgresql") {
            return Err(expected.into());
        }
        if url.path().len() < 2 {
            return Err(format!("the address names no database; {expected}"));
        }
        let pairs: Vec<(String, String)> = url.query_pairs().into_owned().collect();
        if let Some((key, _)) = pairs.iter().find(|(key, _)| !KNOWN.contains(&key.as_str())) {
            return Err(format!(
                "`{key}` is no parameter of a catalog's address; expected one of {}",
                KNOWN.join(", ")
            ));
        }
        let file = pairs.iter().find(|(key, _)| key == PASSWORD_FILE).map(|(_, path)| PathBuf::from(path));
        url.set_query(None);
        for (key, value) in pairs.iter().filter(|(key, _)| key != PASSWORD_FILE) {
            url.query_pairs_mut().append_pair(key, value);
        }
        Ok(Self { url, password_file: file })
    }
}

/// The place of a catalog: the folder of a store, for SQLite, or a database of PostgreSQL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CatalogPlace {
    Folder(PathBuf),
    Postgres(PostgresAddress),
}

impl fmt::Display for CatalogPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder(dir) => write!(f, "{}", dir.display()),
            Self::Postgres(address) => write!(f, "{address}"),
        }
    }
}

impl FromStr for CatalogPlace {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once("://") {
            Some(_) => Ok(Self::Postgres(text.parse()?)),
            None => Ok(Self::Folder(text.into())),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_never_shown_or_remembered() {
        let address: PostgresAddress = "postgres://stride:secret@db:5433/lab?sslmode=require".parse().unwrap();
        for shown in [address.to_string(), format!("{address:?}")] {
            assert_eq!(shown, "postgres://db:5433/lab");
        }
        assert_eq!(address.to_remember(), "postgres://stride@db:5433/lab?sslmode=require");
        for wrong in
            ["postgres://stride:secret@db", "mysql://stride:secret@db/lab", "postgres://u:secret@db/lab?passwd=secret"]
        {
            let error = wrong.parse::<PostgresAddress>().unwrap_err();
            assert!(!error.contains("secret"), "{error}");
        }
    }

    #[test]
    fn a_file_gives_the_password() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("password");
        let text = format!("postgres://stride@db/lab?password-file={}", file.display());
        let address: PostgresAddress = text.parse().unwrap();
        let missing = address.options().unwrap_err();
        assert!(missing.contains("password"), "{missing}");
        fs::write(&file, "secret\n").unwrap();
        address.options().unwrap();
        let again: PostgresAddress = address.to_remember().parse().unwrap();
        assert_eq!(again, address);
        assert!(again.is_same_database(&"postgres://other@db:5432/lab".parse().unwrap()));
        assert!(!again.is_same_database(&"postgres://stride@db/other".parse().unwrap()));
    }
}
