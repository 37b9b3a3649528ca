#!/usr/bin/env bash
# Trains on an accelerator and compares with the CPU: tests/gpu.sh [wgpu|cuda]
# One training step of every kind and configs/smoke.yaml against flex, within the tolerances of tests/process/backends.rs; a kill and a
# resume there. Without a Vulkan device, Debian's software one is installed (root): everything runs on the CPU then, slowly.
# Builds the program once more, below target/gpu: a third of an hour on two cores.
set -euo pipefail
backend=${1:-wgpu}
root=$(cd "$(dirname "$0")/.." && pwd)
if [ "$backend" = wgpu ] && ! compgen -G '/usr/share/vulkan/icd.d/*.json' >/dev/null; then
    echo "no Vulkan driver is here: installing Debian's software one" >&2
    apt-get install -y --no-install-recommends mesa-vulkan-drivers libvulkan1
fi
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target/gpu}
export STRIDE_TEST_BACKEND=$backend XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-/tmp}
cd "$root"
# One selection of packages, and so one build: `cargo run` alone would turn on other features of third parties and compile all of it again.
tests=(cargo test --locked -p trainer -p models --features "trainer/$backend,models/$backend" --test process --test backends)
"${tests[@]}" --no-run
"$CARGO_TARGET_DIR/debug/trainer" devices
"${tests[@]}" -- --nocapture --test-threads 1 backend a_training_step a_lone_bias
