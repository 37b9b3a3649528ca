#!/usr/bin/env bash
# Tasks of people on the page, in Chromium: at 360 x 640 by touch and at 1280 by keyboard alone, in both themes, over real runs.
# Needs python3 with venv, packages of PyPI, Chromium, and `target/debug/trainer` or that of STRIDE_TRAINER.
# STRIDE_SCREENSHOTS=FOLDER keeps what it shows. STRIDE_PAGE=trainer/page/static shows these files in place of those in the program.
set -euo pipefail
cd "$(dirname "$0")"
skipped() {
    echo "SKIPPED trainer/page/stories: $1"
    [ -z "${CI:-}" ] || exit 1
    exit 0
}
command -v python3 >/dev/null || skipped "no python3 here"
command -v "${STRIDE_BROWSER:-chromium}" >/dev/null || skipped "no Chromium here; \`apt-get install chromium\`, or set STRIDE_BROWSER"
root=$(cd ../../.. && pwd)
environment=${STRIDE_PYTHON_ENV:-${CARGO_TARGET_DIR:-$root/target}/python}
[ -x "$environment/bin/python" ] || python3 -m venv "$environment" >/dev/null 2>&1 || skipped "python3 has no venv"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check -e "$root/clients/python" 'playwright>=1.50' 'pytest>=8' ||
    skipped "pip cannot install its packages"
export STRIDE_TRAINER=${STRIDE_TRAINER:-${CARGO_TARGET_DIR:-$root/target}/debug/trainer}
"$environment/bin/python" -m pytest -q -p no:cacheprovider "$@"
