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
# profile CAPTURE STEP...: kinds of step, alone
profile() { job 00-alone-$1-profile "python3 $R/benchmarks/bench_training.py /tmp/scenes/$1 --arms sundae --profile ${*:2} -o $O/profile-$1.jsonl"; }
# without CAPTURE: a trick of the head left out, three seeds of the default; the suite has them with it
without() { for s in 42 43 44; do for t in decay mirror; do job 03-$s-$1-$t "TRICK=$t python3 $R/lab/without.py /tmp/scenes/$1 --arms sundae --seed $s -o $O/without-$t-$1-$s.jsonl"; done; done; }
# shorter CAPTURE SEED...: the fine-tune as the last 1,500 of 30,000 steps
shorter() { for s in ${*:2}; do job 04-$s-$1-shorter "python3 $Q /tmp/scenes/$1 -o /tmp/shorter/$1-$s --arms sundae-auto --seeds $s --steps-scale 0.95"; done; }
# tuned CAPTURE: seconds of a fine-tune of a shorter run, alone
tuned() { job 05-$1-tuned "until [ -f /tmp/shorter/$1-42/done/*.json ]; do sleep 1; done; python3 $R/benchmarks/bench_pack.py --run \$(dirname \$(find /tmp/shorter/$1-42 -name config.yml | head -1)) --finetune 1500 --views 8 > $O/tuned-$1.jsonl"; }
case $1 in
# One lease, nvidia-h100-x4, GPUS=4 SLOTS=4 RESERVED="0 1": profiles alone on two GPUs, all else on the others and after them
1) setup; take 3; GPU=0; profile fox 20000; GPU=; shorter fox 42 43; shorter stone_horse 42 43; job 06-fox-all "python3 $Q /tmp/scenes/fox -o /tmp/others/fox --arms sundae --seeds 42 --keep-ratios 1"; queue ;;
2) take 1 4; GPU=1; profile bonsai 1000 4000 8000 11000 20000; GPU=; without bonsai; shorter bonsai 42 43; shorter south_building 42 43; tuned bonsai ;;
3) take 2; without garden; shorter garden 42 43; shorter dinosaur 42 43 ;;
9) [ -f /tmp/logs/queue.log ] || { echo "no queue: another machine; give it back"; exit 3; }; SECONDS=0; wait_for_all "${2:-400}"; cat $O/*.jsonl | cut -c1-250 ;;
esac
