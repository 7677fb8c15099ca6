#!/usr/bin/env bash
# The choice of sundae-auto on six captures, then pytest -m gpu: bash lab/curve/lease3.sh PART [LIMIT] on two H100s.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=3
R=/tmp/repo; J=/tmp/jobs
whole() { for s in ${SEEDS:-42}; do echo "ANNEAL=${ANNEAL:-1} python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/auto${ANNEAL:-1}-$1-$s.json $s" > $J/$2-$1-$s.sh; done; }
share() { printf "python3 $R/benchmarks/quality.py /tmp/scenes/$1 -o /tmp/oracle/$1-$2 --arms sundae --seeds 42 --keep-ratios $2 --repeat-at $2\n" > $J/8-share-$2-$1.sh; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs /tmp/out $J; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  whole south_building 2; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; whole fox 1; whole garden 3; whole bonsai 4; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; whole dinosaur 5; whole stone_horse 6; touch $J/END
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-280}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log ;;
4) # the tests of the GPU on both; 150 s alone
  cd $R || exit; env PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider \
    -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" \
    $(grep -rlE --include="*.py" "mark\.gpu" tests) 2>&1 | tail -n 12 | cut -c1-300 ;;
5) rm -f $J/*; mv /tmp/logs/queue.log /tmp/logs/queue1.log; ANNEAL=0 whole stone_horse 1; ANNEAL=0 whole south_building 1; ANNEAL=0 whole dinosaur 1; ANNEAL=0 whole bonsai 1
  share fox 0.05; share bonsai 0.025; share dinosaur 0.025; share stone_horse 0.025; touch $J/END; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 &
  until grep -q "all done" /tmp/logs/queue.log 2>/dev/null || [ $SECONDS -gt "${2:-400}" ]; do sleep 1; done
  for s in /tmp/oracle/*; do cat $s/done/*.json; done > /tmp/out/oracle.jsonl; tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log ;;
esac
