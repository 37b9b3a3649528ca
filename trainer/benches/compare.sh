#!/usr/bin/env bash
# Training and sampling beside PyTorch on this machine's CPU: `trainer/benches/compare.sh [--sizes quickstart|published|all] [--seconds N] [--only ROW] [--write FILE]`.
# Needs STRIDE_SHARED (its `bench/pytorch` has some of the networks and steps in PyTorch, `torch_kinds.py` the others) and python3 with venv; installs PyTorch from PyPI.
# Prints tables, and writes them to FILE. They name the processor and the load before. Takes some three hours.
set -euo pipefail
cd "$(dirname "$0")/../.."
target=${CARGO_TARGET_DIR:-target}
environment=${STRIDE_TORCH_ENV:-$target/torch}
[ -x "$environment/bin/python" ] || python3 -m venv "$environment"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check torch safetensors numpy
if [ -z "${STRIDE_TRAINER:-}" ]; then
    cargo build --release --locked -p trainer
    export STRIDE_TRAINER=$target/release/trainer
fi
exec "$environment/bin/python" trainer/benches/compare.py "$@"
