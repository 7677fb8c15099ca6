#!/usr/bin/env bash
# Ways to make steps cheaper (issue 73), by fast.patch. fast.sh queue PART (carry .gpu/pPART), wait SECONDS, go ENV [OPTIONS], end SECONDS
set -u
H=$PWD
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 SLOTS=2 GPUS=2 RESERVED=
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out
on() { printf '%s\n' "${@:2}" > $J/$1.sh.new; mv $J/$1.sh.new $J/$1.sh; }
br() { on 2$7-$1-$3-s$4 "# after $1-warm-s$4" "# gpu $2" "cd /tmp; export PYTHONPATH=/opt/b:/opt/site $6; timeout 500 python3 $R/lab/branch.py /tmp/scenes/$1 /tmp/br $3 --seed $4 $5 ${*:8}"; }
time_() { on $1 "# gpu $2" "cd /tmp; export PYTHONPATH=$4 $5; timeout 400 python3 $R/benchmarks/bench_training.py /tmp/scenes/$3 --arms ${7:-sundae} -o $O/$1.jsonl ${6:-}"; }
if [ $1 = queue ]; then
  [ -f /tmp/logs/part$2 ] && exit 0
  if [ $2 = 1 ]; then
    s=$SECONDS; bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    mkdir -p $R $J $O /tmp/logs /tmp/scenes /opt/b; cp -r benchmarks lab tests docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; cp lab/slots.py /tmp/
    cp -rL /opt/site/sundae_ns /opt/b/; (cd /opt/b; patch -s -p1 < $H/lab/fast.patch; grep -c alternating sundae_ns/plugin/trainer.py)
    (cd benchmarks; PYTHONPATH=/opt/b:/opt/site python3 -W ignore -c 'import harness.job, sundae_ns.method_configs; print(sundae_ns.__file__)') || exit 3
    cd /tmp; setsid nohup python3 /tmp/slots.py > /tmp/logs/q.out 2>&1 & echo "set up in $((SECONDS-s)) s"
    sleep 1
  fi
  [ -f /tmp/logs/queue.log ] || { echo "part 1 has not run here: give the machine back"; exit 3; }
  touch /tmp/logs/part$2; cd $H
  for c in .gpu/p$2/scenes/*; do
    [ -d $c ] || continue; n=$(basename $c); cp -r $c /tmp/scenes/
    case $n in
      bonsai|garden)
        [ $n = bonsai ] && g=0 || g=1
        W="--pipeline.model.head.mode residual --pipeline.model.head.num-features 29"
        on 0-$n-warm-s42 "# gpu $g" "cd /tmp; python3 $R/lab/branch.py /tmp/scenes/$n /tmp/br warm --seed 42"
        br $n $g s18 42 .33 "REST=2" 1 $W --pipeline.model.head.start-at 18000
        br $n $g h2u25s3 42 .33 "REST=2 HEAD=2 UNTIL=25000 SCALE=0.3" 1 $W
        br $n $g h2u20 42 .33 "REST=2 HEAD=2 UNTIL=20000" 1 $W
        [ $n = bonsai ] && time_ 30-base-$n 0 $n /opt/site A=1
        [ $n = garden ] && on 30-pytest "# gpu 1" "cd $R; export PYTHONPATH=/opt/b:/opt/site; PYTHONSAFEPATH=1 timeout 300 python3 -m pytest -q -n 8 -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload -pxdist.plugin' \$(grep -rlE --include='*.py' 'mark.gpu|pytestmark.*gpu' tests) | grep -E '^E  |^FAILED|^ERROR|passed|rror' | tail -n 40"
        ;;
      south_building) time_ 31-base-$n 0 $n /opt/site A=1;;
    esac
  done
  ls $J | wc -l; tail -n 5 /tmp/logs/queue.log
elif [ $1 = go ]; then
  export SLOTS=1
  time_ 30-base-bonsai 0 bonsai /opt/site A=1; time_ 31-new-bonsai 0 bonsai /opt/b:/opt/site "$2"
  time_ 32-base-south 1 south_building /opt/site A=1; time_ 33-new-south 1 south_building /opt/b:/opt/site "$2"
  time_ 34-new-garden 0 garden /opt/b:/opt/site "$2"; time_ 35-new-stone_horse 1 stone_horse /opt/b:/opt/site "$2"
  time_ 36-new-courtyard 1 courtyard /opt/b:/opt/site "$2"; sed -i 's/SLOTS", 4/SLOTS", 1/' /tmp/slots.py
  ls $J | wc -l
else
  [ $1 = end ] && touch $J/END; SECONDS=0
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ] || { [ $1 = wait ] && [ $(ls /tmp/br/branches 2>/dev/null | wc -l) -ge 6 ]; }; do sleep 1; done
  cat /tmp/br/branches/*.json > $O/fast.jsonl; cat $O/[34]*.jsonl
  tar -czf $OUT/out.tgz -C /tmp out logs
  python3 - <<'P'
import json
for l in open('/tmp/out/fast.jsonl'):
    r=json.loads(l); m=r['measured']
    print(r['set'],r['arm'],m['primitives'],' | '.join(f"{c['name']}: {sum(x['psnr'] for x in c['views'])/len(c['views']):.2f} {sum(x['ssim'] for x in c['views'])/len(c['views']):.4f}" for c in m['configurations']))
P
  awk '/done/' /tmp/logs/queue.log | tail -n 20; grep -l Traceback /tmp/logs/*.log; cut -c1-250 /tmp/logs/30-pytest.log
fi
