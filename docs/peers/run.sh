#!/usr/bin/env bash
# Trains Go1 and G1 on flat ground with mjlab and with this package, one after the other on one GPU, and judges all checkpoints
# by one program: docs/peers/run.sh FOLDER [mjlab] [ours] [judge]; all three by default. See docs/peers.md.
#
# Settings, with their defaults:
#   ROBOTS="go1 g1"          which robots
#   MJLAB_PYTHON=python      the interpreter that has mjlab; MJLAB_PATH, if it is set, becomes its PYTHONPATH
#   OURS_PYTHON=python       the one that has this package; OURS_PATH likewise
#   MJLAB_SECONDS=600        mjlab's training ends at the first checkpoint after this time
#   MJLAB_RESUME=            set to anything: mjlab's training goes on from the newest checkpoint in FOLDER, with its time
#   OURS_ITERATIONS=         iterations of ours; the task's own number by default
#   EVERY=10                 iterations from checkpoint to checkpoint
#   NUM_ENVS=4096  DEVICE=cuda:0  JOBS=2 (checkpoint sets that are judged at the same time)
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
mkdir -p "$1"
out=$(cd "$1" && pwd)
shift
phases=${*:-mjlab ours judge}
robots=${ROBOTS:-go1 g1}
every=${EVERY:-10}
num_envs=${NUM_ENVS:-4096}
device=${DEVICE:-cuda:0}

mjlab() { env ${MJLAB_PATH:+PYTHONPATH="$MJLAB_PATH"} "${MJLAB_PYTHON:-python}" "$@"; }
ours() { env ${OURS_PATH:+PYTHONPATH="$OURS_PATH"} "${OURS_PYTHON:-python}" "$@"; }

judge() { # judge ROBOT LAYOUT NAME ONNX...: writes NAME.json
  local robot=$1 layout=$2 name=$3
  shift 3
  ours -m legged evaluate onnx "$@" --robot "$robot" --layout "$layout" --out "judged_$name" --friction 1 --rmse 0.2 \
    --vx=-0.5:1:0.5 --vy=-0.3:0.3:0.3 --yaw=-0.5:0.5:0.5
  mv "judged_$name/onnx.json" "$name.json"
}

cd "$out"
for robot in $robots; do
  name=${robot^} # Go1, G1: mjlab's spelling
  if [[ " $phases " == *" mjlab "* ]]; then
    [[ -n ${MJLAB_RESUME:-} ]] || : >"mjlab_$robot.log"
    mjlab "$root/docs/peers/train_mjlab.py" "Mjlab-Velocity-Flat-Unitree-$name" --out "mjlab_$robot" --every "$every" \
      --num-envs "$num_envs" --seconds "${MJLAB_SECONDS:-600}" --device "$device" ${MJLAB_RESUME:+--resume} >>"mjlab_$robot.log" 2>&1 || {
      tail -n 20 "mjlab_$robot.log"
      exit 1
    }
    grep -E "^iteration|^training steps" "mjlab_$robot.log" | tail -n 2
  fi
  if [[ " $phases " == *" ours "* ]]; then
    ours "$root/train.py" --task "${robot}_flat" --num-envs "$num_envs" --sim-device "$device" \
      ${OURS_ITERATIONS:+--max-iterations "$OURS_ITERATIONS"} "train.runner.save_interval=$every" \
      >"ours_$robot.log" 2>&1 || {
      tail -n 20 "ours_$robot.log"
      exit 1
    }
    tail -n 2 "ours_$robot.log"
  fi
done

if [[ " $phases " == *" judge "* ]]; then
  for robot in $robots; do
    if [[ -f mjlab_$robot/layout.yaml ]]; then
      ours -m legged robot add "mjlab_$robot/robot.xml" --name "mjlab_$robot" --out robots --force >"add_$robot.log"
      judge "robots/mjlab_$robot" "mjlab_$robot/layout.yaml" "mjlab_$robot" "mjlab_$robot"/policy_*.onnx \
        >"judged_mjlab_$robot.log" &
    fi
    if [[ -d logs/${robot}_flat ]]; then
      rm -rf "ours_$robot"
      ours -m legged export "${robot}_flat" --out "ours_$robot"
      layouts=("ours_$robot"/*/policy.json)
      judge "$robot" "${layouts[0]}" "ours_$robot" "ours_$robot"/*/policy.onnx >"judged_ours_$robot.log" &
    fi
    while (($(jobs -rp | wc -l) >= ${JOBS:-2})); do wait -n; done
  done
  wait
  tail -n 2 judged_*.log
  ours "$root/docs/peers/table.py" ./*_g*.json
fi
