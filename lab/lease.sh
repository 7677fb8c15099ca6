#!/usr/bin/env bash
# Trials of counts with few views, with the rest and without, on four GPUs.
# lease.sh queue PART (carry what PART needs, see README), lease.sh wait SECONDS
set -u
H=$PWD
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=4 GPUS=4 RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
few() { echo "cd /tmp; PYTHONPATH=$3 python3 $R/$([ -d /tmp/scenes/$1/sparse/0 ] && [ $1 = courtyard ] && echo benchmarks/quality.py || echo lab/few.py) /tmp/scenes/$1 -o /tmp/few/$1-$2 --seeds 42 --arms $4"; }
if [ $1 = queue ]; then
  [ -f /tmp/logs/part$2 ] && exit 0
  if [ $2 = 1 ]; then
    s=$SECONDS; bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    mkdir -p $R $J $O /tmp/logs /tmp/scenes; cp -r benchmarks lab pyproject.toml $R/; cp lab/slots.py /tmp/
    sed -i 's/small = ours and .*/small = False/' $R/benchmarks/harness/job.py
    mkdir -p /opt/b; cp -rL /opt/site/sundae_ns /opt/b/
    sed -i 's/or num_views >= MANY_VIEWS or watched/or True or watched/' /opt/b/sundae_ns/train/trials.py
    diff /opt/site/sundae_ns/train/trials.py /opt/b/sundae_ns/train/trials.py
    cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & echo "set up in $((SECONDS-s)) s"
  fi
  [ -f /tmp/logs/queue.log ] || sleep 2; [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  touch /tmp/logs/part$2
  for c in $H/.gpu/p$2/scenes/courtyard $H/.gpu/p$2/cuts/*; do
    [ -d $c ] || continue; n=$(basename $c); cp -r $c /tmp/scenes/; views=${n##*-}
    case $views in 16) k=1;; 12) k=2;; 24) k=5;; *) k=0;; esac
    [ $k = 5 ] && on 35-rest-$n "$(few $n rest /opt/site sundae-auto)" && continue
    on 1$k-rest-$n "$(few $n rest /opt/site sundae-auto)"
    on 2$k-on-$n "$(few $n on /opt/b:/opt/site sundae-auto)"
  done
  for f in $H/.gpu/p$2/fields/*.sog; do
    [ -f $f ] || continue; n=$(basename $f .sog); mkdir -p /tmp/f$n; cp $f $H/.gpu/p$2/fields/$n.cameras.json /tmp/f$n/; mkdir -p /tmp/f$n/d; cp /tmp/f$n/*.json /tmp/f$n/d/
    on 13-levels-$n "cd /tmp; python3 $R/benchmarks/levels.py /tmp/f$n/$n.sog --decimated /tmp/f$n/d -o $O/levels-$n.csv"
  done
  ls $J | wc -l; tail -n 5 /tmp/logs/queue.log
else
  SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ]; do sleep 1; done
  for d in /tmp/few/*; do n=$(basename $d); cat $d/done/*.json 2>/dev/null | sed "s/^{/{\"set\": \"$n\", /"; done > $O/few.jsonl
  (cd /tmp/few; find . -name trials.json | tar -czf $O/trials.tgz -T -)
  tar -czf $OUT/out.tgz -C /tmp out/few.jsonl out/trials.tgz logs $(cd /tmp; ls out/levels-*.csv)
  awk '/done/' /tmp/logs/queue.log | tail -n 100; nvidia-smi --query-gpu=name,memory.used --format=csv,noheader; wc -l $O/few.jsonl
fi
