# For scripts of tests that need python3 and the built `trainer`. They set `name`, for messages, and then source this file.
# Sets `root`, the repository; `trainer`, the program: STRIDE_TRAINER, or the debug build; and `target`, cargo's build folder.
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
target=$(realpath -m "${CARGO_TARGET_DIR:-$root/target}")
trainer=$(realpath -m "${STRIDE_TRAINER:-$target/debug/trainer}")

# Ends the script, because of $1. Under CI that is a failure.
skipped() {
    echo "SKIPPED $name: $1"
    [ -z "${CI:-}" ] || exit 1
    exit 0
}

# Installs packages from PyPI, the arguments after $1, into the environment in $1.
python_with() {
    command -v python3 >/dev/null || skipped "no python3 here"
    [ -x "$1/bin/python" ] || python3 -m venv "$1" >/dev/null 2>&1 || skipped "python3 has no venv"
    "$1/bin/python" -m pip install --quiet --disable-pip-version-check "${@:2}" || skipped "pip cannot install its packages"
}

# A new token's secret.
secret() { head -c 24 /dev/urandom | base64 | tr '/+' '_-'; }

# Starts a server over a new store in the folder $1, with the tokens of $1/tokens and the options after $1.
# Sets `server`, its process, and `url`.
serve() {
    chmod 600 "$1/tokens"
    "$trainer" serve --store "$1/store" --bind 127.0.0.1:0 --token-file "$1/tokens" "${@:2}" >"$1/log" 2>&1 &
    server=$! url=
    for _ in $(seq 100); do
        url=$(grep -oE 'http://127\.0\.0\.1:[0-9]+' "$1/log" | head -1 || true)
        [ -z "$url" ] || return 0
        sleep 0.2
    done
    cat "$1/log"
    return 1
}
