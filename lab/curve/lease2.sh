#!/usr/bin/env bash
# Whole trainings of the default on six captures: bash lab/curve/lease2.sh PART [LIMIT] on the device machine (two H100s).
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=3
R=/tmp/repo; J=/tmp/jobs
whole() { for s in ${SEEDS:-42}; do echo "python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/whole-$1-$s.json $s" > $J/$2-$1-$s.sh; done; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  mkdir -p /tmp/scenes $R /tmp/logs /tmp/out $J; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  whole south_building 2; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; whole fox 1; whole garden 3; whole bonsai 4; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; whole dinosaur 5; whole stone_horse 6; touch $J/END
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-270}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; tail -qn 2 /tmp/logs/[1-6]-*.log | cut -c1-200 ;;
esac
