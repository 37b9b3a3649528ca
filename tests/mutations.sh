#!/usr/bin/env bash
# Breaks the code on purpose, one fault at a time, and wants a test to fail: tests/mutations.sh [NAME...]
# Works on a copy of what is committed; what it builds lies in target/mutations, or where MUTATIONS_TARGET says.
# Ends with 1 if a fault is found by no test, or stands no longer where this file looks for it.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
copy=$(mktemp -d)
export CARGO_TARGET_DIR=${MUTATIONS_TARGET:-$root/target/mutations}
git -C "$root" worktree add --quiet --force --detach "$copy" HEAD
trap 'git -C "$root" worktree remove --force "$copy"' EXIT
cd "$copy"
log=$copy/mutation.log
wanted=("$@")
missed=0

# mutation NAME FILE PERL CRATES: PERL changes FILE, and a test of one of CRATES must fail; the first that has one ends the search.
mutation() {
    local name=$1 file=$2 change=$3 crates=$4 crate
    if [ ${#wanted[@]} -gt 0 ] && [[ ! " ${wanted[*]} " == *" $name "* ]]; then return; fi
    perl -0pi -e "$change" "$file"
    if git diff --quiet; then
        echo "$name: stands no longer in $file"
        missed=1
        return
    fi
    for crate in $crates; do
        if cargo test --quiet --locked --no-fail-fast -p "$crate" --lib --tests >"$log" 2>&1; then continue; fi
        if grep -q '^test result: FAILED' "$log"; then
            echo "$name: $(grep -E '^    [a-z_:0-9]+$' "$log" | sort -u | tr -s ' \n' ' ')"
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

mutation leniency-times-ten trainer/coordinator/src/observe.rs 's/heard\.after\(overslept\)\.min\(at\)/heard.after(overslept * 10)/' coordinator
mutation back-off-times-ten trainer/coordinator/src/policy.rs 's/(self\.backoff_ms)\.saturating_mul/$1.saturating_mul(10).saturating_mul/' coordinator
mutation heard-is-lost trainer/coordinator/src/batch.rs 's/(Ask::Observation\(\.\.\) =>) [^,]*,/$1 {}/' coordinator
mutation cancelled-shards-forgotten registry/src/sqlite/retention.rs "s/state = 'finished'/state IN ('finished', 'cancelled')/g" "registry coordinator"
mutation synchronous-off registry/src/sqlite/open.rs 's/SqliteSynchronous::Full/SqliteSynchronous::Off/' registry
mutation no-sync-of-a-blob registry/src/blob/fs.rs 's/self\.part\.file\.sync\(\)/Ok::<(), io::Error>(())/' "registry coordinator"
mutation no-sync-of-its-folder registry/src/blob/fs.rs 's/folder\.disk\.sync_dir\(shard\)/Ok::<(), io::Error>(())/' "registry coordinator"
mutation no-sync-of-the-operating-system registry/src/blob/disk.rs 's/(fn sync\(&mut self\) -> io::Result<\(\)> \{\s+)self\.sync_all\(\)/$1Ok(())/' registry
mutation grace-0 registry/src/retention.rs 's/60 \* 60 \* 1000/0/' "registry coordinator"
mutation no-touch registry/src/blob/store.rs 's/let touched = self\.backend\(\)\.touch\(digest\)\?;/let touched = stat;/' registry
mutation constant-nonce worker/src/gang/handshake.rs 's/getrandom::fill\(&mut bytes\)/getrandom::fill(&mut bytes[..0])/' worker
mutation token-over-plain-http trainer/access/src/connection.rs 's/ && !server\.is_local\(\)/ \&\& server.is_local()/' access
mutation pipe-as-token-file trainer/access/src/file.rs 's/if file\.metadata\(\)\?\.is_file\(\)/if true/' access
mutation lock-follows-links registry/src/blob/disk.rs 's/OFlag::O_NOFOLLOW \| //' registry
mutation gang-in-the-clear worker/src/gang/seal.rs 's/Ok\(stream\.local_addr\(\)\?\.ip\(\)\.to_canonical\(\) != .*\)$/Ok(stream.local_addr().is_err())/m' worker
mutation nonce-that-repeats worker/src/gang/seal.rs 's/bytes\[4\.\.\]\.copy_from_slice\(&number\.to_le_bytes\(\)\);/let _ = number; bytes[4] = 1;/' worker
mutation every-queued-run-is-visited trainer/coordinator/src/schedule.rs 's/(let prepared = )(prepared_gangs)/cx.state.visits += cx.state.runs.size() as u64;\n    $1$2/' coordinator
mutation a-rank-is-not-brought-up-to-date trainer/coordinator/src/state/apply.rs 's/(concerned\.append\(&mut self\.concerned\(fact\)\);)/$1\n        concerned.clear();/' coordinator
mutation parts-of-a-given-up-snapshot-count registry/src/sqlite/apply.rs 's/run\(conn, sqlx::query\(given_up\)\.bind\(int\(seq\)\)\.bind\(int\(seq\)\)\)\.await\?;/let _ = given_up;/' registry
mutation readers-take-all-connections trainer/coordinator/src/shell/listener.rs 's/own >= limits\.of_token/own > limits.most/' coordinator
mutation no-limit-of-calls trainer/coordinator/src/shell/rate.rs 's/bucket\.left < 1\.0/bucket.left < -1.0e9/' coordinator
mutation no-limit-of-live-runs trainer/coordinator/src/decide/runs.rs 's/if live < most \{/if live < most || most > 0 {/' coordinator
mutation no-limit-of-a-runs-lines registry/src/sqlite/usage.rs 's/bind\(int\(log_bytes\)\)/bind(0)/' coordinator
mutation a-refused-blob-is-tried-again worker/src/blobs.rs 's/BlobError::Unfit\(message\)/BlobError::Unavailable(message)/' worker
exit $missed
