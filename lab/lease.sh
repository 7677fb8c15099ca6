#!/usr/bin/env bash
# Fixed shares of 12, 16, 24 views, trials of counts with few views, and six fields at their full count, on four GPUs.
# lease.sh queue PART (carry what PART needs, see README), lease.sh wait SECONDS
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=4 GPUS=4 RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { echo "$2" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
few() { echo "cd /tmp; PYTHONPATH=$3 python3 $R/lab/few.py /tmp/scenes/$1 -o /tmp/few/$1-$2 --seeds 42 --arms $4"; }
field() {
  w=""; [ -d /tmp/scenes/$1/sparse/0 ] && w="colmap --colmap-path sparse/0 --downscale-factor 1 --eval-mode interval --eval-interval 8"
  echo "cd /tmp; ns-train sundae --data /tmp/scenes/$1 --output-dir /tmp/fields --experiment-name $1 --timestamp run --max-num-iterations 20000 --pipeline.model.pruning.mode off --pipeline.model.head.mode off --vis tensorboard $w && sundae export /tmp/fields/$1/sundae/run -o $O/$1.spz && sundae export /tmp/fields/$1/sundae/run -o $O/$1.sog"
}
if [ $1 = queue ]; then
  [ -f /tmp/logs/part$2 ] && exit 0
  if [ $2 = 1 ]; then
    s=$SECONDS; bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    mkdir -p $R $J $O /tmp/logs /tmp/scenes; cp -r benchmarks lab pyproject.toml $R/; cp lab/slots.py /tmp/
    sed -i 's/small = ours and .*/small = False/' $R/benchmarks/harness/job.py
    for t in a b; do
      mkdir -p /opt/$t; cp -rL /opt/site/sundae_ns /opt/$t/; f=/opt/$t/sundae_ns/train/trials.py
      sed -i 's/: num_views < MANY_VIEWS,/: num_views < 8,/; s/^        promising = .*/        promising = True/' $f
      sed -i 's,num_views // choice.HELD_OUT_EVERY),num_views // (4 if num_views < 32 else 8)),' $f
    done
    sed -i '/self._judges = choice.spread/s/, 0)$/, 1)/; s/or num_views >= MANY_VIEWS or watched/or True or watched/' /opt/b/sundae_ns/train/trials.py
    diff /opt/site/sundae_ns/train/trials.py /opt/b/sundae_ns/train/trials.py
    cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & echo "set up in $((SECONDS-s)) s"
  fi
  [ -f /tmp/logs/queue.log ] || sleep 2; [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  touch /tmp/logs/part$2
  for c in .gpu/p$2/scenes/*; do [ -d $c ] || continue; n=$(basename $c); [ -d /tmp/scenes/$n ] && continue; cp -r $c /tmp/scenes/; on 00-field-$n "$(field $n)"; done
  for c in .gpu/p$2/cuts/*; do
    [ -d $c ] || continue; n=$(basename $c); [ -d /tmp/scenes/$n ] && continue; cp -r $c /tmp/scenes/; views=${n##*-}
    ratios="0.05 0.1 0.2 0.4"; [ $views = 24 ] && ratios="$ratios 1.0"
    case $views in 16) k=1;; 12) k=2;; 24) k=3;; esac
    on 1$k-fixed-$n "$(few $n fixed /opt/site "sundae --keep-ratios $ratios")"
    on 2$k-a-$n "$(few $n a /opt/a:/opt/site sundae-auto)"
    on 3$k-b-$n "$(few $n b /opt/b:/opt/site sundae-auto)"
  done
  ls $J | wc -l; tail -n 5 /tmp/logs/queue.log
else
  SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ]; do sleep 1; done
  for d in /tmp/few/*; do n=$(basename $d); cat $d/done/*.json 2>/dev/null | sed "s/^{/{\"set\": \"$n\", /"; done > $O/few.jsonl
  (cd /tmp/few; find . -name trials.json | tar -czf $O/trials.tgz -T -)
  tar -czf $OUT/out.tgz -C /tmp out/few.jsonl out/trials.tgz logs
  cp $O/*.sog $OUT/
  awk '/done/' /tmp/logs/queue.log | tail -n 100; nvidia-smi --query-gpu=name,memory.used --format=csv,noheader; wc -l $O/few.jsonl
fi
