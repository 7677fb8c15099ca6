#!/usr/bin/env bash
# bash lab/few_views.sh CAPTURES OUT [METHOD] on GPUS (4) GPUs: few views with and without each means, all arms of a
# capture at once on one GPU. CAPTURES has folders by few_views.py. The figures are the last lines of OUT/figures.txt.
# 25 MB here: for s in garden bonsai stone_horse south_building; do python3 lab/few_views.py ../shared/scenes/$s .gpu/few/$s; done
set -u
captures=$(realpath "$1"); mkdir -p "$2"; out=$(realpath "$2"); method=${3:-sundae}
export PYTHONPATH=${PYTHONPATH:-/opt/site} OMP_NUM_THREADS=4
arm() { # CAPTURE NAME OPTIONS
  s=$1 n=$2; shift 2
  CUDA_VISIBLE_DEVICES=$gpu python3 -m nerfstudio.scripts.train "$method" --data "$captures/$s" --output-dir "$out/runs" \
    --experiment-name "$s-$n" --timestamp r --vis tensorboard --pipeline.datamanager.cache-images gpu "$@" \
    colmap --colmap-path sparse/0 --downscale-factor 1 --eval-mode filename > "$out/$s-$n.log" 2>&1
  echo "$s $n $(grep -h 'trained: PSNR' "$out/$s-$n.log" | tail -n 1) $(grep -h 'by a plane sweep' "$out/$s-$n.log" | tail -n 1)" >> "$out/figures.txt"
}
gpu=0
for path in "$captures"/*/; do
  s=$(basename "$path")
  arm "$s" none --pipeline.model.dense-start-views 0 &
  arm "$s" dense &
  arm "$s" dropout --pipeline.model.dense-start-views 0 --pipeline.model.dropout-views 24 &
  arm "$s" both --pipeline.model.dropout-views 24 &
  gpu=$(((gpu + 1) % ${GPUS:-4}))
done
wait
sort "$out/figures.txt"
