//! Columns of the tables: the metrics of the field with their headings and directions.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Direction in which a metric is better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Better {
    /// A smaller value is better, such as a distance.
    Lower,
    /// A larger value is better, such as a hit rate.
    Higher,
    /// A value closer to that of real motion is better.
    NearReal,
    /// The metric is a property without a better direction.
    Neither,
}

/// A metric with a column in tables.
#[derive(Debug)]
pub(super) struct Column {
    pub(super) key: &'static str,
    /// Heading of the column.
    pub(super) head: &'static str,
    pub(super) better: Better,
}

const fn column(key: &'static str, head: &'static str, better: Better) -> Column {
    Column { key, head, better }
}

/// Columns in the order of text-to-motion papers, then reconstruction and control, then metrics without an evaluator, and last the
/// physical ones. A leaderboard without a metric ranks by the first column that its rows have.
pub(super) const COLUMNS: [Column; 32] = [
    column("aits", "AITS (s)", Better::Lower),
    column("r_precision_top1", "R@1", Better::Higher),
    column("r_precision_top2", "R@2", Better::Higher),
    column("r_precision_top3", "R@3", Better::Higher),
    column("fid", "FID", Better::Lower),
    column("mm_dist", "MM-Dist", Better::Lower),
    column("diversity", "Diversity", Better::NearReal),
    column("multimodality", "MModality", Better::Neither),
    column("mpjpe_mm", "MPJPE mm", Better::Lower),
    column("pa_mpjpe_mm", "PA-MPJPE mm", Better::Lower),
    column("acceleration_mm", "ACCEL mm", Better::Lower),
    column("feature_error", "Feat. err.", Better::Lower),
    column("sjpe", "sJPE", Better::Lower),
    column("sjpe_noise", "sJPE noise", Better::Lower),
    column("sjpe_static", "sJPE static", Better::Lower),
    column("trajectory_error", "Traj. err.", Better::Lower),
    column("location_error", "Loc. err.", Better::Lower),
    column("average_error_m", "Avg. err. (m)", Better::Lower),
    column("latent_fid", "Latent FID", Better::Lower),
    column("latent_fid_floor", "of real", Better::Neither),
    column("latent_fid_test", "Latent FID, test", Better::Lower),
    column("latent_fid_test_floor", "of real, test", Better::Neither),
    column("latent_r_precision_top1", "Latent R@1", Better::Higher),
    column("latent_r_precision_top3", "Latent R@3", Better::Higher),
    column("match", "Match", Better::Lower),
    column("latent_std", "Latent std", Better::Neither),
    column("latent_r_precision_top3_test", "Latent R@3, test", Better::Higher),
    column("accuracy", "Recognised", Better::Higher),
    column("skating_ratio", "Skating", Better::Lower),
    column("jerk", "Jerk m/s^3", Better::NearReal),
    column("penetration_mm", "Penetration mm", Better::Lower),
    column("bone_change_mm", "Bones mm", Better::Lower),
];

/// Data formats; the papers' datasets have the same names.
pub const FORMATS: [&str; 2] = ["humanml3d", "kit"];

/// Number of columns of the papers' text-to-motion table, which come first.
pub(super) const PAPER_COLUMNS: usize = 8;

pub(super) fn better(key: &str) -> Better {
    COLUMNS.iter().find(|column| column.key == key).map_or(Better::Neither, |column| column.better)
}
