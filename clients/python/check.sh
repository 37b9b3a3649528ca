#!/usr/bin/env bash
# Types and tests of the Python client, against the built `target/debug/trainer` or that of STRIDE_TRAINER.
# It says SKIPPED if pip cannot install its packages; under CI that is a failure.
set -euo pipefail
name=clients/python
. "$(dirname "$0")/../../tests/common.sh"
cd "$root/$name"
environment=${STRIDE_PYTHON_ENV:-$target/python}
python_with "$environment" -e '.[test]'
export STRIDE_TRAINER=$trainer
"$environment/bin/python" generate.py --check
"$environment/bin/mypy"
"$environment/bin/python" -m pytest -q "$@"
