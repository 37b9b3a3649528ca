//! Resolution of conflicts within a gang: the choice of members to remove when members lose contact.
//!
//! A complaint names two members and does not show which of them is at fault. A member that reaches no other reports
//! the same as one that no other reaches, and a lying member may report it too. Members are removed one by one until no
//! complaints are left among the rest, in this order:
//!
//! 1. a member without the training state, if the other one holds it, or may hold it and is silent;
//! 2. a member that may hold the state but is silent despite time to poll, if the other one holds it and polls;
//! 3. of two members without the state, the silent one;
//! 4. the member with the most complaints;
//! 5. a member that is called slow and does not say so of the other, unless the other is suspected more often;
//! 6. in a tie, the one with fewer steps; then any member except the lead; then the one suspected more often; then the
//!    higher rank.
//!
//! A member with the state never leaves in favour of one without it, and one side of each complaint stays. A gang with
//! a state therefore keeps it while a member that holds it polls. A silent member that may be the only holder stays
//! until its lease expires.
//!
//! Steps count only if they differ by at most one. Members of a generation step together, so a larger difference is an
//! error or a lie.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use protocol::WorkerId;
use protocol::message::{Doing, Grant, LossCause, LostPeer, Member};

use super::task::Task;
use crate::time::Millis;

/// The reports of a gang member about its work in its current attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Word {
    /// The newest grant of its reports.
    pub grant: Grant,
    /// The training steps of the state in its memory.
    pub holds: Option<u64>,
    /// The member that it waits for.
    pub waits_for: Option<WorkerId>,
    /// Its complaints in this generation.
    pub lost: BTreeSet<LostPeer>,
    /// The time of its first complaint in this generation.
    pub complained: Option<Millis>,
    /// The time of its last poll.
    pub heard: Millis,
    /// The time of its last new step.
    pub moved: Millis,
}

impl Word {
    /// Combines the known reports with `doing`, received at `at`. Polls can overtake each other, so reports within a
    /// generation are never withdrawn.
    pub fn after(known: Option<&Self>, doing: &Doing, at: Millis) -> Self {
        let same_process = |word: &&Self| {
            let old = &word.grant;
            let new = &doing.grant;
            (&old.task, old.attempt, old.incarnation) == (&new.task, new.attempt, new.incarnation)
        };
        let known = known.filter(same_process);
        let generation = known.filter(|word| word.grant.fence == doing.grant.fence);
        let mut lost = generation.map(|word| word.lost.clone()).unwrap_or_default();
        lost.extend(doing.lost.iter().cloned());
        let holds = known.and_then(|word| word.holds).max(doing.holds);
        let complained = generation.and_then(|word| word.complained).or((!lost.is_empty()).then_some(at));
        let moved = known.filter(|word| word.holds == holds).map_or(at, |word| word.moved);
        let heard = known.map_or(at, |word| word.heard.max(at));
        Self { grant: doing.grant.clone(), holds, waits_for: doing.waits_for.clone(), lost, complained, heard, moved }
    }
}

/// Reports by worker.
pub type Words = BTreeMap<WorkerId, Word>;

/// The reports of `member` in this attempt at `task`.
pub fn word<'a>(words: &'a Words, task: &Task, member: &Member) -> Option<&'a Word> {
    let word = words.get(&member.worker)?;
    let Grant { task: id, attempt, incarnation, .. } = &word.grant;
    ((id, *attempt, *incarnation) == (&task.id, task.attempt, member.incarnation)).then_some(word)
}

/// Training steps of the state that `member` is known to hold.
pub fn holds(words: &Words, task: &Task, member: &Member) -> Option<u64> {
    word(words, task, member)?.holds
}

/// Returns true if a member complains of another.
pub fn is_divided(words: &Words, task: &Task) -> bool {
    !Complaints::of(words, task, true).pairs.is_empty()
}

/// The rank of a member by its state and presence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Standing {
    /// Silent despite time to poll. Reported only initial state in this generation, in which no member holds more.
    Absent,
    /// Polling, with only initial state.
    Empty,
    /// Silent despite time to poll; may hold the state.
    Late,
    /// Polling, and holds the state after this many steps.
    Holds(u64),
}

impl Standing {
    fn is_present(self) -> bool {
        matches!(self, Self::Empty | Self::Holds(_))
    }

    /// The degree to which a member of standing `other` outranks this one: 0 is the strongest, 2 means not at all.
    fn outranked_by(self, other: Self) -> u8 {
        match (self, other) {
            (Self::Absent | Self::Empty | Self::Late, Self::Holds(_)) => 0,
            (Self::Absent | Self::Empty, Self::Late) => 1,
            _ => 2,
        }
    }
}

/// The complaints within a gang.
#[derive(Debug)]
pub struct Complaints<'a> {
    task: &'a Task,
    words: Vec<Option<&'a Word>>,
    /// Pairs of ranks, the lower one first, with the worst complaint.
    pairs: BTreeMap<(usize, usize), LossCause>,
}

/// The result of a hearing.
#[derive(Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Relevant members have not reported yet.
    Open,
    /// These members leave.
    Leave(Vec<Leaver>),
}

/// A member that leaves.
#[derive(Debug, PartialEq, Eq)]
pub struct Leaver {
    pub rank: usize,
    pub cause: LossCause,
    /// The member that complained of it, if the removed member polls and is in no other complaint. Then it is one
    /// report against another.
    pub accuser: Option<usize>,
}

impl<'a> Complaints<'a> {
    /// Collects the complaints of the current generation, with or without those about speed.
    pub fn of(words: &'a Words, task: &'a Task, slow: bool) -> Self {
        let members = task.holders();
        let said: Vec<Option<&Word>> = members.iter().map(|member| word(words, task, member)).collect();
        let mut pairs: BTreeMap<(usize, usize), LossCause> = BTreeMap::new();
        for (from, word) in said.iter().enumerate() {
            let current = word.filter(|word| word.grant.fence == task.fence);
            for LostPeer { worker, cause } in current.iter().flat_map(|word| &word.lost) {
                let of = members.iter().position(|member| member.worker == *worker).filter(|of| *of != from);
                if let Some(of) = of.filter(|_| slow || *cause != LossCause::Slow) {
                    let known = pairs.entry((from.min(of), from.max(of))).or_insert(*cause);
                    *known = worse(*known, *cause);
                }
            }
        }
        Self { task, words: said, pairs }
    }

    /// The members to remove according to the reports at `at`. The hearing waits at most `hearing_ms` after the first
    /// complaint.
    pub fn verdict(&self, at: Millis, hearing_ms: u64, suspicions: &[u32]) -> Verdict {
        let complained = self.words.iter().flatten().filter(|word| word.grant.fence == self.task.fence);
        let Some(since) = complained.filter_map(|word| word.complained).min() else {
            return Verdict::Leave(Vec::new());
        };
        let is_heard = |rank: usize| self.words[rank].is_some_and(|word| word.heard >= since);
        let ranks = 0..self.words.len();
        let over = at.since(since) >= hearing_ms;
        // A slow gang still makes progress, so there is time for the other side to complain as well.
        let is_urgent = self.pairs.values().any(|cause| *cause != LossCause::Slow);
        if !(over || is_urgent && ranks.clone().all(|rank| is_heard(rank) || self.is_clear_about(rank, is_heard))) {
            return Verdict::Open;
        }
        let any_holds = self.words.iter().flatten().any(|word| word.holds.is_some());
        let standing = |rank: usize| match self.words[rank] {
            Some(word) if is_heard(rank) => word.holds.map_or(Standing::Empty, Standing::Holds),
            // It may have taken the state from a holder, or have had it in an earlier generation, after that report.
            Some(word) if word.holds.is_none() && word.grant.fence == self.task.fence && !any_holds => Standing::Absent,
            Some(_) | None => Standing::Late,
        };
        Verdict::Leave(self.leave(&ranks.map(standing).collect::<Vec<_>>(), suspicions))
    }

    /// Returns true if no report of a member that has not polled yet could change the verdict. Three cases qualify:
    /// - It is known to hold the state, and none of its accusers does.
    /// - Several members complain of it, none of which has less of the state.
    /// - In a gang of two, the accuser holds the state, and this member is known to have none or would not lead even
    ///   with it.
    fn is_clear_about(&self, rank: usize, is_heard: impl Fn(usize) -> bool) -> bool {
        let holds = |rank: usize| self.words[rank].is_some_and(|word| word.holds.is_some());
        let may_hold = self.words[rank].is_none_or(|word| word.holds.is_some());
        let complain: Vec<usize> = self.neighbours(rank).filter(|other| is_heard(*other)).collect();
        let able = complain.iter().filter(|other| !may_hold || holds(**other)).count();
        let is_alone = self.words.len() == 2;
        able > 1
            || (holds(rank) && !complain.is_empty() && able == 0)
            || (is_alone && complain.iter().any(|other| holds(*other) && (!may_hold || *other == 0)))
    }

    fn complains(&self, from: usize, of: usize) -> bool {
        let worker = &self.task.holders()[of].worker;
        self.words[from].is_some_and(|word| word.lost.iter().any(|lost| lost.worker == *worker))
    }

    fn neighbours(&self, rank: usize) -> impl Iterator<Item = usize> + '_ {
        self.pairs.keys().filter_map(move |pair| other(*pair, rank))
    }

    fn leave(&self, standing: &[Standing], suspicions: &[u32]) -> Vec<Leaver> {
        let mut pairs: BTreeSet<(usize, usize)> = self.pairs.keys().copied().collect();
        let mut gone = Vec::new();
        while !pairs.is_empty() {
            let involved: BTreeSet<usize> = pairs.iter().flat_map(|(a, b)| [*a, *b]).collect();
            let degree = |rank: usize| pairs.iter().filter(|(a, b)| rank == *a || rank == *b).count();
            let outranked = |rank: usize| {
                let others = pairs.iter().filter_map(|pair| other(*pair, rank));
                others.map(|other| standing[rank].outranked_by(standing[other])).min()
            };
            let steps = involved.iter().filter_map(|rank| match standing[*rank] {
                Standing::Holds(steps) => Some(steps),
                Standing::Absent | Standing::Empty | Standing::Late => None,
            });
            let (least, most) = steps.fold((u64::MAX, 0), |(least, most), steps| (steps.min(least), steps.max(most)));
            let steps = |rank: usize| match standing[rank] {
                Standing::Holds(steps) if most - least <= 1 => steps,
                Standing::Absent | Standing::Empty | Standing::Late | Standing::Holds(_) => 0,
            };
            let is_slow = |rank: usize| {
                let by = pairs.iter().filter(|pair| self.pairs[pair] == LossCause::Slow);
                by.filter_map(|pair| other(*pair, rank)).any(|by| {
                    let is_trusted = suspicions[by] <= suspicions[rank];
                    self.complains(by, rank) && !self.complains(rank, by) && is_trusted
                })
            };
            let worth = |rank: &usize| {
                let (rank, present) = (*rank, standing[*rank].is_present());
                let equals = (steps(rank), rank == 0, Reverse(suspicions[rank]), Reverse(rank));
                (outranked(rank), present, Reverse(degree(rank)), !is_slow(rank), equals)
            };
            let Some(worst) = involved.into_iter().min_by_key(worth) else { break };
            gone.push(worst);
            pairs.retain(|(a, b)| *a != worst && *b != worst);
        }
        gone.sort_unstable();
        let leaver = |rank: usize| {
            let cause =
                self.neighbours(rank).map(|other| self.pairs[&(rank.min(other), rank.max(other))]).reduce(worse);
            let mut others = self.neighbours(rank);
            let only = others.next().filter(|_| others.next().is_none());
            let accuser = only.filter(|other| standing[rank].is_present() && !gone.contains(other));
            let accuser = accuser.filter(|other| self.complains(*other, rank));
            Leaver { rank, cause: cause.unwrap_or(LossCause::Unreachable), accuser }
        };
        gone.iter().copied().map(leaver).collect()
    }
}

/// The other rank of a pair, if `rank` is in it.
fn other((a, b): (usize, usize), rank: usize) -> Option<usize> {
    match rank {
        rank if rank == a => Some(b),
        rank if rank == b => Some(a),
        _ => None,
    }
}

/// The more serious cause.
fn worse(one: LossCause, other: LossCause) -> LossCause {
    let weight = |cause: LossCause| match cause {
        LossCause::Slow => 0,
        LossCause::Unreachable => 1,
        LossCause::Disagrees => 2,
    };
    if weight(other) > weight(one) { other } else { one }
}

/// The member that blocks a gang without a new step for `stall_ms`: others wait for it, and it waits for none. `None`
/// while any member makes steps or has not reported yet.
pub fn hung(words: &Words, task: &Task, at: Millis, stall_ms: u64) -> Option<usize> {
    let members = task.holders();
    let said: Option<Vec<&Word>> = members.iter().map(|member| word(words, task, member)).collect();
    let said = said.filter(|said| said.len() > 1)?;
    if said.iter().any(|word| at.since(word.moved) < stall_ms) {
        return None;
    }
    let is_waited_for = |rank: usize| said.iter().any(|word| word.waits_for.as_ref() == Some(&members[rank].worker));
    (0..said.len()).find(|rank| is_waited_for(*rank) && said[*rank].waits_for.is_none())
}

#[cfg(test)]
mod tests {
    use protocol::{Fence, Incarnation};

    use super::*;
    use crate::state::task::Part;

    const HEARING_MS: u64 = 2_500;

    /// Builds a gang. Each member has its steps, the ranks that it complains of, and a flag for a poll after the first
    /// complaint.
    fn gang(members: &[(Option<u64>, &[usize], bool)]) -> (Task, Words) {
        let member = |rank: usize| Member {
            worker: WorkerId::new(format!("w{rank}")),
            incarnation: Incarnation(1),
            peer_address: String::new(),
        };
        let mut task = Task::new("r/s".into(), Part::Gang);
        task.fence = Fence(6);
        task.grant((0..members.len()).map(member).collect(), |_| String::new());
        let said = members.iter().enumerate().map(|(rank, (holds, lost, heard))| {
            let grant = task.grant_of(&member(rank).worker, Incarnation(1));
            let complaint = |rank: &usize| LostPeer { worker: member(*rank).worker, cause: LossCause::Unreachable };
            let lost: Vec<LostPeer> = lost.iter().map(complaint).collect();
            let doing = Doing { holds: *holds, lost, ..Doing::new(grant, Default::default()) };
            let at = Millis(if *heard { 10_000 } else { 9_000 });
            (member(rank).worker, Word::after(None, &doing, at))
        });
        let words = said.collect();
        (task, words)
    }

    fn ranks(verdict: Verdict) -> Option<Vec<usize>> {
        match verdict {
            Verdict::Open => None,
            Verdict::Leave(leavers) => Some(leavers.into_iter().map(|leaver| leaver.rank).collect()),
        }
    }

    /// The members removed at once, and those removed when the hearing is over.
    fn judged(members: &[(Option<u64>, &[usize], bool)]) -> (Option<Vec<usize>>, Option<Vec<usize>>) {
        let (task, words) = gang(members);
        let complaints = Complaints::of(&words, &task, true);
        let at = |ms| ranks(complaints.verdict(Millis(ms), HEARING_MS, &vec![0; members.len()]));
        (at(10_000), at(10_000 + HEARING_MS))
    }

    #[test]
    fn a_joiner_without_the_state_leaves_whoever_complains() {
        let both = |leaves: usize| (Some(vec![leaves]), Some(vec![leaves]));
        assert_eq!(judged(&[(Some(159), &[], true), (None, &[0], true)]), both(1));
        assert_eq!(judged(&[(Some(159), &[1], true), (None, &[], false)]), both(1));
        assert_eq!(judged(&[(None, &[1], true), (Some(159), &[], true)]), both(0));
        // Three members complain of the only one with the state.
        let gang: &[(_, &[usize], _)] =
            &[(Some(9), &[], true), (None, &[0], true), (None, &[0], true), (None, &[0], true)];
        assert_eq!(judged(gang).1, Some(vec![1, 2, 3]));
    }

    #[test]
    fn of_two_holders_the_one_with_more_steps_stays_and_of_equals_the_lead() {
        assert_eq!(judged(&[(Some(7), &[], true), (Some(8), &[0], true)]).0, Some(vec![0]));
        assert_eq!(judged(&[(Some(8), &[], true), (Some(8), &[0], true)]).0, Some(vec![1]));
        assert_eq!(judged(&[(Some(8), &[], true), (Some(8_000_000), &[0], true)]).0, Some(vec![1]), "a lie");
        // The lead may be dead; it gets time to poll.
        assert_eq!(judged(&[(Some(9), &[], false), (Some(8), &[0], true)]), (None, Some(vec![0])));
        assert_eq!(judged(&[(Some(8), &[1], true), (Some(8), &[], false)]).0, Some(vec![1]), "no word would change it");
    }

    #[test]
    fn one_that_names_seven_leaves_alone_and_a_dead_one_that_all_name() {
        let seven: &[(_, &[usize], _)] = &[
            (Some(5), &[1, 2, 3, 4, 5, 6, 7], true),
            (Some(4), &[], false),
            (Some(4), &[], false),
            (Some(4), &[], false),
            (Some(4), &[], false),
            (Some(4), &[], false),
            (Some(4), &[], false),
            (Some(4), &[], false),
        ];
        assert_eq!(judged(seven).0, None, "they have time to speak");
        let mut heard = seven.to_vec();
        heard.iter_mut().for_each(|member| member.2 = true);
        assert_eq!(judged(&heard).0, Some(vec![0]));
        let dead: &[(_, &[usize], _)] =
            &[(Some(5), &[], false), (Some(5), &[0], true), (Some(5), &[0], true), (Some(5), &[0], true)];
        assert_eq!(judged(dead), (Some(vec![0]), Some(vec![0])), "at once");
    }

    #[test]
    fn a_single_holder_stays_though_all_others_are_silent_or_complain() {
        let gang: &[(_, &[usize], _)] = &[(None, &[2], true), (None, &[2], true), (Some(5), &[], true)];
        assert_eq!(judged(gang).1, Some(vec![0, 1]));
    }

    #[test]
    fn a_silent_members_report_of_no_state_counts_only_in_its_generation_and_beside_no_holder() {
        let members: &[(_, &[usize], _)] = &[(None, &[], false), (None, &[0], true)];
        assert_eq!(judged(members).1, Some(vec![0]));
        let (task, mut words) = gang(members);
        let verdict = |words: &Words, members: usize| {
            let complaints = Complaints::of(words, &task, true);
            ranks(complaints.verdict(Millis(10_000 + HEARING_MS), HEARING_MS, &vec![0; members]))
        };
        words.get_mut(&WorkerId::from("w0")).expect("a member").grant.fence = Fence(6);
        assert_eq!(verdict(&words, 2), Some(vec![1]), "it may have had the state since then");
        // A silent holder may have given its state to the silent member.
        let members: &[(_, &[usize], _)] = &[(None, &[], false), (None, &[0], true), (Some(3), &[], false)];
        assert_eq!(judged(members).1, Some(vec![1]));
    }

    #[test]
    fn a_complaint_weighs_on_its_author_unless_others_share_it() {
        let (task, words) = gang(&[(Some(8), &[1], true), (Some(8), &[], true)]);
        let complaints = Complaints::of(&words, &task, true);
        let Verdict::Leave(leavers) = complaints.verdict(Millis(20_000), HEARING_MS, &[0, 0]) else { panic!("open") };
        assert_eq!(leavers, [Leaver { rank: 1, cause: LossCause::Unreachable, accuser: Some(0) }]);
    }

    #[test]
    fn what_was_said_in_a_generation_is_not_taken_back_by_a_late_poll() {
        let (task, words) = gang(&[(Some(8), &[1], true), (Some(8), &[], true)]);
        let word = &words[&WorkerId::from("w0")];
        let grant = word.grant.clone();
        let late = Doing { holds: Some(3), ..Doing::new(grant.clone(), Default::default()) };
        let after = Word::after(Some(word), &late, Millis(9_500));
        assert_eq!((after.holds, &after.lost, after.heard), (Some(8), &word.lost, word.heard));
        let next = Doing::new(Grant { fence: task.fence.next(), ..grant }, Default::default());
        let next = Word::after(Some(word), &next, Millis(11_000));
        assert_eq!((next.holds, next.lost.len(), next.complained), (Some(8), 0, None));
    }

    #[test]
    fn the_member_that_all_wait_for_is_hung_once_nobody_moves() {
        let (task, mut words) = gang(&[(Some(8), &[], true), (Some(8), &[], true), (Some(8), &[], true)]);
        for (name, of) in [("w1", "w0"), ("w2", "w1")] {
            words.get_mut(&WorkerId::from(name)).expect("a member").waits_for = Some(of.into());
        }
        assert_eq!(hung(&words, &task, Millis(10_999), 1_000), None);
        assert_eq!(hung(&words, &task, Millis(11_000), 1_000), Some(0));
    }
}
