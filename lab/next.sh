#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on one GPU or more (GPUS); lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py; F=$R/benchmarks/bench_formats.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; echo "$2"; } > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
# stock CAPTURE ORDER: splatfacto (480 s on an H100), then its packs, splat-transform's too where Vulkan is
stock() { job 00-alone-$2-$1-stock "python3 $Q /tmp/scenes/$1 -o /tmp/stock/$1 --arms splatfacto --seeds 42; cp /tmp/stock/$1/done/*.json $O/"
  GPU= AFTER="$1-stock" job 01-$1-formats "RUN=\$(dirname \$(find /tmp/stock/$1/jobs -name config.yml | head -1)); sundae pack \$RUN -o /tmp/packs/stock-$1.sundae; python3 $F \$RUN -o $O/formats-$1.csv"; }
export XDG_RUNTIME_DIR=/tmp VK_DRIVER_FILES=/usr/local/nvidia/share/vulkan/icd.d/nvidia_icd.json
take() { mkdir -p /tmp/scenes /tmp/full /tmp/packs; for s in $*; do [ ! -d "$ROOT/.gpu/s$s" ] || cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; tail -n 60 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
node() { mkdir -p /tmp/node.part; tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node.part; mv /tmp/node.part /tmp/node; }
default() { job ${PRE:-02}-$2-$1 "python3 $Q /tmp/scenes/$1 -o /tmp/default/$1-$2 --arms sundae-auto --seeds $2; mkdir -p $O/$1-$2; cp /tmp/default/$1-$2/done/*.json $O/$1-$2/; cp \$(find /tmp/default/$1-$2/jobs -name curve.json) $O/$1-$2/"; }
# curves CAPTURE ORDER: seconds with PSNR and SSIM on the way, alone (530 s); others CAPTURE: the further rows of a suite
curves() { job 00-alone-$2-$1-curves "python3 $R/benchmarks/bench_training.py /tmp/scenes/$1 --arms sundae sundae-fast splatfacto --curve 1000 2000 3000 4500 6000 8000 10000 12000 15000 18000 21000 25000 30000 -o $O/time-$1.jsonl"; }
others() { job 05-$1-others "python3 $Q /tmp/scenes/$1 -o /tmp/others/$1 --arms sundae sundae-no-head sundae-fast mcmc --keep-ratios 0.1 --seeds 42; mkdir -p $O/$1-others; cp /tmp/others/$1/done/*.json $O/$1-others/"; }
gpu_tests() { job 025-pytest "cd /tmp/repo; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"; }
vulkan() { for f in "$ROOT"/.gl/*.deb; do dpkg -x $f /; done; ldconfig; node; splat-transform --list-gpus; }
case $1 in
# One lease, nvidia-h100-x4, GPUS=4 SLOTS=4 RESERVED="0 1 2": curves and stock alone on three GPUs, all else on the others
1) setup; take 2; PRE=03; default garden 44; others garden; others dinosaur; GPU=1; curves garden a; GPU=; gpu_tests; queue ;;
2) take 1 4; PRE=03; default bonsai 44; PRE=04; default south_building 42; default south_building 43; others bonsai; others south_building; GPU=0; curves bonsai a; stock south_building b ;;
3) vulkan; take 3; PRE=04; default dinosaur 42; default dinosaur 43; default stone_horse 42; default stone_horse 44; others fox; others stone_horse; GPU=2; stock stone_horse a; curves fox b; GPU=1; stock fox b ;;
4) SECONDS=0; wait_for_all "${2:-400}"; cat $O/formats-*.csv | cut -c1-150 ;;
esac
