#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on four GPUs (kind nvidia-h100-x4); lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=4 ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; echo "$2"; } > $J/$1.sh; }
# auto CAPTURE ORDER SEED: the default, its records, and its fine-tuned pack (for JOD and flicker on a CPU)
auto() { n=$1-$3; job $2-$n "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$n --arms sundae-auto --seeds $3; cp /tmp/oracle/$n/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$n/jobs -name \$f.json | head -1) $O/\$f-$n.json; done; cp \$(find /tmp/oracle/$n/jobs -name tuned.sundae | head -1) /tmp/packs/$n.sundae"; }
tenth() { job $2-$1-tenth "python3 $Q /tmp/scenes/$1 -o /tmp/tenth/$1 --arms sundae --keep-ratios 0.1 --seeds 42; cp /tmp/tenth/$1/done/*.json $O/"; }
full() { job $2-$1-full "python3 $Q /tmp/scenes/$1 -o /tmp/full/$1 --arms sundae-no-head --keep-ratios 1 --seeds 42; cp /tmp/full/$1/done/*no-head*.json $O/"; }
decimated() { AFTER="$1-full" job $2-$1-decimated "RUN=\$(dirname \$(find /tmp/full/$1/jobs -name config.yml | grep no-head | head -1)); python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 0.5 --training none --splat-transform /tmp/node/splat-transform; python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 --training distill --steps 8000"; }
stock() { GPU=$3 job $2-$1-stock "python3 $Q /tmp/scenes/$1 -o /tmp/stock/$1 --arms splatfacto --seeds 42; cp /tmp/stock/$1/done/*.json $O/; RUN=\$(dirname \$(find /tmp/stock/$1/jobs -name config.yml | head -1)); python3 $R/benchmarks/bench_formats.py \$RUN -o $O/formats-$1.csv"; }
take() { mkdir -p /tmp/scenes /tmp/full /tmp/packs; [ ! -d "$ROOT/.gpu/s$1" ] || cp -r "$ROOT"/.gpu/s$1/* /tmp/scenes/; ls /tmp/scenes; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; take 1; cd /tmp || exit
  setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1
  stock bonsai 00-alone 3; auto bonsai 03 43; auto bonsai 03 44; tenth bonsai 04 ;;
2) take 2; for s in 43 44; do auto garden 03 $s; auto fox 03 $s; auto stone_horse 03 $s; done; tenth garden 04; full garden 02; decimated garden 05 ;;
3) mkdir -p /tmp/node.part; tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node.part; mv /tmp/node.part /tmp/node; take 3; auto dinosaur 03 44; full dinosaur 02; decimated dinosaur 05 ;;
4) take 4; auto south_building 03 44; full south_building 02; decimated south_building 05
  touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; for f in /tmp/packs/*-43.sundae; do cp $f "$OUT/"; done; tail -n 60 /tmp/logs/queue.log ;;
esac
