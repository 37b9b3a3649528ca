//! Roll-ups: aggregates of consecutive values of a series. They are stored beside the values, so a curve of a million
//! values is read in the time of some thousand rows, and every value counts.
//!
//! A bucket counts values, not steps: a value that is recorded every fifty steps would fill no bucket of steps.

/// Values in a bucket of the first level, and buckets of each level in a bucket of the next.
const FANS: [u64; LEVELS] = [64, 8, 8];
/// Levels of roll-ups, from 1: 64, 512 and 4,096 values.
pub(crate) const LEVELS: usize = 3;

/// Sum of some consecutive values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bucket {
    pub(crate) first_step: i64,
    pub(crate) last_step: i64,
    /// All values, and those of them that are not finite.
    pub(crate) count: u64,
    pub(crate) odd: u64,
    /// The smallest and the largest finite value; infinite while there is none.
    pub(crate) low: f64,
    pub(crate) high: f64,
    /// Of the finite values.
    pub(crate) sum: f64,
    /// The value of the last step, if it is finite.
    pub(crate) last: Option<f64>,
}

impl Bucket {
    /// Returns the bucket of one value.
    pub(crate) fn of(step: i64, value: Option<f64>) -> Self {
        let finite = value.filter(|value| value.is_finite());
        Self {
            first_step: step,
            last_step: step,
            count: 1,
            odd: u64::from(finite.is_none()),
            low: finite.unwrap_or(f64::INFINITY),
            high: finite.unwrap_or(f64::NEG_INFINITY),
            sum: finite.unwrap_or(0.0),
            last: finite,
        }
    }

    /// Adds the values of another bucket.
    pub(crate) fn merge(&mut self, other: &Self) {
        if other.last_step >= self.last_step {
            self.last = other.last;
        }
        self.first_step = self.first_step.min(other.first_step);
        self.last_step = self.last_step.max(other.last_step);
        self.count += other.count;
        self.odd += other.odd;
        self.low = self.low.min(other.low);
        self.high = self.high.max(other.high);
        self.sum += other.sum;
    }

    /// Returns the mean of the finite values; NaN if there is none.
    pub(crate) fn mean(&self) -> f64 {
        self.sum / (self.count - self.odd) as f64
    }
}

/// The values of a series that no stored bucket holds yet, level by level.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Open {
    /// The bucket that each level fills, and how many buckets of the level below are in it.
    filling: [Option<(Bucket, u64)>; LEVELS],
}

impl Open {
    /// Takes up a bucket of `level` that is stored, or a value as one of level 0. Adds those that are full now to `full`,
    /// each with its level.
    pub(crate) fn add(&mut self, level: usize, bucket: Bucket, full: &mut Vec<(usize, Bucket)>) {
        let mut bucket = bucket;
        for (level, &fan) in FANS.iter().enumerate().skip(level) {
            let (sum, parts) = match self.filling[level].take() {
                Some((mut sum, parts)) => {
                    sum.merge(&bucket);
                    (sum, parts + 1)
                }
                None => (bucket, 1),
            };
            if parts < fan {
                self.filling[level] = Some((sum, parts));
                return;
            }
            full.push((level + 1, sum));
            bucket = sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(values: impl IntoIterator<Item = (i64, f64)>) -> (Open, Vec<(usize, Bucket)>) {
        let mut open = Open::default();
        let mut full = Vec::new();
        for (step, value) in values {
            open.add(0, Bucket::of(step, Some(value)), &mut full);
        }
        (open, full)
    }

    #[test]
    fn buckets_count_values_whatever_their_steps_are() {
        let (open, full) = all((0..4_096 + 70).map(|i| (i * 50, i as f64)));
        let of = |level| full.iter().filter(|(l, _)| *l == level).map(|(_, bucket)| *bucket).collect::<Vec<_>>();
        let first = of(1);
        let third = of(3);
        assert_eq!((first.len(), of(2).len(), third.len()), (65, 8, 1));
        assert!(first.iter().all(|bucket| bucket.count == 64) && of(2).iter().all(|bucket| bucket.count == 512));
        assert_eq!((first[1].first_step, first[1].last_step), (64 * 50, 127 * 50));
        assert_eq!((third[0].low, third[0].high, third[0].last), (0.0, 4_095.0, Some(4_095.0)));
        assert_eq!((third[0].count, third[0].sum), (4_096, (0..4_096).sum::<i64>() as f64));
        let left: Vec<_> =
            open.filling.iter().map(|filling| filling.map(|(bucket, parts)| (bucket.count, parts))).collect();
        assert_eq!(left, [Some((6, 6)), Some((64, 1)), None]);
    }

    #[test]
    fn what_is_not_finite_is_counted_and_hides_nothing() {
        let odd = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
        let value = |i: i64| if i < 3 { odd[i as usize] } else { i as f64 };
        let (_, full) = all((0..64).map(|i| (i, value(i))));
        let (level, bucket) = full[0];
        assert_eq!((level, bucket.count, bucket.odd, bucket.low, bucket.high), (1, 64, 3, 3.0, 63.0));
        assert_eq!(bucket.mean(), (3..64).sum::<i64>() as f64 / 61.0);
        let (_, full) = all((0..64).map(|i| (i, if i == 63 { f64::NAN } else { 1.0 })));
        assert_eq!((full[0].1.last, full[0].1.mean()), (None, 1.0));
        let (_, full) = all((0..64).map(|i| (i, f64::NAN)));
        assert!(full[0].1.mean().is_nan() && full[0].1.odd == 64);
    }

    /// A writer that begins anew takes up what is stored.
    #[test]
    fn what_is_open_follows_from_what_is_stored() {
        let values = |range: std::ops::Range<i64>| range.map(|step| (step, step as f64));
        for end in [10, 64, 100, 600, 4_096, 5_000] {
            let (open, full) = all(values(0..end));
            let mut again = Open::default();
            let mut none = Vec::new();
            for level in (1..LEVELS).rev() {
                let above = full.iter().filter(|(of, _)| *of == level + 1).map(|(_, bucket)| bucket.last_step).max();
                for (_, bucket) in full.iter().filter(|(of, bucket)| *of == level && Some(bucket.last_step) > above) {
                    again.add(level, *bucket, &mut none);
                }
            }
            for (step, value) in values(end / 64 * 64..end) {
                again.add(0, Bucket::of(step, Some(value)), &mut none);
            }
            assert_eq!((again, none), (open, Vec::new()), "{end} values");
        }
    }
}
