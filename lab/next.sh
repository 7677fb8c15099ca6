#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on two H100s (kind nvidia-h100-x2): what waits for a GPU; lab/README.md says with which captures.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=${SLOTS:-5} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py
after() { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; }
job() { { after; echo "$2"; } > $J/$1.sh; }
auto() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-$3 --arms sundae-auto --seeds $3; cp /tmp/oracle/$1-$3/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$1-$3/jobs -name \$f.json | head -1) $O/\$f-$1-$3.json; done"; } > $J/$2-$1-$3.sh; }
rows() { { after; echo "sundae unpack /tmp/full/$1.sundae --data /tmp/scenes/$1 -o /tmp/unpacked/$1; RUN=\$(dirname \$(find /tmp/unpacked/$1 -name config.yml | head -1)); python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 0.5 0.2 0.05 --training none; for n in 3000 12000; do python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 --training distill distill-no-head --steps \$n; done; python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 0.5 --training none --splat-transform /tmp/node/splat-transform"; } > $J/$2-$1-rows.sh; }
take() { mkdir -p /tmp/scenes /tmp/full /tmp/node; cp -r "$ROOT"/.gpu/scenes/* /tmp/scenes/; cp "$ROOT"/.gpu/full/* /tmp/full/ 2>/dev/null; [ ! -d "$ROOT/.gpu/node" ] || tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node; }
wait_for() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${1:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; take; cd /tmp || exit
  setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1
  GPU=0 job 00-pytest 'cd /tmp/repo; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu" tests)'
  GPU=1 rows "$2" 10 ;;
2) take; for c in "${@:2}"; do rows "$c" 11; done
  job 20-kill-trials "timeout 400 python3 $R/benchmarks/kill_and_resume.py --kinds trials --device cuda --kills 4"
  job 21-kill-gpus "CUDA_VISIBLE_DEVICES=0,1 timeout 400 python3 $R/benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2 --kills 3"
  job 22-disk "timeout 400 python3 $R/benchmarks/full_disk.py --only train 'pack --finetune'" ;;
3) take; for c in $(ls "$ROOT"/.gpu/scenes); do auto "$c" 12 43; done
  wait_for "${2:-400}"; tail -n 3 /tmp/logs/*pytest.log; for f in /tmp/logs/2*.log; do tail -n 3 $f | cut -c1-700; done ;;
esac
