//! A peer as a member of the gang sees it, and the decision to give it up.
//!
//! A silent peer is given up after [`Timing::patience`]. One that sends keep-alives but does not reach the barrier is
//! given up after [`Timing::stall`], or [`Timing::start`] before its first step.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use protocol::message::LossCause;

use super::frame::{Frame, Head};
use super::link::{Link, Pulse};
use super::member::{Phase, Timing};

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Standing {
    /// Not connected yet, with the reason of the last failure.
    Unmet(Option<String>),
    Up,
    /// Has left the gang in good order.
    Left,
    /// Has moved to a newer generation.
    Moved,
    Lost(LossCause, String),
}

#[derive(Debug)]
pub(super) struct Peer {
    pub(super) link: Option<Arc<Link>>,
    /// Received frames with their times of arrival.
    pub(super) inbox: VecDeque<(Instant, Frame)>,
    pub(super) pulse: Pulse,
    pub(super) standing: Standing,
    pub(super) phase: Phase,
    /// True while the connection of the generation before is expected to continue here.
    pub(super) inherits: bool,
    /// True while the peer has not used the link in this generation: it has sent nothing over one of the generation before,
    /// or has not welcomed this member over a new one.
    pub(super) is_unproven: bool,
    /// The frame that was sent first in this generation. A connection that replaces an inherited one begins with it.
    pub(super) first: Option<Head>,
}

impl Peer {
    /// A peer without a connection.
    pub(super) fn new() -> Self {
        Self {
            link: None,
            inbox: VecDeque::new(),
            pulse: Pulse::new(),
            standing: Standing::Unmet(None),
            phase: Phase::Working,
            inherits: false,
            is_unproven: false,
            first: None,
        }
    }

    /// Judges a peer that has not sent a sign for `silent` and that a stage has awaited for `waited`.
    pub(super) fn verdict(&self, timing: &Timing, patience: Patience, silent: Duration, waited: Duration) -> Verdict {
        let limit = timing.patience.as_secs_f32();
        let too_late = |limit: Duration, how: &str| {
            if waited <= limit {
                return Verdict::Waits;
            }
            Verdict::GiveUp(format!("it is alive, but {how} after {} s", limit.as_secs_f32()))
        };
        match &self.standing {
            Standing::Lost(..) | Standing::Moved => Verdict::Lost,
            Standing::Left if patience == Patience::WhileItLives => Verdict::Waits,
            Standing::Left => Verdict::GiveUp("it has left".to_owned()),
            Standing::Unmet(why) if silent > timing.patience => {
                let why = why.as_deref().unwrap_or("it did not connect");
                Verdict::GiveUp(format!("no connection within {limit} s: {why}"))
            }
            Standing::Up if silent > timing.patience => Verdict::GiveUp(format!("no heartbeat for {limit} s")),
            Standing::Up if self.phase == Phase::Starting => too_late(timing.start, "has not started"),
            Standing::Up => too_late(timing.stall, "has not reached this barrier"),
            Standing::Unmet(_) => Verdict::Waits,
        }
    }
}

/// Result of a look at a peer that a stage waits for.
pub(super) enum Verdict {
    Waits,
    /// The peer is lost already, or has moved to another gang.
    Lost,
    /// The peer must be given up, for this reason.
    GiveUp(String),
}

/// Limit of a wait for a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Patience {
    /// Until its turn is overdue ([`Timing::stall`], [`Timing::start`]).
    ForItsTurn,
    /// As long as it sends keep-alives.
    WhileItLives,
}
