#!/usr/bin/env bash
# What waits for a GPU: bash lab/lease.sh PART, on one H200 with the package, captures in /tmp/scenes and $OUT set.
# Each part takes less than 10 minutes; parts 2 to 4 need the GPU alone.
set -u
export PATH=/opt/site/bin:$PATH
T="python3 /tmp/benchmarks/bench_training.py" # benchmarks/ copied to /tmp, and on PYTHONPATH; PYTHONSAFEPATH unset
case $1 in
1) # all tests of the GPU, 2 min alone; PYTHONSAFEPATH=1. av is missing there
  python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" \
    --ignore tests/evaluation/test_video.py --ignore tests/integration/test_report.py tests > "$OUT/gpu.log" 2>&1
  tail -5 "$OUT/gpu.log" ;;
2) # issue 25: the pair on bonsai, and the fast method, with curves (the clock stands still while they are measured)
  $T /tmp/scenes/bonsai --arms sundae-fast --curve 3000 5999 8000 12000 15000 --profile -o "$OUT/t.jsonl"
  $T /tmp/scenes/bonsai --arms sundae --curve 5000 10000 14999 17000 20000 23000 26000 --profile -o "$OUT/t.jsonl"
  $T /tmp/scenes/bonsai --arms splatfacto --curve 5000 10000 15000 20000 25000 -o "$OUT/t.jsonl" ;;
3) # the same on garden
  $T /tmp/scenes/garden --arms sundae-fast sundae splatfacto -o "$OUT/t.jsonl" ;;
4) # fox, whose stock run takes the longest
  $T /tmp/scenes/fox --arms sundae splatfacto -o "$OUT/t.jsonl" ;;
5) # issue 26: RUN is a finished run of bonsai by today's default
  python3 /tmp/benchmarks/bench_pack.py --run "$RUN" --finetune 1500 --keep "$OUT/ft.sundae" | tail -1 | tee -a "$OUT/pack.jsonl"
  python3 /tmp/benchmarks/bench_pack.py --run "$RUN" --finetune 4000 --rate 0.03 | tail -1 | tee -a "$OUT/pack.jsonl" ;;
6) # issue 24: what is missing in runs.csv, without times. MPS lets runs share the GPU: with four to six at a time, 22 of
   # 15,000 to 30,000 steps took 12 minutes
  export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps OMP_NUM_THREADS=4
  mkdir -p /tmp/mps && nvidia-cuda-mps-control -d
  S="sundae bench suite /tmp/scenes -o /tmp/suite --scenes"
  for arm in band sundae-fast; do
    setsid nohup bash -c "$S garden --arms $arm" > "/tmp/$arm.log" 2>&1 &
  done
  until [ $SECONDS -gt "${LIMIT:-540}" ]; do sleep 2; pgrep -f "bench suite" > /dev/null || break; done
  cat /tmp/suite/done/*.json > "$OUT/results.jsonl" ;;
esac
