//! Troubles of a seed besides kills, stops and cuts.

use std::str::FromStr;

/// The kind of trouble, as in `disk:3`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Hardship {
    /// Only kills, stops and cuts.
    None,
    /// One host has a slow line all the time.
    Slow,
    /// One host has a line of 30 KB/s all the time.
    Crawl,
    /// One worker refuses all connections; it connects to others.
    Refuse,
    /// Now and then a worker's messages do not reach the others, while it receives theirs.
    OneWay,
    /// The store's disk is full now and then.
    Full,
    /// Writes to the store's disk block now and then.
    Paused,
    /// After the run, the database is emptied once and blobs of its results are damaged. Then the pipeline is submitted
    /// again.
    Damaged,
}

impl Hardship {
    const ALL: [(&str, Self); 7] = [
        ("slow", Self::Slow),
        ("crawl", Self::Crawl),
        ("refuse", Self::Refuse),
        ("oneway", Self::OneWay),
        ("full", Self::Full),
        ("paused", Self::Paused),
        ("damaged", Self::Damaged),
    ];

    /// Returns true if the store needs its own disk.
    pub(crate) fn needs_disk(self) -> bool {
        matches!(self, Self::Full | Self::Paused)
    }
}

/// One run of the harness: `7`, or `full:7`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Seed {
    pub(crate) hardship: Hardship,
    pub(crate) number: u64,
}

impl FromStr for Seed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (kind, number) = text.split_once(':').map_or((None, text), |(kind, number)| (Some(kind), number));
        let known = Hardship::ALL;
        let hardship = match kind {
            None => Hardship::None,
            Some(kind) => {
                known.iter().find(|(name, _)| *name == kind).map(|(_, hardship)| *hardship).ok_or_else(|| {
                    let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
                    format!("`{kind}` is no hardship: expected one of {}", names.join(", "))
                })?
            }
        };
        let number = number.parse().map_err(|e| format!("`{number}` is no seed ({e}): expected a whole number"))?;
        Ok(Self { hardship, number })
    }
}

impl std::fmt::Display for Seed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match Hardship::ALL.iter().find(|(_, hardship)| *hardship == self.hardship) {
            Some((name, _)) => write!(f, "{name}:{}", self.number),
            None => write!(f, "{}", self.number),
        }
    }
}

/// SplitMix64: all events and their times are a function of the seed.
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Draws from `0..below`.
    pub(crate) fn index(&mut self, below: usize) -> usize {
        (self.next() % below as u64) as usize
    }

    /// Draws from `0..1`.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}
