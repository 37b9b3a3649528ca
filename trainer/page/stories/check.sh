#!/usr/bin/env bash
# Tasks of people on the page, in Chromium: at 360 x 640 by touch and at 1280 by keyboard alone, in both themes, over real runs.
# Needs python3 with venv, packages of PyPI, Chromium, and `target/debug/trainer` or that of STRIDE_TRAINER.
# STRIDE_SCREENSHOTS=FOLDER keeps what it shows. STRIDE_PAGE=trainer/page/static shows these files in place of those in the program.
set -euo pipefail
name=trainer/page/stories
. "$(dirname "$0")/../../../tests/common.sh"
cd "$root/$name"
command -v "${STRIDE_BROWSER:-chromium}" >/dev/null || skipped "no Chromium here; \`apt-get install chromium\`, or set STRIDE_BROWSER"
environment=${STRIDE_PYTHON_ENV:-$target/python}
python_with "$environment" -e "$root/clients/python" 'playwright>=1.50' 'pytest>=8'
export STRIDE_TRAINER=$trainer
"$environment/bin/python" -m pytest -q -p no:cacheprovider "$@"
