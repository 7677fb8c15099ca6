#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on four GPUs; lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
job() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
take() { mkdir -p /tmp/scenes; for s in $*; do cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r lab $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; tail -n 70 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
# arm NAME CAPTURE SCRIPT ENVIRONMENT SEED...
arm() { for s in ${*:5}; do job ${N:-04}-$s-$2-$1 "$4 bash $R/lab/one.sh $3 $2 $1 $s"; done; }
case $1 in
1) setup; take 3; for c in stone_horse fox; do bash $R/lab/arms.sh $c; done > /tmp/arms; . /tmp/arms; queue ;;
2) [ -d $J ] || exit 3; take 1 4; for c in south_building bonsai; do bash $R/lab/arms.sh $c; done > /tmp/arms; . /tmp/arms ;;
3) [ -d $J ] || exit 3; take 2; for c in dinosaur garden; do bash $R/lab/arms.sh $c; done > /tmp/arms; . /tmp/arms ;;
9) [ -f /tmp/logs/queue.log ] || { echo "no queue: another machine; give it back"; exit 3; }; SECONDS=0; wait_for_all "${2:-400}" ;;
esac
