#!/usr/bin/env bash
# The guards of issue 69 on four GPUs; lab/README.md says what lies in .gpu, and how to call this.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=3 GPUS=4 RESERVED=0
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
job() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
on() { { echo "# gpu $1"; echo "$3"; } > $J/$2.sh.new; mv $J/$2.sh.new $J/$2.sh; }
Q=$R/benchmarks/quality.py
case $1 in
1) [ -f /tmp/logs/queue.log ] && exit 0; s=$SECONDS
  bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R $J $O /tmp/logs /tmp/scenes /tmp/base; cp -r benchmarks tests docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cp -r .gpu/base/* /tmp/base/; cp -r .gpu/scenes/bonsai /tmp/scenes/; cp lab/slots.py /tmp/
  on 0 00-alone-1-new "python3 $R/benchmarks/bench_training.py /tmp/scenes/bonsai --arms sundae -o $O/new.jsonl"
  on 0 00-alone-2-base "cd /tmp/base/benchmarks; PYTHONPATH=/tmp/base:/opt/site python3 bench_training.py /tmp/scenes/bonsai --arms sundae -o $O/base.jsonl"
  on 0 00-alone-3-graph "cd $R/benchmarks; python3 bench_graph.py --points 5000000 --distributions field --sample 10000 > $O/graph-new.jsonl; cd /tmp/base/benchmarks; PYTHONPATH=/tmp/base:/opt/site python3 bench_graph.py --points 5000000 --distributions field --sample 10000 > $O/graph-base.jsonl"
  on 0 00-alone-4-pytest "cd $R; PYTHONSAFEPATH=1 timeout 250 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"
  for k in 42 43 44; do on $((k < 44 ? 1 : 2)) 0$k-bonsai "python3 $Q /tmp/scenes/bonsai -o /tmp/default/bonsai-$k --arms sundae-auto --seeds $k"; done
  cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; echo "part 1: $((SECONDS-s)) s" ;;
2) [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  [ -f $O/default.jsonl ] && exit 0
  cp -r .gpu/scenes/fox .gpu/scenes/south_building /tmp/scenes/
  for k in 42 43 44; do on $((k < 44 ? 2 : 1)) 0$k-fox "python3 $Q /tmp/scenes/fox -o /tmp/default/fox-$k --arms sundae-auto --seeds $k"; on $((k < 44 ? 3 : 2)) 1$k-south "python3 $Q /tmp/scenes/south_building -o /tmp/default/south_building-$k --arms sundae-auto --seeds $k"; done
  touch $J/END; SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt ${2:-380} ]; do sleep 1; done
  left=$((${3:-540} - SECONDS))
  [ $left -gt 60 ] && (cd /tmp; timeout $left python3 $R/benchmarks/multi_gpu.py --data /tmp/scenes/bonsai --gpus 1 2 4 --only tiled --field $(ls /tmp/default/bonsai-42/jobs/*/*/*/run/nerfstudio_models/*.ckpt | head -1) --tiled-steps 600 > $O/multi.csv 2> /tmp/logs/multi.err; cat $O/multi.csv)
  cat /tmp/default/*/done/*.json > $O/default.jsonl; cp -r /tmp/logs $OUT/ 2>/dev/null; tar -czf "$OUT/out.tgz" -C /tmp out logs
  tail -n 40 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; tail -n 12 /tmp/logs/00-alone-4-pytest.log; cat $O/new.jsonl $O/base.jsonl $O/graph-*.jsonl | cut -c1-700; python3 - <<'P'
import json
for l in open('/tmp/out/default.jsonl'):
    d=json.loads(l); print(json.dumps(d)[:900])
P
 ;;
esac
