#!/usr/bin/env bash
# Tests of a GPU, trainings by the default (*bonsai*, *courtyard* by three seeds), and asked sizes; on four GPUs.
# last.sh queue PART (carry .gpu/pPART), last.sh wait SECONDS
set -u
H=$PWD
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=${SLOTS:-4} GPUS=${GPUS:-4} RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { printf '%s\n' "${@:2}" | if [ $GPUS = 1 ]; then sed '/^# gpu/d'; else cat; fi > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
arm() { on $1-$3-$2 "# gpu $5" "cd /tmp; python3 $R/lab/few_arms.py /tmp/scenes/$2 /tmp/few $3 sundae 30000 --seed $4"; }
if [ $1 = queue ]; then
  [ -f /tmp/logs/part$2 ] && exit 0
  if [ $2 = 1 ]; then
    s=$SECONDS; bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    mkdir -p $R $J $O /tmp/logs /tmp/scenes; cp -r benchmarks lab tests docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; cp lab/slots.py /tmp/
    on 05-pytest "# gpu 0" "cd $R; PYTHONSAFEPATH=1 timeout 400 python3 -m pytest -q -n 8 -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload -pxdist.plugin' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests) | grep -E '^E  |^FAILED|^ERROR|passed|rror' | tail -n 40"
    cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & echo "set up in $((SECONDS-s)) s"
    sleep 2
  fi
  [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  touch /tmp/logs/part$2
  for c in $H/.gpu/p$2/scenes/*; do
    [ -d $c ] || continue; n=$(basename $c); cp -r $c /tmp/scenes/
    case $n in
      courtyard)
        for k in ${SEEDS:-42 43 44}; do arm 10 $n default$k $k 2; done
        [ $GPUS = 1 ] && continue
        for m in 0.25 1 4; do on 11-size-$n-$m "# gpu $([ $m = 1 ] && echo 2 || echo 1)" "cd /tmp; python3 $R/benchmarks/sizes_asked.py /tmp/scenes/$n --sizes $m -o $O/sizes-$n-$m.csv"; done;;
      *) arm 10 $n default42 42 1;;
    esac
  done
  for f in $H/.gpu/p$2/fields/*.sog; do
    [ -f $f ] || continue; n=$(basename $f .sog); cp $f $H/.gpu/p$2/fields/$n.cameras.json /tmp/scenes/
    on 12-size-$n "# gpu $([ $n = fox ] && echo 1 || echo 3)" "cd /tmp; python3 $R/benchmarks/sizes_asked.py /tmp/scenes/$n.sog -o $O/sizes-$n.csv"
  done
  ls $J | wc -l; tail -n 5 /tmp/logs/queue.log
else
  touch $J/END; SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ]; do sleep 1; done
  cat /tmp/few/*/result.json > $O/few.jsonl
  (cd /tmp/few; find . -name trials.json | tar -czf $O/trials.tgz -T -)
  tar -czf $OUT/out.tgz -C /tmp out logs
  awk '/done/' /tmp/logs/queue.log | tail -n 30; grep -l Traceback /tmp/logs/*.log; wc -l $O/few.jsonl; cut -c1-300 /tmp/logs/05-pytest.log
fi
