#!/usr/bin/env bash
# Trains on an accelerator and compares with the CPU: tests/gpu.sh [wgpu|cuda]
# Compares one training step of every kind and configs/smoke.yaml with flex, within the tolerances of tests/process/backends.rs; also a
# kill and a resume. Without a Vulkan device, Debian's software one is installed (root): everything then runs on the CPU, slowly.
# Builds the program again, below target/gpu: 20 minutes on two cores.
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
# One selection of packages for one build: `cargo run` alone would turn on other features of third-party crates and recompile everything.
tests=(cargo test --locked -p trainer -p models --features "trainer/$backend,models/$backend" --test process --test backends)
"${tests[@]}" --no-run
"$CARGO_TARGET_DIR/debug/trainer" devices
"${tests[@]}" -- --nocapture --test-threads 1 backend a_training_step a_lone_bias
