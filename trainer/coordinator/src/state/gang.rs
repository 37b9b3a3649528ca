//! Membership of gangs: a list by rank. Rank 0 leads: it saves, records and reports.
//!
//! | change | some lost, `min` left | lost below `min` | joiners, room | joiners, full | `max` lowered |
//! |---|---|---|---|---|---|
//! | becomes | Regroup, survivors keep their order | Disband, or saves first | Regroup, joiners behind | Keep | Regroup, the first stay |
//!
//! Survivors keep their order, so rank 0 keeps its rank for as long as it lives. A regrouped gang is a new generation
//! of the same attempt; a disbanded one starts its next attempt from the newest checkpoint. If too few members are left
//! and one of them may hold the state, it saves before the gang is disbanded.

use protocol::WorkerId;
use protocol::message::Member;
use protocol::stage::WorkerRange;

/// The change of a gang's members.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// The members stay as they are.
    Keep,
    /// The gang continues as a new generation with these members.
    Regroup(Vec<Member>),
    /// Too few members are left.
    Disband,
}

/// The change after the loss of `lost`.
pub fn without(members: &[Member], lost: &[WorkerId], range: WorkerRange) -> Change {
    let left: Vec<Member> = members.iter().filter(|member| !lost.contains(&member.worker)).cloned().collect();
    if left.len() == members.len() {
        Change::Keep
    } else if left.len() < range.min.max(1) {
        Change::Disband
    } else {
        Change::Regroup(left)
    }
}

/// The change after admitting as many of `idle` as fit. A gang that is too large loses its last members; members with
/// the state stay first. That happens if another run that needs the same stage asks for fewer workers.
pub fn with(members: &[Member], idle: &[Member], range: WorkerRange, holds: impl Fn(&Member) -> bool) -> Change {
    let most = room(0, range);
    if members.len() > most {
        let mut ranks: Vec<usize> = (0..members.len()).collect();
        ranks.sort_by_key(|rank| !holds(&members[*rank]));
        ranks.truncate(most);
        ranks.sort_unstable();
        return Change::Regroup(ranks.into_iter().map(|rank| members[rank].clone()).collect());
    }
    let room = room(members.len(), range).min(idle.len());
    if room == 0 { Change::Keep } else { Change::Regroup(members.iter().chain(&idle[..room]).cloned().collect()) }
}

/// The first members of a new gang, if there are enough.
pub fn start(idle: &[Member], range: WorkerRange) -> Option<Vec<Member>> {
    (idle.len() >= range.min.max(1)).then(|| idle[..room(0, range).min(idle.len())].to_vec())
}

/// Returns true if a gang with `members` members admits another.
pub fn has_room(members: usize, range: WorkerRange) -> bool {
    room(members, range) > 0
}

fn room(members: usize, range: WorkerRange) -> usize {
    if range.max == 0 { usize::MAX } else { range.max.max(range.min).saturating_sub(members) }
}

#[cfg(test)]
mod tests {
    use protocol::Incarnation;

    use super::*;

    fn members(names: &[&str]) -> Vec<Member> {
        names
            .iter()
            .map(|name| Member { worker: (*name).into(), incarnation: Incarnation(1), peer_address: String::new() })
            .collect()
    }

    #[test]
    fn survivors_keep_their_order_and_joiners_come_behind() {
        let two_to_three = WorkerRange { min: 2, max: 3 };
        let abc = members(&["a", "b", "c"]);
        assert_eq!(without(&abc, &["x".into()], two_to_three), Change::Keep);
        assert_eq!(without(&abc, &["a".into()], two_to_three), Change::Regroup(members(&["b", "c"])));
        assert_eq!(without(&abc, &["a".into(), "c".into()], two_to_three), Change::Disband);
        assert_eq!(with(&abc, &members(&["d"]), two_to_three, |_| true), Change::Keep);
        assert_eq!(
            with(&members(&["c", "a"]), &members(&["b", "d"]), two_to_three, |_| true),
            Change::Regroup(members(&["c", "a", "b"]))
        );
        let one = WorkerRange { min: 1, max: 1 };
        assert_eq!(with(&abc, &[], one, |_| false), Change::Regroup(members(&["a"])));
        assert_eq!(with(&abc, &[], one, |member| member.worker.as_str() == "c"), Change::Regroup(members(&["c"])));
        assert_eq!(start(&members(&["a"]), two_to_three), None);
        assert_eq!(start(&members(&["a", "b", "c", "d"]), two_to_three), Some(abc));
        assert_eq!(start(&members(&["a", "b"]), WorkerRange::default()), Some(members(&["a", "b"])));
    }
}
