//! The list of runs, in parts, with filters. Indexes answer all of it, so that a part costs the same in a long list.

use std::collections::BTreeSet;

use protocol::message::{RunState, RunSummary};
use protocol::{Group, RunId};

use super::statement::{Builder, Conn, Row, json};
use crate::QueryError;
use crate::catalog::{RunListQuery, RunOrder, RunPage};

type Result<T> = std::result::Result<T, QueryError>;

/// Largest number of runs with the words looked for that one part compares with the other filters.
const CANDIDATES: u32 = 2_000;
/// Number of characters that the index of words knows.
const INDEXED: usize = 3;

/// A place in the list: the last row that a reader has seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    changed_ms: i64,
    number: i64,
}

impl Place {
    fn read(text: &str) -> Result<Self> {
        let parsed = text.split_once('.').and_then(|(changed_ms, number)| {
            Some(Self { changed_ms: changed_ms.parse().ok()?, number: number.parse().ok()? })
        });
        parsed.ok_or_else(|| {
            QueryError::Invalid(format!("`after` is `{text}`; expected the `next` of an earlier answer"))
        })
    }

    fn text(self) -> String {
        format!("{}.{}", self.changed_ms, self.number)
    }
}

/// Returns a part of the list. Runs of others than `group` are left out, if there is one.
pub(super) async fn page(conn: &mut Conn<'_>, asked: &RunListQuery, group: Option<&Group>) -> Result<RunPage> {
    let owner = match (group, &asked.owner) {
        (Some(group), Some(owner)) if group != owner => return Ok(RunPage::default()),
        (Some(group), _) => Some(group),
        (None, owner) => owner.as_ref(),
    };
    let after = asked.after.as_deref().map(Place::read).transpose()?;
    let words: Vec<String> = asked.words.split_whitespace().map(str::to_lowercase).collect();
    if !words.is_empty() && asked.order == RunOrder::Changed {
        return Err(QueryError::Invalid(
            "`q` finds runs in the order of submissions; expected no `sort=changed`".into(),
        ));
    }
    let found = match words.as_slice() {
        [] => None,
        // PostgreSQL has no index of words; it compares every row.
        _ if !conn.is_sqlite() => None,
        words => Some(candidates(conn, words, asked.order, after).await?),
    };
    let is_indexed = conn.is_sqlite();
    let selection = Selection { asked, owner, after, words: &words, found: found.as_deref(), is_indexed };
    let rows = selection.query().build().fetch_all(conn).await?;
    let shown = rows.len().min(asked.limit as usize);
    let more = rows.len() > shown;
    let last = rows[..shown].last().map(place).transpose()?;
    let full = found.as_ref().is_some_and(|found| found.len() >= CANDIDATES as usize);
    let next = match (more, full) {
        (true, _) => last,
        // Further runs may have the words.
        (false, true) => found.and_then(|found| Some(Place { changed_ms: 0, number: *found.last()? })),
        (false, false) => None,
    };
    let rows = rows[..shown].iter().map(summary).collect::<Result<_>>()?;
    Ok(RunPage { rows, next: next.map(Place::text) })
}

/// The rows of one page of the list.
struct Selection<'a> {
    asked: &'a RunListQuery,
    owner: Option<&'a Group>,
    after: Option<Place>,
    words: &'a [String],
    /// Numbers of the runs that may have the words, if an index knows them.
    found: Option<&'a [i64]>,
    is_indexed: bool,
}

impl Selection<'_> {
    /// One query for each state, because the indexes begin with the state. Reads one row more than the page has.
    fn query(&self) -> Builder<'static> {
        let mut find = Builder::new("SELECT * FROM (");
        match self.states().split_first() {
            None => self.add_part(&mut find, None),
            Some((first, others)) => {
                self.add_part(&mut find, Some(*first));
                for state in others {
                    find.push(" UNION ALL ");
                    self.add_part(&mut find, Some(*state));
                }
            }
        }
        find.push(") AS parts").push(order(self.asked.order)).push(" LIMIT ").push_bind(self.limit());
        find
    }

    fn limit(&self) -> i64 {
        i64::from(self.asked.limit) + 1
    }

    /// The states to read one by one; empty if the list is read in its own order.
    fn states(&self) -> Vec<RunState> {
        let all = [RunState::Running, RunState::Paused, RunState::Finished, RunState::Failed, RunState::Cancelled];
        let asked = self.asked;
        if !asked.states.is_empty() {
            return all.into_iter().filter(|state| asked.states.contains(state)).collect();
        }
        if asked.pipeline.is_none() && self.owner.is_none() && asked.order != RunOrder::Changed {
            return Vec::new();
        }
        all.to_vec()
    }

    fn add_part(&self, find: &mut Builder<'_>, state: Option<RunState>) {
        find.push("SELECT * FROM (SELECT * FROM run_list WHERE true");
        if let Some(state) = state {
            find.push(" AND state = ").push_bind(state.name());
        }
        if let Some(pipeline) = &self.asked.pipeline {
            find.push(" AND pipeline = ").push_bind(pipeline.clone());
        }
        if let Some(owner) = self.owner {
            find.push(" AND owner = ").push_bind(owner.as_str().to_owned());
        }
        if let Some(found) = self.found {
            find.push(" AND number IN {numbers ?}").bind(json(found));
        }
        match (self.asked.order, self.after) {
            (_, None) => {}
            (RunOrder::Newest, Some(after)) => drop(find.push(" AND number < ").push_bind(after.number)),
            (RunOrder::Oldest, Some(after)) => drop(find.push(" AND number > ").push_bind(after.number)),
            (RunOrder::Changed, Some(after)) => {
                find.push(" AND (changed_ms, number) < (").push_bind(after.changed_ms).push(", ");
                find.push_bind(after.number).push(")");
            }
        }
        // A word that folds in other ways than SQLite's is left to the index.
        let by_index = |word: &String| self.is_indexed && !word.is_ascii() && word.chars().count() >= INDEXED;
        for word in self.words.iter().filter(|word| !by_index(word)) {
            let text = " AND {find}({lower}(run || ' ' || pipeline || ' ' || owner || ' ' || token || ' ' || note), ";
            find.push(text).push_bind(word.clone()).push(") > 0");
        }
        find.push(order(self.asked.order)).push(" LIMIT ").push_bind(self.limit()).push(") AS part");
    }
}

fn order(order: RunOrder) -> &'static str {
    match order {
        RunOrder::Newest => " ORDER BY number DESC",
        RunOrder::Oldest => " ORDER BY number",
        RunOrder::Changed => " ORDER BY changed_ms DESC, number DESC",
    }
}

/// The numbers of the next runs that may have all of the words, in the list's order.
async fn candidates(conn: &mut Conn<'_>, words: &[String], order: RunOrder, after: Option<Place>) -> Result<Vec<i64>> {
    let parts: BTreeSet<String> = words.iter().flat_map(|word| parts(word)).collect();
    let (table, number) = if parts.is_empty() { ("run_list", "number") } else { ("run_words", "rowid") };
    let mut find = Builder::new("SELECT ");
    find.push(number).push(" FROM ").push(table).push(" WHERE ").push(number);
    let oldest = order == RunOrder::Oldest;
    find.push(if oldest { " > " } else { " < " });
    find.push_bind(after.map_or(if oldest { 0 } else { i64::MAX }, |after| after.number));
    if !parts.is_empty() {
        let quoted: Vec<String> = parts.iter().map(|part| format!("\"{}\"", part.replace('"', "\"\""))).collect();
        find.push(" AND run_words MATCH ").push_bind(quoted.join(" AND "));
    }
    find.push(" ORDER BY ").push(number).push(if oldest { "" } else { " DESC" });
    find.push(" LIMIT ").push_bind(CANDIDATES);
    let rows = find.build().fetch_all(conn).await?;
    rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
}

/// All runs of three characters in a word; none if it is shorter.
fn parts(word: &str) -> impl Iterator<Item = String> + use<> {
    let letters: Vec<char> = word.chars().filter(|letter| *letter != '\0').collect();
    let parts: Vec<String> = letters.windows(INDEXED).map(|part| part.iter().collect()).collect();
    parts.into_iter()
}

fn place(row: &Row) -> Result<Place> {
    Ok(Place { changed_ms: row.try_get("changed_ms")?, number: row.try_get("number")? })
}

fn summary(row: &Row) -> Result<RunSummary> {
    let text = |column: &str| row.try_get::<String, _>(column);
    let count = |column: &str| -> Result<u32> {
        let count: i64 = row.try_get(column)?;
        u32::try_from(count).map_err(|_| QueryError::Database(format!("`{column}` of a run is {count}")))
    };
    let state = text("state")?;
    let owner = text("owner")?;
    let token = text("token")?;
    let known = RunState::named(&state);
    let state = known.ok_or_else(|| QueryError::Database(format!("`{state}` is no state of a run")))?;
    let project = owner.strip_prefix('@').map(str::to_owned);
    // The name of a token without a project is that of its group.
    let owner = if project.is_none() && token.is_empty() { owner } else { token };
    Ok(RunSummary {
        run: RunId::new(text("run")?),
        pipeline: text("pipeline")?,
        owner,
        project,
        state,
        interrupted: false,
        priority: 0,
        queued: false,
        created_ms: row.try_get("created_ms")?,
        changed_ms: row.try_get("changed_ms")?,
        done: count("done")?,
        stages: count("stages")?,
        wall_s: row.try_get("wall_s")?,
        wants_workers: None,
        note: text("note")?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_read_as_it_was_written() {
        let place = Place { changed_ms: 1_764_054_273_000, number: 12 };
        assert_eq!(Place::read(&place.text()).ok(), Some(place));
        for other in ["", "12", "a.b", "1.", ".1", "1.2.3"] {
            assert!(Place::read(other).is_err(), "{other}");
        }
    }

    #[test]
    fn words_are_looked_up_by_three_characters() {
        assert_eq!(parts("lösung").collect::<Vec<_>>(), ["lös", "ösu", "sun", "ung"]);
        assert_eq!(parts("ab").count(), 0);
    }
}
