set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=3
R=/tmp/repo; J=/tmp/jobs
if [ "$1" = start ]; then
pkill -f slots.py; pkill -f quality.py; pkill -f job.py; sleep 1
ls /tmp/oracle/*/done
rm -f $J/*; mv /tmp/logs/queue.log /tmp/logs/queue1.log
i=10
for s in 0.4 0.2 1.0 0.05 0.025; do for c in fox south_building garden bonsai dinosaur stone_horse; do
 echo "python3 $R/benchmarks/quality.py /tmp/scenes/$c -o /tmp/oracle/$c --arms sundae --seeds 42 --keep-ratios $s --repeat-at $s" > $J/$i-$s-$c.sh; i=$((i+1)); done; done
echo "python3 $R/benchmarks/quality.py /tmp/scenes/fox -o /tmp/oracle/fox --arms sundae --seeds 42 --keep-ratios 0.1 --repeat-at 0.1" > $J/19-0.1-fox.sh
touch $J/END
setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 &
fi
until grep -q "all done" /tmp/logs/queue.log 2>/dev/null || [ $SECONDS -gt $2 ]; do sleep 1; done
for s in /tmp/oracle/*; do cat $s/done/*.json > /tmp/out/oracle-$(basename $s).jsonl; done
cat /tmp/south/*/done/*.json > /tmp/out/south.jsonl 2>/dev/null; tar -czf "$OUT/out.tgz" -C /tmp out logs; tail -n 60 /tmp/logs/queue.log
