#!/usr/bin/env bash
# bash lab/curve/lease6.sh PART [LIMIT] on two H100s: sundae-auto by the new weights with long trials of the head, the same counts with a head in any case, full fields of the other three captures.
set -u
export PYTHONPATH=/opt/site PATH=/opt/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=3
R=/tmp/repo; J=/tmp/jobs
auto() { echo "LONG=1 python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/auto3-$1-42.json 42" > $J/$2-auto-$1.sh; }
head() { echo "METHOD=sundae python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/head-$1.json 42 --pipeline.model.pruning.keep-ratio $2 --pipeline.model.head.mode residual" > $J/20-head-$1.sh; }
full() { echo "METHOD=sundae python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/full-$1.json 42 --pipeline.model.pruning.keep-ratio 1.0 --pipeline.model.head.mode off; sundae pack /tmp/whole/full-$1/r/sundae/run -o /tmp/full/$1.sundae" > $J/30-full-$1.sh; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs /tmp/out $J /tmp/full; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  auto south_building 10; head south_building 0.87; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; auto bonsai 11; auto garden 12; auto fox 13; head bonsai 0.41; head fox 0.17; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; auto dinosaur 14; auto stone_horse 15; full garden; full dinosaur; full south_building; touch $J/END
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-400}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cp /tmp/full/*.sundae "$OUT/"; cat /tmp/logs/queue.log ;;
esac
