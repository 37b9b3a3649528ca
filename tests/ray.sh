#!/usr/bin/env bash
# Runs configs/smoke.yaml on the workers that the command of docs/book/src/clusters.md starts as actors of a real Ray here.
# Needs python3 with pip, and a built `trainer` (STRIDE_TRAINER, or that of `target`).
set -euo pipefail
name=ray
. "$(dirname "$0")/common.sh"
cd "$root"
environment=$(realpath -m "${STRIDE_RAY_ENV:-$target/ray}")
python_with "$environment" 'ray>=2.40,<3'

dir=$(mktemp -d)
server= actors=
cleanup() {
    for pid in $actors $server; do
        kill "$pid" 2>/dev/null || true
        wait "$pid" || true
    done
    rm -rf "$dir"
}
trap cleanup EXIT
umask 077
echo "me admin $(secret)" >"$dir/me.token"
echo "nodes worker $(secret)" >"$dir/nodes.token"
cat "$dir"/*.token >"$dir/tokens"
serve "$dir"

# The book's command, with this server, our files, two workers and no GPU.
command=$(awk '/<!-- run by tests\/ray.sh -->/ { found = 1 } found && /^python/ { print; exit }' docs/book/src/clusters.md)
command=$(sed -e "s|^python|$environment/bin/python|" -e "s|https://coordinator:7700|$url|" -e "s|/shared/|$dir/|g" \
    -e 's| --ca [^ ]*||' -e "s|--workers 4 --gpus 1|--workers 2 --program $trainer|" <<<"$command")
[[ $command == *"--workers 2 --program"*"$url"*"$dir/nodes.token"* ]] || { echo "clusters.md has another command: $command"; exit 1; }
RAY_AUTH_MODE=disabled RAY_DEDUP_LOGS=0 $command >"$dir/ray.log" 2>&1 &
actors=$!
joined() {
    for _ in $(seq 300); do
        [ "$(grep -c 'joined worker=' "$dir/ray.log")" -lt "$1" ] || return 0
        sleep 0.2
    done
    cat "$dir/ray.log"
    echo "$1 workers have not joined"
    return 1
}
joined 2
# An actor is lost, and its worker with it. Ray starts another one.
worker=$(pgrep -f "worker join .*$dir/nodes.token" | head -1)
kill -9 "$(ps -o ppid= -p "$worker" | tr -d ' ')"
joined 3
for _ in $(seq 50); do
    # A dead process that its parent has not read yet is a zombie.
    case $(ps -o stat= -p "$worker" || true) in "" | Z*) worker= && break ;; esac
    sleep 0.2
done
[ -z "$worker" ] || { echo "a worker outlives its actor"; exit 1; }
"$trainer" submit configs/smoke.yaml --follow --server "$url" --token-file "$dir/me.token" >"$dir/run.log" 2>&1 ||
    { cat "$dir/run.log" "$dir/ray.log"; exit 1; }
kill -TERM "$actors"
status=0
wait "$actors" || status=$?
actors=
[ "$status" = 0 ] || { cat "$dir/ray.log"; echo "the actors ended with $status"; exit 1; }
left=$(grep -c 'draining' "$dir/ray.log" || true)
[ "$left" = 2 ] || { cat "$dir/ray.log"; echo "$left of 2 workers left"; exit 1; }
