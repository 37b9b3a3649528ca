//! The catalog in SQL, in SQLite or in PostgreSQL: connections, migrations, and the single writer.
//!
//! One connection writes from its own thread ([`writer`]); queries use other connections and see committed data. The
//! statements are the same for both databases ([`statement`]); [`sqlite`] and [`postgres`] open them. In SQLite,
//! `database is locked` cannot happen: there is no second writer, and readers of a WAL database never wait.

mod apply;
mod curves;
mod error;
mod forget;
mod history;
mod leader;
mod logs;
mod migrations;
mod models;
mod moves;
mod open;
mod owners;
mod pool;
pub(crate) mod postgres;
mod query;
mod recording;
mod retention;
mod rows;
mod run_list;
pub(crate) mod sqlite;
mod statement;
mod times;
pub(crate) mod transfer;
mod usage;
mod writer;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use protocol::{Digest, TaskId};

pub use leader::{LeaderTerms, Leadership};
pub(crate) use open::{Link, Opened};
pub(crate) use query::SqlRecords;
pub(crate) use writer::{Session, Writer};

use crate::catalog::{Catalog, Done, Order, Records};
use crate::{QueryError, WriteError};

/// A database that this process writes to.
#[derive(Debug)]
pub(crate) struct SqlCatalog {
    pub(crate) writer: Writer,
    pub(crate) records: Arc<SqlRecords>,
}

/// Reads the blobs of held tasks over the writing connection.
pub(crate) async fn held(link: &mut Link) -> Result<BTreeMap<TaskId, BTreeSet<Digest>>, QueryError> {
    retention::held(&mut link.conn()).await
}

#[async_trait]
impl Catalog for SqlCatalog {
    fn records(&self) -> Arc<dyn Records> {
        Arc::<SqlRecords>::clone(&self.records)
    }

    async fn commit(&self, order: Order) -> Result<Done, WriteError> {
        self.writer.order(order).await
    }
}
