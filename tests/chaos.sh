#!/usr/bin/env bash
# Breaks training runs on purpose: tests/chaos.sh [--full] [HARDSHIP:]SEED...
# Three workers, a coordinator, all stages of the quickstart at reduced sizes (--full: at full size); see tests/src/bin/chaos/main.rs.
# A hardship is added to kills, stops and cuts: slow (one slow line), crawl (one of 30 KB/s), refuse (one worker refuses connections),
# oneway (now and then one worker's messages are lost), full (a disk that fills up), paused (a disk that blocks), damaged (files of the
# store change after the run, which is then submitted again). Lines need root and network namespaces, disks root and a loop device.
# TRAINER=path uses an existing build of the trainer.
set -euo pipefail
if [ $# -eq 0 ]; then
    echo "usage: tests/chaos.sh [--full] [HARDSHIP:]SEED..., for example tests/chaos.sh \$(seq 1 20) slow:1 crawl:1 refuse:1 oneway:1 full:1 paused:1 damaged:1" >&2
    exit 2
fi
root=$(cd "$(dirname "$0")/.." && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
if [ -z "${TRAINER:-}" ]; then
    cargo build --manifest-path "$root/Cargo.toml" --release --locked -p trainer
    TRAINER=$target/release/trainer
fi
cargo build --manifest-path "$root/Cargo.toml" --locked --workspace --bin chaos
exec "$target/debug/chaos" "$TRAINER" "$@"
