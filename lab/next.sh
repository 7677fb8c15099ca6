#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on one GPU or more (GPUS); lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; F=$R/benchmarks/bench_formats.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; echo "$2"; } > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
# formats CAPTURE: packs of the stock run that curves has left, splatfacto's .sog by splat-transform too where Vulkan is
formats() { AFTER="$1-curves" job 01-$1-formats "until [ -d /tmp/node ]; do sleep 2; done; python3 $F \$(dirname \$(find /tmp/stock/$1 -name config.yml | head -1)) -o $O/formats-$1.csv"; }
export XDG_RUNTIME_DIR=/tmp VK_DRIVER_FILES=/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd.json
take() { mkdir -p /tmp/scenes /tmp/default /tmp/others; for s in $*; do cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
# For films, which a CPU makes: the packs of the default, fine-tuned, and of all primitives
packs() { for c in bonsai garden; do cp $(find /tmp/default/$c-44 -name tuned.sundae) "$OUT/$c-tuned.sundae"; cp $(find /tmp/others/$c-tenth -path "*-100pct-*" -name scene.sundae) "$OUT/$c-full.sundae"; done 2> /dev/null; }
# Brings home what is done, also of jobs that have not ended
gather() { for f in /tmp/default/*/done/*.json; do cp $f $O/default/; done; for f in /tmp/others/*/done/*.json; do cp $f $O/others/; done
  for d in /tmp/default/*; do for f in $(find $d/jobs -name curve.json); do cp $f $O/curves/$(basename $d).json; done; done; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  mkdir -p $O/default $O/others $O/curves; gather 2> /dev/null; tar -czf "$OUT/out.tgz" -C /tmp out logs; packs; tail -n 60 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
node() { mkdir -p /tmp/node.part; tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node.part; mv /tmp/node.part /tmp/node; }
# default CAPTURE ORDER SEED...
default() { c=$1 o=$2; for s in ${*:3}; do job 0$o-$s-$c "python3 $Q /tmp/scenes/$c -o /tmp/default/$c-$s --arms sundae-auto --seeds $s"; done; }
# curves CAPTURE ORDER ARM...: seconds with PSNR and SSIM on the way, then frames, alone (530 s); others CAPTURE: the further rows of a suite
curves() { c=$1 o=$2; shift 2; job 00-alone-$o-$c-curves "python3 $R/lab/stock_curve.py /tmp/scenes/$c --arms $* --curve 1000 2000 3000 4500 6000 8000 10000 12000 15000 18000 21000 25000 30000 -o $O/time-$c.jsonl
for r in \$(find /tmp/stock/$c /tmp/ours/$c-sundae -name config.yml); do sundae bench frame \$(dirname \$r) --repeats 9 --json >> $O/frames-$c.jsonl; done"; }
flicker() { AFTER="44-$1" job 08-$1-flicker "python3 $R/benchmarks/flicker.py --load-config \$(dirname \$(find /tmp/default/$1-44 -name config.yml | head -1)) --json > $O/flicker-$1.jsonl"; }
row() { job $1-$2-$3 "python3 $Q /tmp/scenes/$2 -o /tmp/others/$2-$3 --arms ${*:4} --seeds 42"; }
others() { row 05 $1 tenth sundae sundae-no-head --keep-ratios 0.1; row 06 $1 fast sundae-fast --keep-ratios 0.1; row 06 $1 mcmc mcmc --keep-ratios 0.1
  AFTER="$1-mcmc" job 061-$1-pack "python3 $R/lab/pack_loss.py \$(dirname \$(find /tmp/others/$1-mcmc -name config.yml | head -1))"
  AFTER="$1-tenth" job 07-$1-shares "python3 $Q /tmp/scenes/$1 -o /tmp/others/$1-tenth --arms sundae --seeds 42 --keep-ratios 0.2 0.05 0.4 1"; }
gpu_tests() { job 025-pytest "cd /tmp/repo; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"; }
vulkan() { for f in "$ROOT"/.gl/*.deb; do dpkg -x $f /; done; ldconfig; node; splat-transform --list-gpus; }
# ways CAPTURE: what trials cost a capture that keeps all: no trials, with 30,000 steps and with as many as trials leave
ways() { for n in 30000 26400; do job 035-$1-$n "python3 $R/benchmarks/bench_training.py /tmp/scenes/$1 --arms sundae --steps $n --option=--pipeline.model.pruning.keep-ratio --option=1.0 --option=--pipeline.model.head.mode --option=off -o $O/ways-$1-$n.jsonl"; done; }
case $1 in
# One lease, nvidia-h100-x4, GPUS=4 SLOTS=4 RESERVED="0 1 2": curves alone on three GPUs, all else on the fourth and after them
1) setup; take 3; GPU=0; curves fox a sundae sundae-fast splatfacto; GPU=1; curves stone_horse a sundae sundae-fast splatfacto; GPU=; others fox; others stone_horse; gpu_tests; queue ;;
2) take 1 4; GPU=2; curves bonsai a sundae sundae-fast splatfacto; curves south_building b splatfacto; GPU=; default bonsai 3 44; flicker bonsai; ways south_building; others bonsai; others south_building ;;
3) take 2; default garden 3 44; flicker garden; others garden; others dinosaur; vulkan; for c in fox stone_horse south_building; do formats $c; done ;;
9) [ -f /tmp/logs/queue.log ] || { echo "no queue: another machine; give it back"; exit 3; }; SECONDS=0; wait_for_all "${2:-400}"; cat $O/formats-*.csv | cut -c1-150 ;;
esac
