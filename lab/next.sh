#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on one GPU or more (GPUS); lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py
job() { { [ -z "${GPU:-}" ] || echo "# gpu $GPU"; echo "$2"; } > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
take() { mkdir -p /tmp/scenes /tmp/shorter /tmp/others; for s in $*; do cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  for d in shorter others; do mkdir -p $O/$d; cp /tmp/$d/*/done/*.json $O/$d/; done 2> /dev/null; tar -czf "$OUT/out.tgz" -C /tmp out logs
  tail -n 60 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
# arm NAME CAPTURE SEED...: the arm of lab/NAME.yaml
arm() { for s in ${*:3}; do job 04-$s-$2-$1 "python3 $Q /tmp/scenes/$2 -o /tmp/others/$2-$1-$s --arms $R/lab/$1.yaml --seeds $s"; done; }
case $1 in
1) setup; take 3; arm last fox 42 43 44; queue ;;
2) [ -d $J ] || exit 3; take 1 4; arm no-decay bonsai 42 43 44; arm last bonsai 42 43 44; arm last south_building 42 43 44 ;;
3) [ -d $J ] || exit 3; take 2; arm no-decay garden 42 43 44; arm last garden 42 ;;
9) [ -f /tmp/logs/queue.log ] || { echo "no queue: another machine; give it back"; exit 3; }; SECONDS=0; wait_for_all "${2:-400}" ;;
esac
