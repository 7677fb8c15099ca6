#!/usr/bin/env bash
# bash lab/curve/lease5.sh PART [LIMIT] on two H100s: trials of sundae-auto on six captures, full fields made small
# without photos on three, harmonics of lower degrees, pytest -m gpu.
set -u
export PYTHONPATH=/opt/site PATH=/opt/node:/opt/site/bin:$PATH OMP_NUM_THREADS=3 SLOTS=6
R=/tmp/repo; J=/tmp/jobs
whole() { echo "python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/auto2-$1-42.json 42" > $J/10-whole-$1.sh; }
full() {
  echo "METHOD=sundae python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/full-$1.json 42 --pipeline.model.pruning.keep-ratio 1.0 --pipeline.model.head.mode off" > $J/20-full-$1.sh
  for s in 0.5 0.1; do printf "# after full-$1\npython3 $R/benchmarks/prune_without_photos.py /tmp/whole/full-$1/r/sundae/run -o /tmp/out/prune-$1-$s.csv --shares $s --splat-transform splat-transform --training none $( [ $s = 0.1 ] && echo distill distill-no-head )\n" > $J/21-prune-$1-$s.sh; done
  printf "# after full-$1\nsundae pack /tmp/whole/full-$1/r/sundae/run -o /tmp/full/$1.sundae\n" > $J/22-pack-$1.sh; }
degree() { echo "METHOD=sundae python3 $R/lab/curve/whole.py /tmp/scenes/$1 /tmp/out/degree$2-$1.json 42 --pipeline.model.sh-degree $2" > $J/30-degree$2-$1.sh; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R /tmp/logs /tmp/out $J /opt/node /tmp/full; cp -r .gpu/scenes/* /tmp/scenes/; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
  cd /tmp || exit; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  whole south_building; setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 2 ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; tar -xJf .gpu/node/nodepack.tar.xz -C /opt/node; splat-transform --version; whole fox; whole garden; full fox; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; whole bonsai; whole dinosaur; whole stone_horse; full bonsai; full stone_horse
  for s in bonsai stone_horse; do degree $s 1; degree $s 2; done
  echo "cd $R; CUDA_VISIBLE_DEVICES=0,1 PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o 'addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload' \$(grep -rlE --include='*.py' 'mark\.gpu' tests)" > $J/25-pytest.sh
  touch $J/END
  until [ "$(grep -c 'done 10-whole' /tmp/logs/queue.log)" = 6 ] || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log ;;
4) until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cp /tmp/full/*.sundae "$OUT/"; cat /tmp/logs/queue.log; tail -n 15 /tmp/logs/25-pytest.log | cut -c1-250 ;;
esac
