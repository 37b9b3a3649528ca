#!/usr/bin/env bash
# Breaks the code on purpose, one fault at a time, and expects a test to fail: tests/mutations.sh [NAME...]
# With --check as the first argument it compiles nothing: it only checks that the code of each fault still exists.
# Works on a copy of the last commit; builds into target/mutations, or into MUTATIONS_TARGET.
# Exits with 1 if no test finds a fault, or if the code that a fault changes no longer exists.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
# Not below /tmp, which a sandboxed worker may read: its test would fail without a fault.
mkdir -p "$root/target"
copy=$(mktemp -d "$root/target/mutation.XXXXXX")
export CARGO_TARGET_DIR=${MUTATIONS_TARGET:-$root/target/mutations}
git -C "$root" worktree add --quiet --force --detach "$copy" HEAD
trap 'git -C "$root" worktree remove --force "$copy"' EXIT
cd "$copy"
# Each fault is compiled anew and tested until the first program with a failure.
export CARGO_INCREMENTAL=1 CARGO_PROFILE_DEV_DEBUG=0
log=$copy/mutation.log
checks_only=
if [ "${1:-}" = --check ]; then checks_only=yes && shift; fi
wanted=("$@")
missed=0

# mutation NAME FILE PERL TESTS: PERL changes FILE, and one of TESTS must fail; the first failure ends the search. An element of
# TESTS is CRATE, CRATE:PROGRAM or CRATE:PROGRAM:FILTER, where PROGRAM is `lib` or a file of the crate's tests. Programs that are
# not named are neither linked nor run.
mutation() {
    local name=$1 file=$2 change=$3 tests=$4 begun=$SECONDS test crate program filter programs
    if [ ${#wanted[@]} -gt 0 ] && [[ ! " ${wanted[*]} " == *" $name "* ]]; then return; fi
    # A missing file is reported like a missing line.
    perl -0pi -e "$change" "$file" || true
    if git diff --quiet; then
        echo "$name: stands no longer in $file"
        missed=1
        return
    fi
    if [ -n "$checks_only" ]; then
        git checkout --quiet -- .
        return
    fi
    for test in $tests; do
        crate=${test%%:*} program=${test#*:}
        [ "$crate" != "$test" ] || program=
        filter=${program#*:} program=${program%%:*}
        [ "$filter" != "$program" ] || filter=
        case $program in
            '') programs=(--lib --tests) ;;
            lib) programs=(--lib) ;;
            *) programs=(--test "$program") ;;
        esac
        if cargo test --quiet --locked -p "$crate" "${programs[@]}" -- ${filter:+"$filter"} >"$log" 2>&1; then continue; fi
        if grep -q '^test result: FAILED' "$log"; then
            echo "$name ($((SECONDS - begun)) s): $(grep -E '^    [a-z_:0-9]+$' "$log" | sort -u | tr -s ' \n' ' ')"
        else
            echo "$name: does not compile"
            tail -20 "$log"
            missed=1
        fi
        git checkout --quiet -- .
        return
    done
    echo "$name: NO TEST FAILS"
    missed=1
    git checkout --quiet -- .
}

mutation leniency-times-ten trainer/coordinator/src/observe.rs 's/then\.after\(overslept\)\.min\(at\)/then.after(overslept * 10)/' coordinator:decisions
mutation back-off-times-ten trainer/coordinator/src/policy.rs 's/(self\.backoff_ms)\.saturating_mul/$1.saturating_mul(10).saturating_mul/' coordinator:decisions
mutation heard-is-lost trainer/coordinator/src/batch.rs 's/(Ask::Observation\(\.\.\) =>) [^,]*,/$1 {}/' coordinator:decisions:batches
mutation cancelled-shards-forgotten registry/src/sql/retention.rs "s/state = 'finished'/state IN ('finished', 'cancelled')/g" registry:retention
mutation synchronous-off registry/src/sql/sqlite.rs 's/SqliteSynchronous::Full/SqliteSynchronous::Off/' registry:lib:sqlite
mutation no-sync-of-a-blob registry/src/blob/fs.rs 's/self\.part\.file\.sync\(\)/Ok::<(), io::Error>(())/' registry:conformance
mutation no-sync-of-its-folder registry/src/blob/fs.rs 's/folder\.disk\.sync_dir\(shard\)/Ok::<(), io::Error>(())/' registry:conformance
mutation no-sync-of-the-operating-system registry/src/blob/disk.rs 's/(fn sync\(&mut self\) -> io::Result<\(\)> \{\s+)self\.sync_all\(\)/$1Ok(())/' "registry:disk registry:lib:disk registry"
mutation grace-0 registry/src/retention.rs 's/60 \* 60 \* 1000/0/' "registry:retention registry"
mutation no-touch registry/src/blob/store.rs 's/let touched = self\.backend\(\)\.touch\(digest\)\?;/let touched = stat;/' registry:conformance
mutation constant-nonce worker/src/gang/handshake.rs 's/getrandom::fill\(&mut bytes\)/getrandom::fill(&mut bytes[..0])/' worker:lib:gang
mutation token-over-plain-http trainer/access/src/connection.rs 's/find\(\|address\| !address\.is_local\(\)\)/find(|address| address.is_local())/' access:lib
mutation pipe-as-token-file trainer/access/src/file.rs 's/if file\.metadata\(\)\?\.is_file\(\)/if true/' access:lib
mutation lock-follows-links registry/src/blob/disk.rs 's/OFlag::O_NOFOLLOW \| //' registry:lib:lock
mutation gang-in-the-clear worker/src/gang/seal.rs 's/Ok\(stream\.local_addr\(\)\?\.ip\(\)\.to_canonical\(\) != .*\)$/Ok(stream.local_addr().is_err())/m' worker:lib:gang
mutation nonce-that-repeats worker/src/gang/seal.rs 's/bytes\[4\.\.\]\.copy_from_slice\(&number\.to_le_bytes\(\)\);/let _ = number; bytes[4] = 1;/' worker:lib:gang
mutation every-queued-run-is-visited trainer/coordinator/src/decide/schedule.rs 's/(let prepared = )(prepared_gangs)/cx.state.visits += cx.state.runs.size() as u64;\n    $1$2/' coordinator:decisions:queued
mutation a-rank-is-not-brought-up-to-date trainer/coordinator/src/state/apply.rs 's/(concerned\.append\(&mut self\.concerned\(fact\)\);)/$1\n        concerned.clear();/' coordinator:decisions
mutation parts-of-a-given-up-snapshot-count registry/src/sql/apply.rs 's/run\(conn, query\(given_up\)\.bind\(int\(seq\)\)\.bind\(int\(seq\)\)\)\.await\?;/let _ = given_up;/' registry:catalog_conformance
mutation readers-take-all-connections trainer/coordinator/src/shell/listener.rs 's/own >= limits\.of_token/own > limits.most/' coordinator:server:limits
mutation no-limit-of-calls trainer/coordinator/src/shell/rate.rs 's/bucket\.left < 1\.0/bucket.left < -1.0e9/' coordinator:lib:rate
mutation no-limit-of-live-runs trainer/coordinator/src/decide/runs.rs 's/if live < most \{/if live < most || most > 0 {/' coordinator:server:limits
mutation no-limit-of-a-runs-lines registry/src/sql/usage.rs 's/bind\(int\(log_bytes\)\)/bind(int(log_bytes * 0))/' coordinator:server:limits
mutation a-refused-blob-is-tried-again worker/src/blobs.rs 's/BlobError::Unfit\(message\)/BlobError::Unavailable(message)/' worker:lib:tests
mutation name-of-another-token trainer/coordinator/src/state/worker.rs 's/if own\.caller != by\.caller/if own.caller.is_empty()/' coordinator:server:workers
mutation name-of-a-live-process trainer/coordinator/src/state/worker.rs 's/if own\.secret == by\.secret =>/if !own.caller.is_empty() =>/' coordinator:server:workers
mutation failed-where-it-failed trainer/coordinator/src/decide/schedule.rs 's{if task.failed_on.is_empty\(\) }{if true }' coordinator:decisions:liveness
mutation a-leaving-worker-gets-work trainer/coordinator/src/state/worker.rs 's/self\.presence == Presence::Here && !self\.leaving/self.presence == Presence::Here/' coordinator:decisions:gangs
mutation a-gang-stops-when-a-member-leaves trainer/coordinator/src/decide/workers.rs 's/if goes_on \{/if goes_on \&\& self.state.draining {/' coordinator:decisions:gangs
mutation a-gang-loses-its-state-when-a-member-leaves trainer/coordinator/src/decide/workers.rs 's/stays\(member\) && holds\(member\)/stays(member) || holds(member)/' coordinator:decisions:gangs
mutation a-name-is-waited-for-once worker/src/assignments.rs 's/begun = Instant::now\(\);\n                if said/if said/' worker:lib:restart_of_the_coordinator
mutation name-beyond-its-pattern trainer/coordinator/src/shell/secrets.rs 's/\|names\| !names\.allow\(worker\.as_str\(\)\)/|_| false/' coordinator:server:workers
mutation poll-without-its-secret trainer/coordinator/src/shell/secrets.rs 's/if identity\.secret == Digest::of\(self\.secret\.0\.as_bytes\(\)\)/if !self.secret.0.contains("?")/' coordinator:server:workers
mutation grant-without-its-secret trainer/coordinator/src/shell/secrets.rs 's/if is\(secrets\.mac\(&\("grant", &self\.caller\.name, grant\)\), &self\.secret\.0\)/if !secrets.of_grant(&self.caller.name, grant).is_empty()/' coordinator:server:workers
mutation grant-of-every-token trainer/coordinator/src/shell/secrets.rs 's/\("grant", caller, grant\)/("grant", "", grant)/; s/\("grant", &self\.caller\.name, grant\)/("grant", "", grant)/' coordinator:server:workers
mutation receipt-of-every-process trainer/coordinator/src/shell/secrets.rs 's/\("upload", caller, &grant\.task, &grant\.worker, grant\.incarnation, digest\)/("upload", caller, grant.task.as_str().len(), digest)/' coordinator:server:workers
mutation manifest-of-foreign-blobs trainer/coordinator/src/shell/vouching.rs 's/return Ok\(Some\((next|file\.digest)\)\);/continue;/g' coordinator:server:workers
mutation mention-of-foreign-blobs trainer/coordinator/src/shell/vouching.rs 's/if leads_somewhere && seen\.insert\(other\)/if leads_somewhere \&\& seen.insert(other) \&\& queue.len() > 99/' coordinator:server:workers
mutation staged-of-everybody trainer/coordinator/src/shell/uploads.rs 's/let has_receipt = receipt\.is_some\(\)/let has_receipt = receipt.is_none()/' coordinator:server:workers
mutation sent-on-a-workers-word trainer/coordinator/src/shell/uploads.rs 's/blobs\.has_arrived\(&asked, digest\)/asked.fence.0 > 0 || blobs.has_arrived(\&asked, digest)/' coordinator:server:workers
mutation sent-by-anybody registry/src/blob/direct.rs 's/staged_name\(&\(holder\(grant\), digest\)\)/{ let _ = (grant, staged_name, holder); digest.hex() }/' registry:conformance:signed
mutation a-signed-put-of-any-bytes registry/src/blob/objects/signed.rs 's/\[\(CHECKSUM, &\*sum\), \(IF_NONE/[(IF_NONE/' registry:conformance:signed
mutation a-signed-put-that-overwrites registry/src/blob/objects/signed.rs 's/\(IF_NONE_MATCH, "\*"\), //' registry:conformance:signed
mutation a-copy-counts-as-sent registry/src/blob/objects/signed.rs 's/ && reported\(OWNER\) == Some\(name\)//' registry:conformance:signed
mutation worker-reads-everything trainer/coordinator/src/shell/uploads.rs 's/if !proof\.caller\.scopes\.allow\(Scope::Read\)/if proof.caller.scopes.allow(Scope::Promote)/' coordinator:server:workers
mutation poll-in-anothers-name trainer/coordinator/src/observe.rs 's/if \(&said\.grant\.worker, said\.grant\.incarnation\) != \(&worker, poll\.incarnation\)/if said.grant.worker.as_str().is_empty()/' coordinator:server:workers
mutation promotion-without-scope trainer/access/src/tokens.rs 's/if !allow\(Scope::Promote\)/if false/' "access:lib coordinator:server:owners::promotion"
mutation protected-from-none trainer/access/src/tokens.rs 's/Some\(names\) if !names\.contains\(name\) =>/Some(_) if false =>/' access:lib
mutation promotion-without-a-second-look trainer/coordinator/src/shell/effects.rs 's/&& let Err\(why\) = actor_handle\.may_promote\(&owner, &alias\)/\&\& let Err::<(), String>(why) = Ok(drop(alias.clone()))/' coordinator:server:promotion
mutation submission-promotes-unasked trainer/coordinator/src/shell/actor_handle.rs 's/self\.check_registrations\(&pipeline, &owner\)\.await\?;//' coordinator:server:promotion
mutation runs-of-others-are-shown trainer/coordinator/src/shell/records.rs 's/self\.sees\.as_ref\(\)\.is_none_or\(\|group\| run\.owner\.group\(\) == \*group\)/run.number > 0/' coordinator:server:owners::matrix
mutation runs-of-others-are-controlled trainer/coordinator/src/shell/queries.rs 's/owner\.is_some\(\) && !caller\.controls\(owner\.as_ref\(\)\)/false/' coordinator:server:owners::matrix
mutation models-of-others-are-taken registry/src/sql/owners.rs 's/if !is_its_own/if false \&\& !is_its_own/' registry:owners
mutation revoked-and-served trainer/coordinator/src/shell/token_table.rs 's/self\.changed\.send_modify\(\|version\| \*version \+= 1\);//' coordinator:server:owners::tokens
mutation expired-and-served trainer/access/src/expiry.rs 's/now_ms >= self\.at_ms/now_ms < self.at_ms \&\& false/' "access:lib coordinator:server:owners::tokens"
mutation refusals-one-by-one trainer/coordinator/src/shell/audit.rs 's/pending\.count\(kind, now_ms, REFUSED_MS\)/pending.line(kind.line(now_ms, now_ms, 1))/' coordinator:lib:audit
mutation links-out-of-a-data-root trainer/motion/src/roots.rs 's/ResolveFlag::RESOLVE_BENEATH \| //' motion:lib:data_access
mutation a-root-is-no-bound trainer/motion/src/data_access.rs 's/Some\(DataPath::beneath\(Arc::clone\(root\), root\.relative\(path\)\?, path\.to_owned\(\)\)\)/Some(DataPath::local(path))/' motion:lib:data_access
mutation errors-quote-files trainer/protocol/src/printable.rs 's/AtomicBool::new\(false\)/AtomicBool::new(true)/' "protocol:lib hostile:canary"
mutation digests-on-trust trainer/motion/src/data_access.rs 's/before\.digest != \*expected/false/' motion:lib:data_access
mutation changes-while-read-unseen trainer/motion/src/data_access.rs 's/Ok\(after\) if after == \*before =>/Ok(_) =>/' motion:lib:data_access
mutation keys-without-digests trainer/coordinator/src/state/run.rs 's/inputs\.contains_key\(&folder\.field\)/!folder.field.is_empty() || inputs.is_empty()/' coordinator:decisions:resolve
mutation named-without-proof registry/src/proofs.rs 's/(if inner\.is_condemned\(&artifact, proven\.since\)) \{/$1 \&\& false {/' registry:lib:proofs
mutation named-while-removed registry/src/proofs.rs 's/ended\.is_none_or\(\|ended\| ended > since\)/ended.is_some_and(|ended| ended > since)/' registry:lib:proofs
mutation decided-without-proof trainer/coordinator/src/shell/actor_handle.rs 's/if artifacts\.is_empty\(\)/if artifacts.len() < 100/' "coordinator:server:http coordinator:slow_bucket"
mutation silence-is-health registry/src/blob/objects/health.rs 's/silent >= SILENCE/silent >= SILENCE * 1000/' coordinator:slow_bucket
mutation lease-not-asked-for-a-name registry/src/proofs.rs 's/lease\.check\(\)\.map_err/Ok(()).map_err/' registry:lease
mutation lease-not-asked-for-a-removal registry/src/lease.rs 's/self\.check\(\)\.map_err\(\|e\| BlobError/Ok(()).map_err(|e: NoLease| BlobError/' registry:lease
mutation holder-not-refused registry/src/lease.rs 's/Some\(held\) if held != first => return Ok\(Err\(held\.by\)\),/Some(held) if held != first => return Ok(Ok(())),/' registry:lease
mutation joiner-outvotes-holder trainer/coordinator/src/state/evidence.rs 's/\(Self::Absent \| Self::Empty \| Self::Late, Self::Holds\(_\)\) => 0/(Self::Holds(_), Self::Empty) => 0/' coordinator:lib:evidence
mutation one-complaint-is-enough trainer/coordinator/src/state/evidence.rs 's/let over = at\.since\(since\) >= hearing_ms;/let over = true;/' "coordinator:lib:evidence coordinator:decisions:gangs"
mutation liar-stays trainer/coordinator/src/state/evidence.rs 's/Reverse\(degree\(rank\)\)/degree(rank)/' coordinator:lib:evidence
mutation word-outlives-membership trainer/coordinator/src/state/apply.rs 's/drop\(words\.remove\(&member\.worker\)\)/drop(words.get(\&member.worker))/' coordinator:decisions:gangs
mutation old-report-is-believed trainer/coordinator/src/state/evidence.rs 's/ && word\.grant\.fence == self\.task\.fence && !any_holds =>/ \&\& (any_holds || !any_holds) =>/' coordinator:lib:evidence
mutation suspicion-never-fades trainer/coordinator/src/decide/gangs.rs 's/saturating_sub\(u32::try_from\(faded\)[^)]*\)\)/saturating_sub(u32::try_from(faded * 0).unwrap_or(0))/' coordinator:decisions:gangs
mutation too-few-lose-their-state trainer/coordinator/src/decide/attempts.rs 's/!left\.is_empty\(\) && self\.may_hold/left.is_empty() \&\& self.may_hold/' coordinator:decisions:gangs
mutation failing-lead-ends-the-try trainer/coordinator/src/decide/outcome.rs 's/&& self\.state\.goes_on_without/\&\& !self.state.goes_on_without/' coordinator:decisions:gangs
mutation no-shares trainer/coordinator/src/decide/shares.rs 's/claimants\.len\(\) > 1/claimants.len() > 100/' coordinator:decisions:shares
mutation gangs-give-nothing trainer/coordinator/src/decide/moves.rs 's/own \+ 2/own + 200/' coordinator:decisions:shares
mutation unused-shares-come-again trainer/coordinator/src/decide/shares.rs 's/now\.since\(\*at\) < share_again_ms/now.since(*at) < share_again_ms \/ 1000/' coordinator:decisions:shares
mutation shares-for-ever trainer/coordinator/src/decide/shares.rs 's/idle_ms > self\.state\.policy\.share_ms/idle_ms > self.state.policy.share_ms * 100/' coordinator:decisions:shares
mutation priorities-across-groups trainer/coordinator/src/decide/shares.rs 's/\(self\.count\(claim\), self\.turns\.get\(&claim\.need\.claimant\.group\)\.copied\(\), claim\.rank\)/(self.count(claim), None, claim.rank)/' coordinator:decisions:priorities
mutation a-training-that-makes-way-is-recalled trainer/coordinator/src/state/task.rs 's/\(Some\(already\), None\) if \*preempted =>/(Some(already), None) if *preempted \&\& already.0 == 0 =>/' coordinator:decisions:priorities
mutation the-lower-priority-works-between-two-stages trainer/coordinator/src/decide/shares.rs 's/claims\.extend\(coming\);/drop(coming);/' coordinator:decisions:priorities
mutation resumed-and-stopped-again trainer/coordinator/src/decide/moves.rs 's/>= self\.policy\.stay_ms/>= 0 * self.policy.stay_ms/' coordinator:decisions:priorities
mutation no-limit-of-a-groups-workers trainer/coordinator/src/decide/schedule.rs 's/welcome\.truncate\(/let _ = (/' coordinator:decisions:limits
mutation queued-runs-begin trainer/coordinator/src/state/run.rs 's/self\.state == RunState::Running && !self\.queued/self.state == RunState::Running/' coordinator:decisions:limits
mutation no-limit-of-a-groups-bytes trainer/coordinator/src/shell/actor_handle.rs 's/self\.check_bytes\(&owner\.group\(\)\)\.await\?;//' coordinator:server:limits
mutation joins-without-reaching worker/src/prepare.rs 's/for Member \{ worker, peer_address, \.\. \} in &task\.peers \{/for Member { worker, peer_address, .. } in task.peers.iter().take(0) {/' worker:lib:prepare
mutation only-whole-frames-count worker/src/gang/link.rs 's/if count > 0 \{/if count > 1 << 20 {/' worker:lib:relay
mutation signs-behind-frames worker/src/gang/link.rs 's/writer\.sign\(sign, patience, abort\)\?;/let _ = sign;/' worker:lib:relay
mutation slow-is-not-named worker/src/gang/pace.rs 's/const FAR_OVER: u32 = 3;/const FAR_OVER: u32 = 3_000_000;/' worker:lib:gang
mutation silence-is-named-slow worker/src/gang/mesh.rs 's/ else if silent \{\n\s+self\.pace\.excuse_silence\(\);/ else if silent {/' worker:lib:gang::tests::relay
mutation finished-as-last-reported trainer/coordinator/src/view.rs 's/    progress\.done = progress\.total;\n//' coordinator:decisions:views
mutation new-run-with-each-start trainer/coordinator/src/decide/runs.rs 's/&& old\.until == run\.until/\&\& false/' coordinator:decisions:views
mutation paused-if-interrupted trainer/coordinator/src/state/run.rs 's/self\.parked && self\.state == RunState::Paused/false/' coordinator:decisions:views
mutation every-word-is-known trainer/motion/src/vocabulary.rs 's/!self\.words\.contains_key\(&word\) && //; s/!unknown\.contains\(&word\)/false \&\& !unknown.contains(\&word)/' motion:lib:vocabulary
mutation parts-of-a-killed-process-stay registry/src/retention.rs 's/self\.ask_blobs\(BlobStore::give_up_unfinished\)/self.ask_blobs(|_| Ok::<u64, BlobError>(0))/' registry:retention:upload
mutation upload-without-a-record registry/src/blob/objects/multipart.rs 's/store\.put\(&record, text\.into\(\)\)\.await\.map\(\|_\| \(\)\)/Ok(drop(text))/' registry:conformance:parts_that
mutation held-until-the-restart registry/src/store/orders.rs 's/self\.order\(Order::Hold \{ task: task\.clone\(\), digest \}\)\.await\?;//' registry:retention:upload
mutation digesting-goes-on trainer/motion/src/files.rs 's/if !go_on\(\) \{/if false \&\& !go_on() {/' motion:lib:data_access
mutation ended-states-stay trainer/coordinator/src/decide/outcome.rs 's/(keep, )at_end: true/$1at_end: false/' coordinator:decisions:ended
mutation training-waits-for-its-saves worker/src/saver.rs 's/self\.running = Some\(thread\);/self.running = Some(thread); self.wait();/' worker:lib:saves
mutation outcome-before-its-save worker/src/context.rs 's/self\.saver\.wait\(\);\n(        self\.telemetry\.flush)/$1/' worker:lib:saves
mutation saved-before-its-values worker/src/saver.rs 's/self\.telemetry\.flush\(self\.recorded\)/Ok(())/' worker:lib:p9
exit $missed
