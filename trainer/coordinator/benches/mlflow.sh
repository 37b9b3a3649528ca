#!/usr/bin/env bash
# Values, curves, lists of runs and of versions beside MLflow with SQLite: `trainer/coordinator/benches/mlflow.sh`.
# Needs python3 with venv, packages of PyPI, and a release build of `trainer` (or STRIDE_TRAINER).
# POINTS, RUNS, VERSIONS and ROUNDS change the sizes.
set -euo pipefail
cd "$(dirname "$0")/../../.."
target=${CARGO_TARGET_DIR:-target}
environment=${STRIDE_MLFLOW_ENV:-$target/mlflow}
[ -x "$environment/bin/python" ] || python3 -m venv "$environment"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check 'mlflow>=3,<4' 'httpx>=0.27'
export STRIDE_TRAINER=${STRIDE_TRAINER:-$target/release/trainer}
[ -x "$STRIDE_TRAINER" ] || { echo "there is no $STRIDE_TRAINER; run \`cargo build --release -p trainer\`" >&2; exit 1; }
exec "$environment/bin/python" trainer/coordinator/benches/mlflow_beside.py
