//! The migrations of both databases, which `build.rs` embeds.

use std::borrow::Cow;
use std::sync::LazyLock;

use sqlx::SqlSafeStr as _;
use sqlx::migrate::{Migration, MigrationType, Migrator};

/// Number, description and text.
type Embedded = (i64, &'static str, &'static str);

include!(concat!(env!("OUT_DIR"), "/migrations.rs"));

pub(super) static OF_SQLITE: LazyLock<Migrator> = LazyLock::new(|| migrator(&SQLITE));
pub(super) static OF_POSTGRES: LazyLock<Migrator> = LazyLock::new(|| migrator(&POSTGRES));

fn migrator(embedded: &[Embedded]) -> Migrator {
    let mut migrations = Vec::new();
    for (version, description, sql) in embedded {
        let description = Cow::Borrowed(*description);
        migrations.push(Migration::new(*version, description, MigrationType::Simple, sql.into_sql_str(), false));
    }
    Migrator::with_migrations(migrations)
}

/// Returns the number of the newest migration.
pub(super) fn newest(migrator: &Migrator) -> i64 {
    migrator.iter().map(|migration| migration.version).max().unwrap_or(0)
}
