//! Statements over either database: their text, their values and their rows.
//!
//! The text is SQLite's, with `?` or `?1` for values. The words in braces differ between the databases:
//!
//! | in the text | SQLite | PostgreSQL |
//! |---|---|---|
//! | `{texts ?}` | rows of a JSON list of texts, one column | the same |
//! | `{numbers ?}` | rows of a JSON list of integers, one column | the same |
//! | `{places ?}` | rows `key`, `value` of a JSON list of integers, in its order | the same |
//! | `{stages COLUMN}` | rows `value` of the list `stages` of a JSON document | the same |
//! | `{pairs COLUMN}` | rows `key`, `value` of a JSON object | the same |
//! | `{least}`, `{greatest}` | `min`, `max` of two values | `least`, `greatest` |
//! | `{find}`, `{lower}` | `instr`, `lower` | `strpos`, `stride_lower` |
//! | `{added_history}` | the number of the newest row ever added | the same |

use std::borrow::Cow;
use std::fmt::Write as _;

use futures::stream::{BoxStream, StreamExt as _, TryStreamExt as _};
use protocol::TaskId;
use sqlx::postgres::PgRow;
use sqlx::sqlite::SqliteRow;
use sqlx::{
    AssertSqlSafe, ColumnIndex, Decode, PgConnection, Postgres, SqlSafeStr as _, SqlStr, Sqlite, SqliteConnection, Type,
};

use super::error::write_error;
use crate::WriteError;

type Result<T> = std::result::Result<T, WriteError>;
type Database<T> = std::result::Result<T, sqlx::Error>;

/// Rows of one statement: ten values each stay below SQLite's limit for a statement's values.
pub(super) const ROWS: usize = 250;

/// A borrowed connection to either database.
#[derive(Debug)]
pub(crate) enum Conn<'c> {
    Sqlite(&'c mut SqliteConnection),
    Postgres(&'c mut PgConnection),
}

impl Conn<'_> {
    pub(super) fn is_sqlite(&self) -> bool {
        matches!(self, Self::Sqlite(_))
    }
}

/// A value of a statement; `None` is null.
#[derive(Debug, Clone)]
pub(super) enum Value<'q> {
    Integer(Option<i64>),
    Float(Option<f64>),
    Text(Option<Cow<'q, str>>),
}

macro_rules! values {
    ($($from:ty => $variant:ident($name:ident) $value:expr),+ $(,)?) => {
        $(impl<'q> From<$from> for Value<'q> {
            fn from($name: $from) -> Self {
                Self::$variant($value)
            }
        })+
    };
}

values! {
    i64 => Integer(value) Some(value),
    u32 => Integer(value) Some(i64::from(value)),
    Option<i64> => Integer(value) value,
    f64 => Float(value) Some(value),
    Option<f64> => Float(value) value,
    String => Text(value) Some(Cow::Owned(value)),
    Option<String> => Text(value) value.map(Cow::Owned),
    &'q str => Text(value) Some(Cow::Borrowed(value)),
    &'q String => Text(value) Some(Cow::Borrowed(value.as_str())),
    Option<&'q str> => Text(value) value.map(Cow::Borrowed),
    &'q Option<String> => Text(value) value.as_deref().map(Cow::Borrowed),
}

/// A type that columns of both databases can be read as.
pub(super) trait Column<'r>: Decode<'r, Sqlite> + Type<Sqlite> + Decode<'r, Postgres> + Type<Postgres> {}

impl<'r, T> Column<'r> for T where T: Decode<'r, Sqlite> + Type<Sqlite> + Decode<'r, Postgres> + Type<Postgres> {}

/// A row of an answer.
pub(super) enum Row {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

impl Row {
    pub(super) fn try_get<'r, T, I>(&'r self, column: I) -> Database<T>
    where
        T: Column<'r>,
        I: ColumnIndex<SqliteRow> + ColumnIndex<PgRow>,
    {
        match self {
            Self::Sqlite(row) => sqlx::Row::try_get(row, column),
            Self::Postgres(row) => sqlx::Row::try_get(row, column),
        }
    }

    /// Returns the value of a column that the statement has.
    pub(super) fn get<'r, T, I>(&'r self, column: I) -> T
    where
        T: Column<'r>,
        I: ColumnIndex<SqliteRow> + ColumnIndex<PgRow>,
    {
        match self {
            Self::Sqlite(row) => sqlx::Row::get(row, column),
            Self::Postgres(row) => sqlx::Row::get(row, column),
        }
    }
}

/// A statement with its values.
#[derive(Debug)]
pub(super) struct Query<'q> {
    sql: Cow<'static, str>,
    values: Vec<Value<'q>>,
    is_kept: bool,
}

/// Begins a statement that each connection prepares once.
pub(super) fn query<'q>(sql: &'static str) -> Query<'q> {
    Query { sql: Cow::Borrowed(sql), values: Vec::new(), is_kept: true }
}

/// Binds the values of a statement for one of the databases.
macro_rules! bound {
    ($query:expr, $sql:expr) => {{
        let mut query = sqlx::query($sql).persistent($query.is_kept);
        for value in $query.values {
            query = match value {
                Value::Integer(value) => query.bind(value),
                Value::Float(value) => query.bind(value),
                Value::Text(value) => query.bind(value),
            };
        }
        query
    }};
}

impl<'q> Query<'q> {
    pub(super) fn bind(mut self, value: impl Into<Value<'q>>) -> Self {
        self.values.push(value.into());
        self
    }

    /// Returns the number of changed rows.
    pub(super) async fn execute(self, conn: &mut Conn<'_>) -> Database<u64> {
        Ok(match conn {
            Conn::Sqlite(conn) => bound!(self, sqlite(self.sql)).execute(&mut **conn).await?.rows_affected(),
            Conn::Postgres(conn) => bound!(self, postgres(&self.sql)).execute(&mut **conn).await?.rows_affected(),
        })
    }

    pub(super) async fn fetch_all(self, conn: &mut Conn<'_>) -> Database<Vec<Row>> {
        Ok(match conn {
            Conn::Sqlite(conn) => {
                let rows = bound!(self, sqlite(self.sql)).fetch_all(&mut **conn).await?;
                rows.into_iter().map(Row::Sqlite).collect()
            }
            Conn::Postgres(conn) => {
                let rows = bound!(self, postgres(&self.sql)).fetch_all(&mut **conn).await?;
                rows.into_iter().map(Row::Postgres).collect()
            }
        })
    }

    pub(super) async fn fetch_optional(self, conn: &mut Conn<'_>) -> Database<Option<Row>> {
        Ok(match conn {
            Conn::Sqlite(conn) => bound!(self, sqlite(self.sql)).fetch_optional(&mut **conn).await?.map(Row::Sqlite),
            Conn::Postgres(conn) => {
                bound!(self, postgres(&self.sql)).fetch_optional(&mut **conn).await?.map(Row::Postgres)
            }
        })
    }

    pub(super) async fn fetch_one(self, conn: &mut Conn<'_>) -> Database<Row> {
        self.fetch_optional(conn).await?.ok_or(sqlx::Error::RowNotFound)
    }

    /// Returns the rows one by one.
    pub(super) fn fetch<'c>(self, conn: &'c mut Conn<'_>) -> BoxStream<'c, Database<Row>>
    where
        'q: 'c,
    {
        match conn {
            Conn::Sqlite(conn) => bound!(self, sqlite(self.sql)).fetch(&mut **conn).map_ok(Row::Sqlite).boxed(),
            Conn::Postgres(conn) => bound!(self, postgres(&self.sql)).fetch(&mut **conn).map_ok(Row::Postgres).boxed(),
        }
    }
}

/// A statement that is put together.
#[derive(Debug)]
pub(super) struct Builder<'q> {
    sql: String,
    values: Vec<Value<'q>>,
}

impl<'q> Builder<'q> {
    pub(super) fn new(begin: &'static str) -> Self {
        Self { sql: begin.to_owned(), values: Vec::new() }
    }

    /// Adds text, which never has a user's words in it.
    pub(super) fn push(&mut self, sql: &'static str) -> &mut Self {
        self.sql.push_str(sql);
        self
    }

    /// Adds the name of a table or column of ours.
    pub(super) fn push_name(&mut self, name: &str) -> &mut Self {
        debug_assert!(name.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_'), "{name}");
        self.sql.extend(["\"", name, "\""]);
        self
    }

    /// Adds a value at this place.
    pub(super) fn push_bind(&mut self, value: impl Into<Value<'q>>) -> &mut Self {
        self.sql.push('?');
        self.bind(value)
    }

    /// Adds the value of a `?` that was pushed.
    pub(super) fn bind(&mut self, value: impl Into<Value<'q>>) -> &mut Self {
        self.values.push(value.into());
        self
    }

    /// Adds `VALUES` with a tuple for each row.
    pub(super) fn push_rows<T>(&mut self, rows: &[T], values: impl Fn(&mut Values<'_, 'q>, &T)) -> &mut Self {
        for (place, row) in rows.iter().enumerate() {
            self.sql.push_str(if place == 0 { "VALUES (" } else { ", (" });
            values(&mut Values { builder: self, is_first: true }, row);
            self.sql.push(')');
        }
        self
    }

    /// Ends the statement. It is not kept by the connection: others of its kind have another number of values.
    pub(super) fn build(self) -> Query<'q> {
        Query { sql: Cow::Owned(self.sql), values: self.values, is_kept: false }
    }
}

/// The tuple of one row.
#[derive(Debug)]
pub(super) struct Values<'b, 'q> {
    builder: &'b mut Builder<'q>,
    is_first: bool,
}

impl<'q> Values<'_, 'q> {
    pub(super) fn push_bind(&mut self, value: impl Into<Value<'q>>) -> &mut Self {
        if !std::mem::replace(&mut self.is_first, false) {
            self.builder.sql.push_str(", ");
        }
        self.builder.push_bind(value);
        self
    }
}

/// Returns the text for SQLite.
fn sqlite(sql: Cow<'static, str>) -> SqlStr {
    match sql {
        Cow::Borrowed(sql) if !sql.contains('{') => sql.into_sql_str(),
        sql => AssertSqlSafe(replaced(&sql, word_of_sqlite)).into_sql_str(),
    }
}

/// Returns the text for PostgreSQL.
fn postgres(sql: &str) -> SqlStr {
    AssertSqlSafe(numbered(&replaced(sql, word_of_postgres))).into_sql_str()
}

/// Replaces the words in braces. `word` gets a word and its argument.
fn replaced(sql: &str, word: fn(&str, &str) -> String) -> String {
    let mut text = String::with_capacity(sql.len() + 100);
    let mut rest = sql;
    while let Some((before, after)) = rest.split_once('{') {
        let (inside, after) = after.split_once('}').unwrap_or((after, ""));
        let (name, argument) = inside.split_once(' ').unwrap_or((inside, ""));
        text.push_str(before);
        text.push_str(&word(name, argument));
        rest = after;
    }
    text.push_str(rest);
    text
}

fn word_of_sqlite(name: &str, argument: &str) -> String {
    match name {
        "texts" | "numbers" => format!("(SELECT value FROM json_each({argument}))"),
        "places" | "pairs" => format!("json_each({argument})"),
        "stages" => format!("json_each({argument}, '$.stages')"),
        "least" => "min".into(),
        "greatest" => "max".into(),
        "find" => "instr".into(),
        "lower" => "lower".into(),
        "added_history" => "(SELECT seq FROM sqlite_sequence WHERE name = 'history')".into(),
        other => panic!("`{{{other}}}` is no word of a statement"),
    }
}

fn word_of_postgres(name: &str, argument: &str) -> String {
    match name {
        "texts" => format!("(SELECT json_array_elements_text({argument}::json))"),
        "numbers" => format!("(SELECT json_array_elements_text({argument}::json)::bigint)"),
        "places" => format!(
            "(SELECT value::text::bigint AS value, ordinality AS key FROM json_array_elements({argument}::json) WITH ORDINALITY)"
        ),
        "pairs" => format!("json_each_text({argument}::json)"),
        "stages" => format!("stride_stages({argument})"),
        "least" => "least".into(),
        "greatest" => "greatest".into(),
        "find" => "strpos".into(),
        "lower" => "stride_lower".into(),
        "added_history" => "(SELECT newest FROM history_numbers)".into(),
        other => panic!("`{{{other}}}` is no word of a statement"),
    }
}

/// Numbers the values: `?` and `?2` become `$1` and `$2`.
fn numbered(sql: &str) -> String {
    let mut text = String::with_capacity(sql.len() + 20);
    let mut rest = sql;
    let mut next = 1;
    while let Some((before, after)) = rest.split_once('?') {
        let digits = after.bytes().take_while(u8::is_ascii_digit).count();
        text.push_str(before);
        let (number, after) = after.split_at(digits);
        match number {
            "" => {
                // Writing to a string succeeds.
                let _ = write!(text, "${next}");
                next += 1;
            }
            number => text.extend(["$", number]),
        }
        rest = after;
    }
    text.push_str(rest);
    text
}

/// Runs a statement and returns how many rows it changed.
pub(super) async fn run(conn: &mut Conn<'_>, query: Query<'_>) -> Result<u64> {
    query.execute(conn).await.map_err(write_error)
}

pub(super) async fn one(conn: &mut Conn<'_>, query: Query<'_>) -> Result<Option<Row>> {
    query.fetch_optional(conn).await.map_err(write_error)
}

/// Runs `begin` with a tuple of values for each row, and `end`, as few statements as there may be.
pub(super) async fn insert<'q, T>(
    conn: &mut Conn<'_>,
    begin: &'static str,
    rows: &[T],
    values: impl Fn(&mut Values<'_, 'q>, &T),
    end: &'static str,
) -> Result<()> {
    for rows in rows.chunks(ROWS) {
        let mut query = Builder::new(begin);
        query.push_rows(rows, &values).push(end);
        run(conn, query.build()).await?;
    }
    Ok(())
}

/// The databases' integers are signed; none of our counters comes near the sign.
pub(super) fn int(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

pub(super) fn json<T: serde::Serialize + ?Sized>(value: &T) -> String {
    // Maps of names to numbers or digests always serialise.
    serde_json::to_string(value).unwrap_or_else(|e| panic!("cannot serialise a row: {e}"))
}

/// Splits a task's name into run and stage.
pub(super) fn run_and_stage(task: &TaskId) -> (&str, &str) {
    let mut parts = task.as_str().split('/');
    (parts.next().unwrap_or_default(), parts.next().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_numbered_in_order_or_as_written() {
        assert_eq!(numbered("a = ? AND b = ? LIMIT ?"), "a = $1 AND b = $2 LIMIT $3");
        assert_eq!(numbered("?2 IS NULL OR a = ?2 AND b = ?13"), "$2 IS NULL OR a = $2 AND b = $13");
    }

    #[test]
    fn words_are_replaced_with_their_arguments() {
        let sql = "SELECT {least}(a, ?) FROM {stages runs.view} AS s WHERE b IN {texts ?2}";
        let expected =
            "SELECT min(a, ?) FROM json_each(runs.view, '$.stages') AS s WHERE b IN (SELECT value FROM json_each(?2))";
        assert_eq!(replaced(sql, word_of_sqlite), expected);
        assert!(replaced(sql, word_of_postgres).contains("stride_stages(runs.view) AS s"));
    }
}
