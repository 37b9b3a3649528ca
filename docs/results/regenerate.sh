#!/usr/bin/env bash
# Runs pipelines and writes the results of each: NAME.json, as `trainer run -o json` prints it, and NAME.md, the template NAME.in.md filled from it
# and from the pipeline. The book includes the text.
#
#   docs/results/regenerate.sh docs/results/bandai*.yaml
#   docs/results/regenerate.sh docs/results/mini.yaml --set dataset.path=PATH/TO/humanml3d-mini
#
# Arguments after the pipelines are those of `trainer run`. Results in the store are not computed again: a second run only writes the text.
# TRAINER and TABLES name existing binaries.
set -euo pipefail

[ $# -ge 1 ] && [ -f "$1" ] || { echo "usage: $0 PIPELINE.yaml... [options of trainer run]" >&2; exit 2; }
pipelines=()
while [ $# -ge 1 ] && [ -f "$1" ]; do
    pipelines+=("$(realpath "$1")")
    shift
done
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
built() { cargo build --quiet --release --locked -p "$1" --bin "$1" --manifest-path "$repository/Cargo.toml" && echo "$repository/target/release/$1"; }
trainer=${TRAINER:-$(built trainer)}
tables=${TABLES:-$(built tables)}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
sets=()
for ((i = 1; i <= $#; i++)); do
    case ${!i} in
        --set) j=$((i + 1)); sets+=(--set "${!j}") ;;
        --set=*) sets+=("${!i}") ;;
    esac
done
for pipeline in "${pipelines[@]}"; do
    base=${pipeline%.yaml}
    "$trainer" config show "$pipeline" "${sets[@]}" -o json > "$work/pipeline.json"
    "$trainer" run "$pipeline" "$@" -o json > "$work/run.json"
    "$tables" "$base.in.md" "$work/run.json" "$work/pipeline.json" "$work/text.md"
    cp "$work/run.json" "$base.json"
    mv "$work/text.md" "$base.md"
    echo "$base.json, $base.md"
done
