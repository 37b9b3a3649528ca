#!/usr/bin/env bash
# Types and tests of the Python client, against the built `target/debug/trainer` or that of STRIDE_TRAINER.
# It says SKIPPED if pip cannot install its packages; under CI that is a failure.
set -euo pipefail
cd "$(dirname "$0")"
skipped() {
    echo "SKIPPED clients/python: $1"
    [ -z "${CI:-}" ] || exit 1
    exit 0
}
command -v python3 >/dev/null || skipped "no python3 here"
root=$(cd ../.. && pwd)
environment=${STRIDE_PYTHON_ENV:-${CARGO_TARGET_DIR:-$root/target}/python}
if [ ! -x "$environment/bin/python" ]; then
    python3 -m venv "$environment" >/dev/null 2>&1 || skipped "python3 has no venv"
fi
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check -e '.[test]' || skipped "pip cannot install its packages"
export STRIDE_TRAINER=${STRIDE_TRAINER:-${CARGO_TARGET_DIR:-$root/target}/debug/trainer}
"$environment/bin/python" generate.py --check
"$environment/bin/mypy"
"$environment/bin/python" -m pytest -q "$@"
