#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on four GPUs (kind nvidia-h100-x4); lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=4 ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py; F=$R/benchmarks/bench_formats.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; echo "$2"; } > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
# auto CAPTURE ORDER SEED: the default, its records, and its fine-tuned pack (for JOD and flicker on a CPU)
auto() { n=$1-$3; job $2-$n "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$n --arms sundae-auto --seeds $3; cp /tmp/oracle/$n/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$n/jobs -name \$f.json | head -1) $O/\$f-$n.json; done; cp \$(find /tmp/oracle/$n/jobs -name tuned.sundae | head -1) /tmp/packs/$n.sundae"; }
tenth() { job $2-$1-tenth "python3 $Q /tmp/scenes/$1 -o /tmp/tenth/$1 --arms sundae --keep-ratios 0.1 --seeds 42; cp /tmp/tenth/$1/done/*.json $O/"; }
full() { job $2-$1-full "python3 $Q /tmp/scenes/$1 -o /tmp/full/$1 --arms sundae-no-head --keep-ratios 1 --seeds 42; cp /tmp/full/$1/done/*no-head*.json $O/"; }
decimated() { AFTER="$1-full" job $2-$1-decimated "RUN=\$(dirname \$(find /tmp/full/$1/jobs -name config.yml | grep no-head | head -1)); python3 $P \$RUN -o $O/prune-$1.csv --shares 0.5 0.1 --training none --splat-transform /tmp/node/splat-transform; python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 --training distill --steps 8000"; }
# stock CAPTURE GPU: splatfacto with a GPU of its own, then its packs; splat-transform's as a last and separate step
stock() { GPU=$2 job 00-alone-$1-stock "python3 $Q /tmp/scenes/$1 -o /tmp/stock/$1 --arms splatfacto --seeds 42; cp /tmp/stock/$1/done/*.json $O/"
  AFTER="$1-stock" job 01-$1-formats "RUN=\$(dirname \$(find /tmp/stock/$1/jobs -name config.yml | head -1)); (cd /tmp; sundae export \$RUN -o /tmp/stock/$1.ply && splat-transform --quiet --overwrite --gpu cpu /tmp/stock/$1.ply /tmp/packs/$1-theirs.sog) & PATH=\${PATH#/tmp/node:} python3 $F \$RUN -o $O/formats-$1.csv; wait; python3 $F \$RUN -o $O/theirs-$1.csv --ply /tmp/packs/$1-theirs.sog --program 'splat-transform 3.7.0'"; }
take() { mkdir -p /tmp/scenes /tmp/full /tmp/packs; for s in $*; do [ ! -d "$ROOT/.gpu/s$s" ] || cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; tail -n 60 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
node() { mkdir -p /tmp/node.part; tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node.part; mv /tmp/node.part /tmp/node; }
chain() { job $2-$1-chain "python3 $Q /tmp/scenes/$1 -o /tmp/chain/$1 --arms $R/lab/arms.yaml --seeds 42; cp /tmp/chain/$1/done/*.json $O/"; }
# tuned CAPTURE ORDER AFTER FOLDER WAY ...: ways to fine-tune the run in FOLDER
tuned() { c=$1 o=$2 a=$3 f=$4; shift 4; AFTER=$a job $o-$c-ways "python3 $R/lab/tune.py \$(dirname \$(find $f/jobs -name config.yml | grep -v warm-up | head -1)) $O/ways-$c.jsonl $*"; }
case $1 in
1) setup; take 1; tenth bonsai 01; queue ;;
2) take 2 3; auto dinosaur 02 44; auto garden 02 43; full dinosaur 03; full garden 03; auto fox 01 43; auto stone_horse 01 43; auto fox 04 44; auto stone_horse 04 44; auto garden 04 44
  tuned fox 05 fox-43 /tmp/oracle/fox-43 now slow fast long cheap fine-dear coarse-cheap positions
  tuned stone_horse 05 stone_horse-43 /tmp/oracle/stone_horse-43 now slow fast long cheap fine-dear coarse-cheap positions
  tuned bonsai 05 bonsai-tenth /tmp/tenth/bonsai now slow fast long cheap fine-dear coarse-cheap positions head features ;;
3) take 4; auto south_building 02 44; full south_building 03; chain stone_horse 06; chain dinosaur 06 ;;
4) wait_for_all "${2:-300}"; for f in garden dinosaur south_building; do cp $(find /tmp/full/$f/jobs -name "*.sundae" | grep -v tuned | head -1) "$OUT/$f-full.sundae"; done
  for f in garden south_building; do for p in /tmp/packs/$f-4*.sundae; do cp $p "$OUT/" && break; done; done; find /tmp/full -name "*.sundae" ;;
esac
