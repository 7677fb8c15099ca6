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
# ways CAPTURE NAME WAYS OPTION ...: the default with parts of a chain in its densification (lab/hybrid.py)
ways() { c=$1 n=$2 w=$3; shift 3; job ${PRE:-02}-$c-$n "python3 $R/lab/hybrid.py $w -- sundae --data /tmp/scenes/$c --output-dir /tmp/ways/$n --experiment-name $c --timestamp run --vis tensorboard --pipeline.model.evaluate-prune False --pipeline.datamanager.cache-images gpu --steps-per-eval-all-images 100000 --steps-per-eval-image 100000 $* colmap --colmap-path sparse/0 --downscale-factor 1 --eval-mode interval --eval-interval 8 && ns-eval --load-config /tmp/ways/$n/$c/sundae/run/config.yml --output-path $O/ways-$c-$n.json && cp /tmp/ways/$n/$c/sundae/run/curve.json $O/curve-$c-$n.json && python3 $R/lab/tune.py /tmp/ways/$n/$c/sundae/run $O/tuned-$c-$n.jsonl now"; }
default() { job ${PRE:-02}-$2-$1 "python3 $Q /tmp/scenes/$1 -o /tmp/default/$1-$2 --arms sundae-auto --seeds $2; mkdir -p $O/$1-$2; cp /tmp/default/$1-$2/done/*.json $O/$1-$2/"; }
alone() { job 00-alone-$2-$1 "python3 $R/benchmarks/bench_training.py /tmp/scenes/$1 --arms sundae -o $O/time-$1.jsonl"; }
train() { echo "--data /tmp/scenes/$1 --experiment-name $1 --timestamp run --vis tensorboard --pipeline.model.evaluate-prune False --pipeline.datamanager.cache-images gpu --steps-per-eval-all-images 100000 --steps-per-eval-image 100000"; }
C="colmap --colmap-path sparse/0 --downscale-factor 1 --eval-mode interval --eval-interval 8"
# base CAPTURE: the default with all checkpoints; trick CAPTURE NAME WAYS: from its step 18,000 on
base() { job 01-$1-base "ns-train sundae $(train $1) --output-dir /tmp/base --save-only-latest-checkpoint False $C && ns-eval --load-config /tmp/base/$1/sundae/run/config.yml --output-path $O/base-$1.json && cp /tmp/base/$1/sundae/run/curve.json $O/curve-$1.json"
  AFTER="$1-base" job 01-$1-pack "sundae pack /tmp/base/$1/sundae/run -o $O/$1.sundae --finetune 1500"; }
trick() { AFTER="$1-base" job 03-$1-trick-$2 "python3 $R/lab/hybrid.py $3 -- sundae $(train $1) --output-dir /tmp/tricks/$2 --load-checkpoint /tmp/base/$1/sundae/run/nerfstudio_models/step-000018000.ckpt $C && ns-eval --load-config /tmp/tricks/$2/$1/sundae/run/config.yml --output-path $O/trick-$1-$2.json; rm -rf /tmp/tricks/$2/$1/sundae/run/nerfstudio_models"; }
gpu_tests() { job 025-pytest "cd /tmp/repo; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"; }
vulkan() { for f in "$ROOT"/.gl/*.deb; do dpkg -x $f /; done; ldconfig; node; splat-transform --list-gpus; }
# .gpu/dawn: bench_page.py bonsai.sundae --dawn 800x533 1920x1080 --folder .gpu/dawn (35 MB)
dawn() { cp -r "$ROOT/.gpu/dawn" /tmp/dawn; cd /tmp/dawn; timeout 60 /tmp/node/node timing.mjs /tmp/dawn > $O/dawn.jsonl 2> /tmp/logs/dawn.err; cut -c1-400 $O/dawn.jsonl; tail -n 3 /tmp/logs/dawn.err; }
case $1 in
# nvidia-h100-x1, GPUS=1 SLOTS=4: the default where it has a head, after the page's first image and GPU tests
1) setup; take 1 ;;
2) vulkan; take 2 ;;
3) dawn; cd "$ROOT"; default bonsai 42; PRE=03; default garden 42; PRE=04; default bonsai 43; PRE=05; default garden 43; PRE=06; default bonsai 44; PRE=07; default garden 44; queue
   sleep 2; (cd $R; PYTHONSAFEPATH=1 timeout 150 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--import-mode=importlib' tests/training tests/gpu tests/integration/test_packing_finetune.py tests/scenes 2>&1 | tail -n 12) ;;
4) SECONDS=0; wait_for_all "${2:-400}" ;;
esac
