#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on two H100s: the default on six captures (two alone), tests of the GPU, seeds, the fixed tenth.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=${SLOTS:-5} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py

auto() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-$3 --arms sundae-auto --seeds $3; cp /tmp/oracle/$1-$3/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$1-$3/jobs -name \$f.json | head -1) $O/\$f-$1-$3.json; done"; } > $J/$2-$1-$3.sh; }
tenth() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-tenth --arms sundae --keep-ratios 0.1 --seeds 42; for f in /tmp/oracle/$1-tenth/done/*.json; do cp \$f $O/tenth-\$(basename \$f); done"; } > $J/$2-$1-tenth.sh; }
job() { { after; echo "$2"; } > $J/$1.sh; }
wait_for() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${1:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; }
start() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs $O $J; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"; }
queue() { setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
PYTEST='cd /tmp/repo; export CUDA_VISIBLE_DEVICES=1,0 PYTHONSAFEPATH=1; python3 -m pytest -q -m gpu -p no:cacheprovider --durations=15 -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu" tests) > /tmp/logs/pytest.log 2>&1'
after() { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; }
shares() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-shares --arms sundae --keep-ratios $3 --seeds 42; for f in /tmp/oracle/$1-shares/done/*.json; do cp \$f $O/shares-\$(basename \$f); done; R=\$(ls -d /tmp/oracle/$1-shares/jobs/*100pct*/*/*/run 2>/dev/null | head -1); [ -z \"\$R\" ] || sundae pack \$R -o /tmp/oracle/full-$1.sundae"; } > $J/$2-$1-shares.sh; }
FEW='cd /tmp/repo; export PYTHONSAFEPATH=1; python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" tests/api/test_refit.py tests/cli/test_files.py tests/api/test_views.py'
full() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-full --arms sundae-no-head --keep-ratios 1 --seeds 42; sundae pack \$(ls -d /tmp/oracle/$1-full/jobs/*100pct*/*/*/run | head -1) -o /tmp/full/$1.sundae; for f in /tmp/oracle/$1-full/done/*.json; do cp \$f $O/full-\$(basename \$f); done"; } > $J/$2-$1-full.sh; }
rows() { { after; echo "sundae unpack /tmp/full/$1.sundae --data /tmp/scenes/$1 -o /tmp/unpacked/$1; R=\$(dirname \$(find /tmp/unpacked/$1 -name config.yml | head -1)); P='python3 $R/benchmarks/prune_without_photos.py'; \$P \$R -o $O/prune-$1.csv --shares 0.1 0.5 0.2 0.05 --training none; \$P \$R -o $O/prune-$1.csv --shares 0.1 --training distill distill-no-head; [ -z \"${3:-}\" ] || \$P \$R -o $O/prune-$1.csv --shares 0.1 0.5 --training none --splat-transform /tmp/node/splat-transform"; } > $J/$2-$1-rows.sh; }
case $1 in
c1) start; mkdir -p /tmp/full; cp "$ROOT"/.gpu/full/* /tmp/full/; GPU=1 full garden 01; queue
  export CUDA_VISIBLE_DEVICES=0; (eval "$FEW") 2>&1 | grep -E "passed|failed|Error|^E " | tail -n 12 | cut -c1-300; timeout 120 python3 $R/lab/alone.py 2>&1 | tail -n 14 | cut -c1-300
  for i in 1 2; do date +%s.%N; timeout 60 sundae prune /tmp/full/bonsai.sundae -o /tmp/b-$i.sundae --keep 0.1 2>&1 | tail -n 2; date +%s.%N; done
  for m in sundae sundae-fast; do python3 -m sundae_ns.cli.forecast $m 800 533 2>&1 | tail -n 3 | cut -c1-300; done; tail -n 2 /tmp/logs/01*.log | cut -c1-200 ;;
c2) cp -r .gpu/scenes/* /tmp/scenes/; GPU=0 job 03-distill "date +%s.%N; sundae distill /tmp/full/bonsai.sundae -o /tmp/d.sundae --keep 0.1; date +%s.%N"; sleep 1
  GPU=1 rows bonsai 10; AFTER=01-garden-full GPU=1 rows garden 11 dec; GPU=1 job 20-kill-trials "timeout 330 python3 $R/benchmarks/kill_and_resume.py --kinds trials --device cuda --kills 3" ;;
c3) cp -r .gpu/scenes/* /tmp/scenes/; cp .gpu/full/* /tmp/full/; GPU=1 full south_building 02; AFTER=03-distill; AFTER="02-south_building-full 03-distill" rows south_building 12 dec
  job 21-kill-gpus "CUDA_VISIBLE_DEVICES=0,1 timeout 330 python3 $R/benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2 --kills 2"; job 22-disk "timeout 330 python3 $R/benchmarks/full_disk.py --only train 'pack --finetune'" ;;
c4) cp -r .gpu/scenes/* /tmp/scenes/; cp .gpu/full/* /tmp/full/; AFTER=03-distill; mkdir -p /tmp/node; tar -xJf .gpu/node/nodepack.tar.xz -C /tmp/node; rows fox 13; rows dinosaur 14 dec; rows stone_horse 15
  wait_for "${2:-330}"; tail -n 3 /tmp/logs/03*.log; for f in /tmp/logs/2[012]*.log; do tail -n 3 $f | cut -c1-600; done ;;
esac
# where a load takes its time
[ "$1" != c3 ] || (cd /tmp; CUDA_VISIBLE_DEVICES=1 python3 -X importtime -c "import time; t=time.monotonic(); import torch; print('torch', time.monotonic()-t); t=time.monotonic(); torch.zeros(1).cuda(); print('cuda', time.monotonic()-t); t=time.monotonic(); import sundae_ns as sn; s=sn.load('/tmp/full/bonsai.sundae'); print('load', time.monotonic()-t); t=time.monotonic(); s.to('cuda'); print('to', time.monotonic()-t); t=time.monotonic(); sn.load('/tmp/full/bonsai.sundae'); print('again', time.monotonic()-t)" 2>/tmp/logs/import.txt; sort -t'|' -k2 -n /tmp/logs/import.txt | tail -n 12)
