//! The catalog in SQLite: connections, migrations, and the single writer.
//!
//! One connection writes from its own thread ([`writer`]); queries use read-only connections and see committed data.
//! `database is locked` cannot happen: there is no second writer, and readers of a WAL database never wait.

mod apply;
mod curves;
mod error;
mod forget;
mod history;
mod logs;
mod models;
mod moves;
mod open;
mod owners;
mod query;
mod recording;
mod retention;
mod rows;
mod run_list;
mod statement;
mod times;
mod usage;
mod writer;

use std::sync::Arc;

use async_trait::async_trait;

pub(crate) use open::{Opened, check_to_read, open_readers, open_writer, raise_epoch, reach_epoch};
pub(crate) use query::SqliteRecords;
pub(crate) use retention::held;
pub(crate) use writer::{Session, Writer};

use crate::WriteError;
use crate::catalog::{Catalog, Done, Order, Records};

/// A database that this process writes to.
#[derive(Debug)]
pub(crate) struct SqliteCatalog {
    pub(crate) writer: Writer,
    pub(crate) records: Arc<SqliteRecords>,
}

#[async_trait]
impl Catalog for SqliteCatalog {
    fn records(&self) -> Arc<dyn Records> {
        Arc::<SqliteRecords>::clone(&self.records)
    }

    async fn commit(&self, order: Order) -> Result<Done, WriteError> {
        self.writer.order(order).await
    }
}
