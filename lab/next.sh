#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on four GPUs; lab/README.md says what lies in .gpu.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out;
job() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
take() { mkdir -p /tmp/scenes; for s in $*; do cp -r "$ROOT"/.gpu/s$s/* /tmp/scenes/; done; ls /tmp/scenes; }
setup() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; }
queue() { cd /tmp || exit; setsid nohup python3 $R/lab/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
wait_for_all() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done
  cat /tmp/default/*/done/*.json > $O/default.jsonl; cat /tmp/others/*/done/*.json > $O/others.jsonl; python3 $R/lab/divides.py > $O/divides.txt 2>&1
  tar -czf "$OUT/out.tgz" -C /tmp out logs; tail -n 70 /tmp/logs/queue.log; nvidia-smi --query-gpu=name --format=csv,noheader | sort | uniq -c; }
alone() { { echo "# gpu $2"; echo "$3"; } > $J/00-alone-$1.sh.new; mv $J/00-alone-$1.sh.new $J/00-alone-$1.sh; }
exposed() { python3 $R/lab/expose.py /tmp/scenes/$1 /tmp/scenes/$1_exposed 0.15 images; job 10-$1-auto "WORDS= bash $R/lab/one.sh ns-train $1_exposed auto 42"; }
Q=$R/benchmarks/quality.py
# default CAPTURE SEED...; row ORDER CAPTURE NAME ARM...
default() { for s in ${*:2}; do job 0$s-$1 "python3 $Q /tmp/scenes/$1 -o /tmp/default/$1-$s --arms sundae-auto --seeds $s"; done; }
row() { job $1-$2-$3 "python3 $Q /tmp/scenes/$2 -o /tmp/others/$2-$3 --arms ${*:4} --seeds 42"; }
timed() { alone $1 0 "python3 $R/benchmarks/bench_training.py /tmp/scenes/$1 --arms sundae -o $O/time-$1.jsonl"; }
apart() { job 11-apart-$1 "for c in $*; do NAME=\$c STOP=2900 python3 $R/lab/rms.py sundae --data /tmp/scenes/\$c --output-dir /tmp/apart/\$c --experiment-name x --timestamp run --vis tensorboard --viewer.quit-on-train-completion True --pipeline.model.head.mode off --pipeline.model.evaluate-prune False --pipeline.model.photo-gains auto colmap --colmap-path sparse/0 --downscale-factor 1 --downscale-rounding-mode round --eval-mode interval --eval-interval 8 2>&1 | grep RMS; done > $O/apart-$1.txt"; }
gpu_tests() { alone pytest 1 "cd $R; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests)"; }
case $1 in
# RESERVED="0 1": clocks on the first GPU, tests on the second
1) setup; take 3; gpu_tests; queue; exposed stone_horse ;;
2) [ -d $J ] || exit 3; take 1 4; timed south_building; default south_building 42 43 44; c=south_building
   row 12 $c s100 sundae --keep-ratios 1; row 13 $c s40 sundae --keep-ratios 0.4
   row 14 $c tenth sundae sundae-no-head --keep-ratios 0.1; row 15 $c s20 sundae --keep-ratios 0.2; row 16 $c s5 sundae --keep-ratios 0.05; row 17 $c fast sundae-fast --keep-ratios 0.1 ;;
3) [ -d $J ] || exit 3; take 2; exposed garden; apart bonsai fox stone_horse; apart south_building dinosaur garden ;;
9) [ -f /tmp/logs/queue.log ] || { echo "no queue: another machine; give it back"; exit 3; }; SECONDS=0; wait_for_all "${2:-400}" ;;
esac
