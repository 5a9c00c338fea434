#!/usr/bin/env bash
# The main job, end to end, on two cores: what `make demo` runs. Every line works by itself, too.
set -euo pipefail
python=$1
out=runs/demo-$(date +%Y%m%d-%H%M%S)
run() { echo "+ python -m nht.recipes.$*" >&2; "$python" -m "nht.recipes.$@"; }
# Both runs write progress bars: side by side, the second one goes to a file.
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT

run collect_demos out="$out/demos"
run train_map map=nht demos.path="$out/demos" out="$out/nht.safetensors"
echo "DDPG on raw joint velocities runs beside the next one; its progress is in $out/raw.log"
run ddpg map=none demos.path="$out/demos" run.folder="$out/raw" algo.total_frames=80_000 >"$out/raw.log" 2>&1 &
raw=$!
run ddpg map=nht map.file="$out/nht.safetensors" run.folder="$out/nht" algo.total_frames=80_000
wait $raw
run report runs="[$out]" out="$out" title="DDPG on WAMWipe: 2-dimensional NHT actions and raw joint velocities"
echo "videos: $out/nht/video.mp4 and $out/raw/video.mp4"
