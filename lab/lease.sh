#!/usr/bin/env bash
# What waits for a GPU: bash lab/lease.sh PART, on one H200 with the package, captures in /tmp/scenes and $OUT set.
# Each part takes less than 10 minutes; parts 2 to 4 need the GPU alone.
set -u
T="python3 /tmp/benchmarks/bench_training.py" # benchmarks/ copied to /tmp, and on PYTHONPATH; PYTHONSAFEPATH unset
case $1 in
1) # all tests of the GPU; PYTHONSAFEPATH=1
  python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib" tests > "$OUT/gpu.log" 2>&1
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
6) # issue 29, on as many GPUs as there are: continue with the same command, then tables.py --suite and plot.py
  sundae bench suite /tmp/scenes -o "$OUT/suite" --scenes bonsai fox garden stone_horse ;;
esac
