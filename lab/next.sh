#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on two H100s: the default on six captures (two alone), seeds, the fixed tenth, kills.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=5
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py
after() { [ -z "$ALONE" ] || printf "# after 00-bonsai-42\n# after 00-south_building-42\n"; }
auto() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-$3 --arms sundae-auto --seeds $3; cp /tmp/oracle/$1-$3/done/*.json $O/; for f in curve trials prune; do cp \$(find /tmp/oracle/$1-$3/jobs -name \$f.json | head -1) $O/\$f-$1-$3.json; done; cp \$(find /tmp/oracle/$1-$3/jobs -name '*.log' | head -1) $O/log-$1-$3.txt"; } > $J/$2-$1-$3.sh; }
tenth() { { after; echo "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$1-tenth --arms sundae --keep-ratios 0.1 --seeds 42; for f in /tmp/oracle/$1-tenth/done/*.json; do cp \$f $O/tenth-\$(basename \$f); done"; } > $J/$2-$1-tenth.sh; }
kills() { { after; echo "$3 timeout 300 python3 $R/benchmarks/kill_and_resume.py $2"; } > $J/$1-kills.sh; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs $O $J; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  ALONE= auto south_building 00 42; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; ALONE= auto bonsai 00 42; export ALONE=1
  auto garden 11 42; auto fox 12 42; auto bonsai 15 43; auto bonsai 15 44; tenth bonsai 30; tenth garden 30; sleep 1 ;;
3) export ALONE=1; cp -r .gpu/scenes/* /tmp/scenes/; auto dinosaur 13 42; auto stone_horse 14 42; auto dinosaur 16 43; auto dinosaur 16 44; tenth dinosaur 30
  kills 21 "--kinds training --device cuda --kills 3" ""; kills 22 "--kinds trials --device cuda --kills 2" ""; kills 23 "--kinds training --device cuda --gpus 2 --kills 2" "CUDA_VISIBLE_DEVICES=0,1"
  touch $J/END
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; tail -n 1 /tmp/logs/[123]*.log | cut -c1-300 ;;
esac
