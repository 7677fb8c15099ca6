#!/usr/bin/env bash
# bash lab/next.sh PART [LIMIT] on four H100s (kind nvidia-h100-x4): what waits for a GPU; lab/README.md says with which captures.
set -u
export PYTHONPATH=/opt/site PATH=/tmp/node:/opt/site/bin:$PATH OMP_NUM_THREADS=4 SLOTS=${SLOTS:-4} GPUS=4 ROOT=$PWD
R=/tmp/repo; J=/tmp/jobs; O=/tmp/out; Q=$R/benchmarks/quality.py; P=$R/benchmarks/prune_without_photos.py
job() { { [ -z "${AFTER:-}" ] || printf "# after %s\n" $AFTER; [ -z "${GPU:-}" ] || echo "# gpu $GPU"; [ -z "${SITE:-}" ] || echo "export PYTHONPATH=/tmp/site-$SITE:/opt/site"; echo "$2"; } > $J/$1.sh; }
# variant NAME 's/…/…/' FILE: a copy of the package with one line changed
variant() { mkdir -p /tmp/site-$1; [ -d /tmp/site-$1/sundae_ns ] || cp -r /opt/site/sundae_ns /tmp/site-$1/; sed -i "$2" /tmp/site-$1/sundae_ns/$3; cmp -s /tmp/site-$1/sundae_ns/$3 /opt/site/sundae_ns/$3 && echo "variant $1: $3 unchanged"; }
# auto CAPTURE ORDER SEED [finetune]: the default, with its records
auto() { n=$1-${SITE:-now}-$3; job $2-$n "python3 $Q /tmp/scenes/$1 -o /tmp/oracle/$n --arms sundae-auto --seeds $3; for f in /tmp/oracle/$n/done/*.json; do cp \$f $O/done-$n-\$(basename \$f); done; for f in curve trials prune; do cp \$(find /tmp/oracle/$n/jobs -name \$f.json | head -1) $O/\$f-$n.json; done${4:+; RUN=\$(dirname \$(find /tmp/oracle/$n/jobs -name config.yml | head -1)); for w in '' '--target-drop 0.1' '--finetune 1500' '--finetune 1500 --target-drop 0.1' '--finetune 3000 --target-drop 0.1'; do echo \"PACK \$w\"; sundae pack \$RUN -o /tmp/oracle/$n/tuned.sundae --overwrite --json \$w; done}"; }
full() { job $2-$1-full "python3 $Q /tmp/scenes/$1 -o /tmp/full/$1 --arms sundae-no-head --keep-ratios 1 --seeds 42; cp /tmp/full/$1/done/*no-head*.json $O/"; }
rows() { AFTER="$1-full" job $2-$1-rows "RUN=\$(dirname \$(find /tmp/full/$1/jobs -name config.yml | grep no-head | head -1)); python3 $P \$RUN -o $O/prune-$1.csv --shares $3 --training none; for n in 3000 12000; do python3 $P \$RUN -o $O/prune-$1.csv --shares 0.1 --training distill distill-no-head --steps \$n; done; python3 $P \$RUN -o $O/prune-$1.csv --shares $3 --training none --splat-transform /tmp/node/splat-transform"; }
stock() { job $2-$1-stock "python3 $Q /tmp/scenes/$1 -o /tmp/stock/$1 --arms splatfacto --seeds 42; cp /tmp/stock/$1/done/*.json $O/; RUN=\$(dirname \$(find /tmp/stock/$1/jobs -name config.yml | head -1)); python3 $R/benchmarks/bench_formats.py \$RUN -o $O/formats-$1.csv; python3 $P \$RUN -o $O/prune-stock-$1.csv --shares 0.1 0.5 --training none"; }
take() { mkdir -p /tmp/scenes /tmp/full /tmp/node; cp -r "$ROOT"/.gpu/s$1/* /tmp/scenes/; [ ! -d "$ROOT/.gpu/node" ] || tar -xJf "$ROOT"/.gpu/node/nodepack.tar.xz -C /tmp/node; ls /tmp/scenes; }
case $1 in  # scenes of part N lie in .gpu/sN
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O $J; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; take $1; cd /tmp || exit
  variant few 's/len(indices) \/\/ HELD_OUT_EVERY), 0)/max(min(8, len(indices) \/\/ 8), len(indices) \/\/ 16)), 0)/' training/trials/count.py
  variant few 's/len(indices) \/\/ HELD_OUT_EVERY)), 1)/max(min(8, len(indices) \/\/ 8), len(indices) \/\/ 16))), 1)/' training/trials/head.py
  cp -r /tmp/site-few /tmp/site-both
  for v in skip both; do
    variant $v 's/return self._choice(curve)\[0\] > kept_count(USUAL_SHARE, self.progress.full)/return kept_count(USUAL_SHARE, self.progress.full) < self._choice(curve)[0] < 0.8 * self.progress.full/' training/trials/count.py
    variant $v 's/^        count, reason = self._choice(curve)$/&\n        if not self._alone and count >= 0.8 * progress.full:\n            progress.head_pays = False/' training/trials/count.py
    variant $v 's/if progress.head_pays is not None:/if progress.head:/' training/trials/count.py
  done
  setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 & sleep 1
  GPU=0 job 00-pytest 'cd /tmp/repo; PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu" tests)'
  stock garden 01; full dinosaur 02; full garden 02; rows dinosaur 03 "0.1 0.5 0.2 0.05"; rows garden 03 "0.5 0.2 0.05"
  job 04-kill-trials-0 "timeout 420 python3 $R/benchmarks/kill_and_resume.py --kinds trials --device cuda --kills 3"
  job 04-kill-trials-1 "timeout 420 python3 $R/benchmarks/kill_and_resume.py --kinds trials --device cuda --kills 3 --seed 1"
  job 04-kill-gpus "CUDA_VISIBLE_DEVICES=2,3 timeout 420 python3 $R/benchmarks/kill_and_resume.py --kinds training --device cuda --gpus 2 --kills 3"
  auto garden 05 43 t; auto dinosaur 05 43 t; SITE=few auto garden 08 42; SITE=few auto dinosaur 08 42 ;;
2) take $1; full fox 02; rows fox 03 "0.1 0.5 0.2 0.05"; auto fox 05 44 t; SITE=few auto fox 08 42
  job 09-disk "timeout 400 python3 $R/benchmarks/full_disk.py --only train 'pack --finetune'" ;;
3) take $1; stock south_building 01; auto stone_horse 05 43 t
  for s in 42 43; do for v in few skip both; do SITE=$v auto south_building 06 $s $([ $v$s = both42 ] && echo t); done; done; SITE=few auto stone_horse 08 42
  job 07-south-control "python3 $Q /tmp/scenes/south_building -o /tmp/oracle/control --arms $R/lab/arms-control.yaml --keep-ratios 1 --repeat-at 1 --seeds 42 43; cp /tmp/oracle/control/done/*.json $O/" ;;
4) take $1; stock bonsai 01; SITE=few auto bonsai 08 42 t
  touch $J/END; until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log; tail -n 3 /tmp/logs/*pytest.log; for f in /tmp/logs/*kill*.log /tmp/logs/*disk.log; do echo $f; tail -n 3 $f | cut -c1-900; done ;;
5) until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "${2:-300}" ]; do sleep 1; done
  tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log | tail -n 60; tail -n 3 /tmp/logs/*pytest.log; for f in /tmp/logs/*kill*.log /tmp/logs/*disk.log; do echo $f; tail -n 3 $f | cut -c1-900; done ;;
esac
