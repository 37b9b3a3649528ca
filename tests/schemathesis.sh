#!/usr/bin/env bash
# Random calls of every route, made from the server's own description, with a token that reads, one that submits and one
# that may do everything. No answer may be a fault of the server, none may be late, and each must be as it is described.
# Takes at most five minutes. Needs python3 with pip, and a built `trainer` (STRIDE_TRAINER, or that of `target`).
set -euo pipefail
name=schemathesis
. "$(dirname "$0")/common.sh"
environment=${STRIDE_PYTHON_ENV:-$target/python}
python_with "$environment" 'schemathesis>=4,<5'

dir=$(mktemp -d)
cleanup() {
    if [ -n "${server:-}" ]; then
        kill "$server" 2>/dev/null || true
        wait "$server" || true
    fi
    rm -rf "$dir"
}
trap cleanup EXIT
read=$(secret) submit=$(secret) admin=$(secret)
printf '%s\n' "reader read $read" "submitter submit $submit" "operator admin $admin" >"$dir/tokens"
serve "$dir" --max-calls-per-second 100000

# A question may wait for news; random ones would wait for longer than the limits below.
printf '[parameters]\n"query.wait" = 0\n' >"$dir/schemathesis.toml"

failed=0
# A stream of events has no end, so it is left out.
for scope in read submit admin; do
    printf '\n== %s\n' "$scope"
    timeout 100 "$environment/bin/schemathesis" --config-file "$dir/schemathesis.toml" run "$url/v1/openapi.json" \
        --header "Authorization: Bearer ${!scope}" \
        --exclude-path /v1/events \
        --checks not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance \
        --max-examples "${STRIDE_EXAMPLES:-20}" --request-timeout 10 --phases examples,coverage,fuzzing \
        --continue-on-failure --no-color || failed=1
done
kill -0 "$server" || { echo "the server has ended"; cat "$dir/log"; failed=1; }
exit "$failed"
