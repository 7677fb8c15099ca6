#!/usr/bin/env bash
# bash lab/lease3.sh PART [LIMIT] on four GPUs (kind nvidia-h100-x4); scenes of part N lie in .gpu/sN.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=4 ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; [ -z "${SITE:-}" ] || echo "export PYTHONPATH=/tmp/site-$SITE:/opt/site"; echo "$2"; } > $J/$1.sh; }
variant() { mkdir -p /tmp/site-$1; [ -d /tmp/site-$1/sundae_ns ] || cp -r /opt/site/sundae_ns /tmp/site-$1/; sed -i "$2" /tmp/site-$1/sundae_ns/$3; cmp -s /tmp/site-$1/sundae_ns/$3 /opt/site/sundae_ns/$3 && echo "variant $1: $3 unchanged"; }
auto() { n=$1-${SITE:-now}-$3; job $2-$n "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$n --arms ${ARM:-sundae-auto} --seeds $3; for f in /tmp/oracle/$n/done/*.json; do cp \$f $O/done-$n-\$(basename \$f); done; for f in curve trials prune; do cp \$(find /tmp/oracle/$n/jobs -name \$f.json | head -1) $O/\$f-$n.json; done"; }
full() { job $2-$1-full-$3 "python3 $Q /tmp/scenes/$1 -o /tmp/full/$1-$3 --arms sundae-no-head --keep-ratios 1 --seeds $3; cp /tmp/full/$1-$3/done/*no-head*.json $O/"; }
stock() { job $2-$1-stock "python3 $Q /tmp/scenes/$1 -o /tmp/stock/$1 --arms splatfacto --seeds 42; cp /tmp/stock/$1/done/*.json $O/; until [ -x /tmp/node/splat-transform ]; do sleep 1; done; RUN=\$(dirname \$(find /tmp/stock/$1/jobs -name config.yml | head -1)); python3 $R/benchmarks/bench_formats.py \$RUN -o $O/formats-$1.csv"; }
take() { mkdir -p /tmp/scenes /tmp/full; [ ! -d "$ROOT/.gpu/s$1" ] || cp -r "$ROOT"/.gpu/s$1/* /tmp/scenes/; ls /tmp/scenes; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; take 1; cd /tmp || exit
  cp -r /opt/site/sundae_ns /tmp/none; python3 $R/lab/chain.py /tmp/site-chain
  setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1
  GPU=3 job 00-alone-profile "python3 $R/benchmarks/bench_training.py /tmp/scenes/bonsai --arms sundae --steps 30000 --child busy"
  stock bonsai 01; auto bonsai 03 42 ;;
2) take 2; for s in 42 43; do auto south_building 02 $s; full south_building 02 $s; done; auto dinosaur 03 42; auto dinosaur 04 43; SITE=chain auto dinosaur 05 42 ;;
3) take 3; stock garden 01; auto garden 03 42; auto stone_horse 03 42; auto fox 03 42; SITE=chain auto stone_horse 05 42; SITE=chain auto garden 05 42 ;;
4) mkdir -p /tmp/node.part; tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node.part; mv /tmp/node.part /tmp/node
  touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; grep -h ROW /tmp/logs/00-alone-profile.log | cut -c1-4000 ;;
esac
