#!/usr/bin/env bash
# Random calls of every route, made from the server's own description, with a token that reads, one that submits and one
# that may do everything. No answer may be a fault of the server, none may be late, and each must be as it is described.
# Takes at most five minutes. Needs python3 with pip, and a built `trainer` (STRIDE_TRAINER, or that of `target`).
set -euo pipefail
cd "$(dirname "$0")/.."
skipped() {
    echo "SKIPPED schemathesis: $1"
    [ -z "${CI:-}" ] || exit 1
    exit 0
}
command -v python3 >/dev/null || skipped "no python3 here"
target=${CARGO_TARGET_DIR:-target}
trainer=${STRIDE_TRAINER:-$target/debug/trainer}
environment=${STRIDE_PYTHON_ENV:-$target/python}
[ -x "$environment/bin/python" ] || python3 -m venv "$environment" >/dev/null 2>&1 || skipped "python3 has no venv"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check 'schemathesis>=4,<5' || skipped "pip cannot install it"

dir=$(mktemp -d)
cleanup() {
    if [ -n "${server:-}" ]; then
        kill "$server" 2>/dev/null || true
        wait "$server" || true
    fi
    rm -rf "$dir"
}
trap cleanup EXIT
secret() { head -c 24 /dev/urandom | base64 | tr '/+' '_-'; }
read=$(secret) submit=$(secret) admin=$(secret)
printf '%s\n' "reader read $read" "submitter submit $submit" "operator admin $admin" >"$dir/tokens"
chmod 600 "$dir/tokens"
"$trainer" serve --store "$dir/store" --bind 127.0.0.1:0 --token-file "$dir/tokens" --max-calls-per-second 100000 >"$dir/log" 2>&1 &
server=$!
url=
for _ in $(seq 100); do
    url=$(grep -oE 'http://127\.0\.0\.1:[0-9]+' "$dir/log" | head -1 || true)
    [ -z "$url" ] || break
    sleep 0.2
done
[ -n "$url" ] || { cat "$dir/log"; exit 1; }

# A question may wait for news; random ones would wait for longer than the limits below.
printf '[parameters]\n"query.wait" = 0\n' >"$dir/schemathesis.toml"

failed=0
# A stream of events has no end, so it is left out.
for name in read submit admin; do
    printf '\n== %s\n' "$name"
    timeout 100 "$environment/bin/schemathesis" --config-file "$dir/schemathesis.toml" run "$url/v1/openapi.json" \
        --header "Authorization: Bearer ${!name}" \
        --exclude-path /v1/events \
        --checks not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance \
        --max-examples "${STRIDE_EXAMPLES:-20}" --request-timeout 10 --phases examples,coverage,fuzzing \
        --continue-on-failure --no-color || failed=1
done
kill -0 "$server" || { echo "the server has ended"; cat "$dir/log"; failed=1; }
exit "$failed"
