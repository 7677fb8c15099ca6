#!/usr/bin/env bash
# Counts of few views tried in the middle of the growth (mid.patch), a tenth of half the steps, and the tests of a GPU.
# lease.sh queue PART (carry .gpu/pPART), lease.sh wait SECONDS
set -u
H=$PWD
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=${SLOTS:-4} GPUS=4 RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
arm() { on $1-$3-$2 "cd /tmp; PYTHONPATH=$4 python3 $R/lab/few_arms.py /tmp/scenes/$2 /tmp/few $3 ${*:5}"; }
if [ $1 = queue ]; then
  [ -f /tmp/logs/part$2 ] && exit 0
  if [ $2 = 1 ]; then
    s=$SECONDS; bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    mkdir -p $R $J $O /tmp/logs /tmp/scenes /opt/b; cp -r benchmarks lab tests docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; cp lab/slots.py /tmp/
    cp -rL /opt/site/sundae_ns /opt/b/; (cd /opt/b; patch -p1 < $H/lab/mid.patch)
    on 05-pytest "cd $R; PYTHONSAFEPATH=1 timeout 400 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests) | grep -E '^E  |^FAILED|^ERROR|passed' | tail -n 40"
    cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & echo "set up in $((SECONDS-s)) s"
    sleep 2
  fi
  [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  touch /tmp/logs/part$2
  for c in $H/.gpu/p$2/scenes/courtyard $H/.gpu/p$2/cuts/*; do
    [ -d $c ] || continue; n=$(basename $c); cp -r $c /tmp/scenes/
    arm 1$2 $n mid /opt/b:/opt/site sundae 30000
    arm 3$2 $n midh /opt/b:/opt/site sundae 15000
    arm 2$2 $n h10 /opt/site sundae 15000 --pipeline.model.pruning.keep-ratio 0.1
    [ $n = courtyard ] && arm 10 $n mid43 /opt/b:/opt/site sundae 30000 --seed 43
  done
  ls $J | wc -l; tail -n 5 /tmp/logs/queue.log
else
  SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ]; do sleep 1; done
  cat /tmp/few/*/result.json > $O/few.jsonl
  (cd /tmp/few; find . -name trials.json | tar -czf $O/trials.tgz -T -)
  tar -czf $OUT/out.tgz -C /tmp out/few.jsonl out/trials.tgz logs
  awk '/done/' /tmp/logs/queue.log | tail -n 100; grep -l Traceback /tmp/logs/*.log; nvidia-smi --query-gpu=name,memory.used --format=csv,noheader; wc -l $O/few.jsonl; cat /tmp/logs/05-pytest.log | cut -c1-300
fi
