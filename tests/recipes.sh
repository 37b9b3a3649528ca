#!/usr/bin/env bash
# Runs published recipes at their own widths, in a few small steps on synthetic clips: tests/recipes.sh [RECIPE...]
# Each is planned, then run with one, two and three workers, and once with the trainer killed and restarted in every training stage. The
# digests of all runs must be equal. RECIPE is a name in configs/; the default is all whose widths are published, without those for KIT-ML, and bandai.
# A worker of free-stablemofusion needs 12 GB of memory, and a training state of it 4.8 GB of disk.
# TRAINER is the program (a release build: an unoptimised one takes ten times as long), STEPS the steps of each training, BATCH the examples of a step, in three slices.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
trainer=${TRAINER:-$root/target/release/trainer} steps=${STEPS:-2} batch=${BATCH:-6}
recipes=("$@")
[ $# -gt 0 ] || recipes=(
    motionlcm motionlcm-v2 motionpcm motionlcm-control motionlcm-control-temporal motionlcm-control-spatial motionpcm-control
    momask-discord t2mgpt-discord mmm-discord mld-discord free-mdm free-stablemofusion free-mld bandai
)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# The stages of a recipe that train, in order.
training() {
    awk '/^ *#/ { next } /^  [a-z_0-9]+:/ { name = $1; sub(":", "", name) } /kind: (train|distill)\./ { print name }' "$1"
}

# The kind of a stage.
kind() {
    awk -v stage="$2" '/^ *#/ { next } /^  [a-z_0-9]+:/ { name = $1; sub(":", "", name) } name == stage && match($0, /kind: [a-z.0-9]+/) { print substr($0, RSTART + 6, RLENGTH - 6); exit }' "$1"
}

# Digests of the results of training and encoding.
digests() {
    python3 -c 'import json, sys; print("\n".join(s["name"] + " " + " ".join(sorted(s["outputs"].values())) for s in json.load(open(sys.argv[1]))["stages"] if s["outputs"]))' "$1"
}

for recipe in "${recipes[@]}"; do
    file=$root/configs/$recipe.yaml
    sets=(--set 'text={encoder: hashed}')
    if grep -q '^dataset:' "$file"; then
        sets+=(--set 'dataset={format: synthetic, clips: 40, val: 0.1, test: 0.2}')
    else
        sets+=(--set 'stages.dataset={kind: data.synthetic, clips: 40, val: 0.1, test: 0.2}')
    fi
    # A run needs all files of its pipeline, so the papers' evaluator is replaced. No training reads it.
    ! grep -q 'kind: import.evaluator' "$file" || sets+=(--set 'stages.evaluator={kind: train.evaluator}')
    # Half of the hashed words would be lost behind a ReLU, so a file with one is refused.
    ! grep -q 'text_relu: true' "$file" || sets+=(--set stages.mld.text_relu=false)
    for stage in $(training "$file"); do
        sets+=(--set "stages.$stage.steps=$steps" --set "stages.$stage.warmup=0" --set "stages.$stage.batch={global: $batch, slices: 3}")
        sets+=(--set "stages.$stage.checkpoint={every: 1, keep: {latest: 1}}")
        # Stages with their own batch size are cut into three slices too.
        case $(kind "$file" "$stage") in
        train.evaluator) sets+=(--set "stages.$stage.movement.batch=$batch") ;;
        train.vae) sets+=(--set "stages.$stage.windows.batch=$batch") ;;
        esac
    done
    echo "== $recipe: plan" >&2
    "$trainer" plan "$file" "${sets[@]}" --no-time --store "$work/none"
    # Runs every training stage to its end, in the store $2 with $1 workers; digests of all results go to $3.
    all() {
        for stage in $(training "$file"); do
            "$trainer" run "$file" "${sets[@]}" --until "$stage" --workers "$1" --store "$2" -o json >"$work/run.json"
            digests "$work/run.json"
        done | sort -u >"$3"
    }
    for workers in 1 2 3; do
        echo "== $recipe: $workers worker(s)" >&2
        all "$workers" "$work/$recipe-$workers" "$work/$workers.digests"
        diff "$work/1.digests" "$work/$workers.digests"
        rm -rf "$work/$recipe-$workers"
    done
    echo "== $recipe: killed in every training stage" >&2
    store=$work/$recipe-killed
    for stage in $(training "$file"); do
        "$trainer" run "$file" "${sets[@]}" --until "$stage" --workers 2 --store "$store" -o json >/dev/null 2>&1 &
        run=$!
        # A worker logs at once which stage it begins.
        until grep -qs "/$stage attempt=" "$store"/workers/*.log || ! kill -0 $run 2>/dev/null; do sleep 0.05; done
        kill -9 $run 2>/dev/null || true
        wait $run 2>/dev/null || true
    done
    all 2 "$store" "$work/killed.digests"
    diff "$work/1.digests" "$work/killed.digests"
    echo "$recipe: $(wc -l <"$work/1.digests") stages, the same digests with 1, 2 and 3 workers and after kills in $(training "$file" | wc -l) trainings"
    rm -rf "$store"
done
