#!/usr/bin/env bash
# The last lease of a session on four GPUs: pytest -m gpu, bonsai by the default, fixed shares of 16 views, several GPUs.
# part 1 (carry .gpu/wheels .gpu/setup.sh .gpu/gsplat-1.4.0-*.xz .gpu/scenes/bonsai), part 2 (carry .gpu/cuts)
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=4 GPUS=4 RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { { echo "# gpu $1"; echo "$3"; } > $J/$2.sh.new; mv $J/$2.sh.new $J/$2.sh; }
case $1 in
1) [ -f /tmp/logs/queue.log ] && exit 0; s=$SECONDS
  bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R $J $O /tmp/logs /tmp/scenes; cp -r benchmarks tests docs examples web lab *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cp -r .gpu/scenes/bonsai /tmp/scenes/; cp lab/slots.py /tmp/
  on 0 00-pytest "cd $R; PYTHONSAFEPATH=1 timeout 250 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"
  on 0 01-bonsai "python3 $R/benchmarks/quality.py /tmp/scenes/bonsai -o /tmp/default/bonsai-42 --arms sundae-auto --seeds 42"
  cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; echo "part 1: $((SECONDS-s)) s" ;;
2) [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  [ -f $O/few.jsonl ] && exit 0
  cp -r .gpu/cuts/* /tmp/scenes/; k=0
  for c in .gpu/cuts/*; do n=$(basename $c); for shard in 1 2; do k=$((k+1)); on $((k % 4)) 1$k-$n "python3 $R/lab/few.py /tmp/scenes/$n -o /tmp/few/$n --arms sundae sundae-auto --keep-ratios 0.05 0.1 0.2 0.4 1.0 --seeds 42 --shard $shard/2"; done; done
  touch $J/END; SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt ${2:-380} ]; do sleep 1; done
  pkill -f slots.py; pkill -f quality.py; pkill -f few.py; sleep 3; pkill -9 -f ns-train; pkill -9 -f /tmp/few
  left=$((${3:-580} - SECONDS))
  (cd /tmp; timeout $left python3 $R/benchmarks/multi_gpu.py --data /tmp/scenes/bonsai --gpus 1 4 2 --only tiled --field $(ls /tmp/default/bonsai-42/jobs/*/*/*/run/nerfstudio_models/*.ckpt | head -1) --tiled-steps 600 --pipeline.model.head.mode residual > $O/multi.csv 2> /tmp/logs/multi.err; cat $O/multi.csv | tail -n 5)
  cat /tmp/default/*/done/*.json > $O/default.jsonl; cat /tmp/few/*/done/*.json > $O/few.jsonl
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cp $O/multi.csv $OUT/
  tail -n 40 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; tail -n 4 /tmp/logs/00-pytest.log; wc -l $O/*.jsonl ;;
esac
