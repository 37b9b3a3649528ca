#!/usr/bin/env bash
# Values, curves, lists of runs and of versions beside MLflow with SQLite: `trainer/coordinator/benches/mlflow.sh`.
# Needs python3 with venv, and packages of PyPI. Builds the server alone in release, and takes ten minutes, most of them MLflow's.
# POINTS, CURVE, RUNS, VERSIONS and ROUNDS change the sizes.
set -euo pipefail
cd "$(dirname "$0")/../../.."
target=${CARGO_TARGET_DIR:-target}
environment=${STRIDE_MLFLOW_ENV:-$target/mlflow}
[ -x "$environment/bin/python" ] || python3 -m venv "$environment"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check 'mlflow>=3,<4' 'httpx>=0.27'
cargo build --release --locked -p coordinator --example serve
export STRIDE_SERVE=$target/release/examples/serve
exec "$environment/bin/python" trainer/coordinator/benches/mlflow_beside.py
