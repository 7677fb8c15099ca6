#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on two H100s: the default on six captures (two alone), tests of the GPU, seeds, the fixed tenth.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=${SLOTS:-4}
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py

auto() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-$3 --arms sundae-auto --seeds $3; cp /tmp/oracle/$1-$3/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$1-$3/jobs -name \$f.json | head -1) $O/\$f-$1-$3.json; done"; } > $J/$2-$1-$3.sh; }
tenth() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-tenth --arms sundae --keep-ratios 0.1 --seeds 42; for f in /tmp/oracle/$1-tenth/done/*.json; do cp \$f $O/tenth-\$(basename \$f); done"; } > $J/$2-$1-tenth.sh; }
job() { { after; echo "$2"; } > $J/$1.sh; }
wait_for() { touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${1:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; }
start() { bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs $O $J; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"; }
queue() { setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1; }
PYTEST='cd /tmp/repo; export CUDA_VISIBLE_DEVICES=1,0 PYTHONSAFEPATH=1; python3 -m pytest -q -m gpu -p no:cacheprovider --durations=15 -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu" tests) > /tmp/logs/pytest.log 2>&1'
after() { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; }
shares() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-shares --arms sundae --keep-ratios $3 --seeds 42; for f in /tmp/oracle/$1-shares/done/*.json; do cp \$f $O/shares-\$(basename \$f); done; R=\$(ls -d /tmp/oracle/$1-shares/jobs/*100pct*/*/*/run 2>/dev/null | head -1); [ -z \"\$R\" ] || sundae pack \$R -o /tmp/oracle/full-$1.sundae"; } > $J/$2-$1-shares.sh; }
ALONE='for i in 1 2 3; do date +%s.%N; sundae prune /tmp/full/bonsai.sundae -o /tmp/b-$i.sundae --keep 0.1; date +%s.%N; done; python3 -X importtime -c "import sundae_ns.cli" 2>&1 | tail -1; python3 /tmp/repo/lab/alone.py; for n in "" --no-head; do date +%s.%N; sundae distill /tmp/full/bonsai.sundae -o /tmp/d$n.sundae --keep 0.1 $n; date +%s.%N; done'
case $1 in
b1) start; mkdir -p /tmp/full; cp .gpu/full/* /tmp/full/; GPU=0 job 00-alone "$ALONE"
  GPU=1 job 01-stock "(cd /tmp; python3 $R/benchmarks/suite.py /tmp/stock-scenes -o /tmp/stock --arms splatfacto --seeds 42; cp /tmp/stock/done/*.json $O/; S=\$(ls -d /tmp/stock/jobs/*/*/*/run | head -1); python3 $R/benchmarks/bench_formats.py \$S -o $O/formats.csv --splat-transform /tmp/node/splat-transform)"
  GPU=1 shares dinosaur 20 "0.1 1"; ;;
b2) cp -r .gpu/scenes/* /tmp/scenes/; cp .gpu/full/* /tmp/full/; mkdir -p /tmp/stock-scenes; cp -r /tmp/scenes/bonsai /tmp/stock-scenes/; queue
  AFTER=00-alone; job 02-refit-bonsai "python3 $R/lab/refit.py bonsai"; GPU=1 shares garden 21 "0.1 1"; shares bonsai 22 0.1 ;;
b3) cp -r .gpu/scenes/* /tmp/scenes/; mkdir -p /tmp/node; tar -xJf .gpu/node/nodepack.tar.xz -C /tmp/node
  AFTER=00-alone; auto fox 10 42; auto fox 11 43; shares fox 23 0.1; job 03-refit-fox "python3 $R/lab/refit.py fox"; job 04-refit-stone_horse "python3 $R/lab/refit.py stone_horse" ;;
b4) cp -r .gpu/scenes/* /tmp/scenes/; AFTER=00-alone; auto south_building 12 43; shares south_building 24 "0.1 1"
  wait_for "${2:-430}"; cp /tmp/oracle/full-*.sundae "$OUT"/; tail -n 40 /tmp/logs/00-alone.log | cut -c1-200; ls -l "$OUT" ;;
esac
