#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on two H100s: the default on six captures, full fields made small without photos, kills.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=4
R=/tmp/repo; J=/tmp/jobs
auto() { echo "python3 $R/benchmarks/quality.py /tmp/scenes/$1 -o /tmp/oracle/$1 --arms sundae-auto --seeds 42; cp /tmp/oracle/$1/done/*.json /tmp/out/; for f in curve trials prune; do cp \$(find /tmp/oracle/$1/jobs -name \$f.json | head -1) /tmp/out/\$f-$1.json; done" > $J/$2-default-$1.sh; }
prune() {
  printf "sundae unpack /tmp/packed/$1.sundae -o /tmp/full/$1 --name r --data /tmp/scenes/$1 && python3 $R/benchmarks/prune_without_photos.py \$(dirname \$(find /tmp/full/$1 -name config.yml)) -o /tmp/out/prune-$1.csv --shares 0.1 0.5 --training none && python3 $R/benchmarks/prune_without_photos.py \$(dirname \$(find /tmp/full/$1 -name config.yml)) -o /tmp/out/prune-$1.csv --shares 0.1 --training distill distill-no-head\n" > $J/20-prune-$1.sh; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs /tmp/out $J /tmp/full /tmp/packed; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  auto south_building 10; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; auto bonsai 11; auto garden 12; auto fox 13; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; cp .gpu/packed/* /tmp/packed/; auto dinosaur 14; auto stone_horse 15; prune bonsai; prune fox; prune stone_horse
  for k in 0 1; do
    echo "timeout 300 python3 $R/benchmarks/kill_and_resume.py --kinds training --device cuda --kills 3 --seed $k" > $J/3$k-kills.sh
    echo "timeout 300 python3 $R/benchmarks/kill_and_resume.py --kinds trials --device cuda --kills 2 --seed $k" > $J/4$k-kills.sh
    echo "CUDA_VISIBLE_DEVICES=0,1 timeout 300 python3 $R/benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2 --kills 3 --seed $k" > $J/5$k-kills.sh
  done
  echo "timeout 200 python3 $R/benchmarks/full_disk.py --only 'pack --finetune'" > $J/60-disk.sh
  touch $J/END
  until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; tail -n 1 /tmp/logs/[3456]*.log | cut -c1-400 ;;
esac
