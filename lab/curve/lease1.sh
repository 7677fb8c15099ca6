#!/usr/bin/env bash
# Oracle and recorded trials: bash lab/curve/lease1.sh PART on the device machine (two H100s), in the repository's root.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=3
R=/tmp/repo; B=/tmp/base; J=/tmp/jobs
warm() { # scene: the warm-up with the 10% branch, and the recorded trials
  echo "python3 $R/benchmarks/quality.py /tmp/scenes/$1 -o /tmp/oracle/$1 --arms sundae --keep-ratios 0.1 --repeat-at 0.1" > $J/1-warm-$1.sh
  echo "python3 $R/lab/curve/record.py /tmp/scenes/$1 /tmp/out/record-$1.json" > $J/2-record-$1.sh; }
shares() { for s in 1.0 0.4 0.2 0.05 0.025; do printf "# after warm-$1\npython3 $R/benchmarks/quality.py /tmp/scenes/$1 -o /tmp/oracle/$1 --arms sundae --keep-ratios $s --repeat-at $s\n" > $J/3-share-$s-$1.sh; done; }
old() { for s in 43 44; do
  echo "PYTHONPATH=$B:/opt/site python3 -c 'from sundae_ns.cli import main; main()' bench suite /tmp/scenes -o /tmp/south/old$s --scenes south_building --arms sundae --seeds $s" > $J/4-old-$s.sh
  echo "python3 $R/benchmarks/suite.py /tmp/scenes -o /tmp/south/new$s --scenes south_building --arms $R/lab/curve/ten.yaml --seeds $s" > $J/4-new-$s.sh; done; }
gather() { mkdir -p "$OUT"; for s in /tmp/oracle/*; do cat $s/done/*.json > /tmp/out/oracle-$(basename $s).jsonl; done 2>/dev/null; cat /tmp/south/*/done/*.json > /tmp/out/south.jsonl 2>/dev/null; tar -czf "$OUT/out.tgz" -C /tmp out logs; cat /tmp/logs/queue.log | tail -n "${1:-30}"; }
waiting() { until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt "$1" ]; do sleep 1; done; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log
  python3 - <<'P'
import configparser, glob, os
for entry in glob.glob("/opt/site/nerfstudio-*.dist-info/entry_points.txt") + glob.glob("/opt/site/sundae_ns-*.dist-info/entry_points.txt"):
    found = configparser.ConfigParser(); found.optionxform = str; found.read(entry)
    os.makedirs("/opt/site/bin", exist_ok=True)
    for name, place in found["console_scripts"].items():
        module, function = place.split(":"); path = f"/opt/site/bin/{name}"
        if not os.path.exists(path):
            open(path, "w").write(f"#!/usr/bin/env python3\nfrom {module} import {function}\n{function}()\n"); os.chmod(path, 0o755)
P
  mkdir -p /tmp/scenes $R $B /tmp/logs /tmp/out $J /tmp/oracle /tmp/south; cp -r .gpu/scenes/* /tmp/scenes/
  cp -r benchmarks tests docs examples web lab *.md pyproject.toml Makefile mkdocs.yml $R/ 2>/dev/null
  tar -xzf .gpu/base.tar.gz -C $B; rm -rf $B/sundae_ns/method_configs; cp -r $B/method_configs $B/sundae_ns/method_configs
  cd /tmp || exit
  nvidia-smi --query-gpu=name --format=csv,noheader; python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  warm south_building; shares south_building; old
  setsid nohup python3 $R/lab/curve/slots.py > /tmp/logs/q.out 2>&1 &
  sleep 5; tail -n 3 /tmp/logs/queue.log ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; for s in bonsai garden fox; do warm $s; shares $s; done; sleep 1 ;;
3) cp -r .gpu/scenes/* /tmp/scenes/; for s in dinosaur stone_horse; do warm $s; shares $s; done; touch $J/END; waiting "${2:-500}"; gather; tail -n 3 /tmp/logs/1-warm-*.log /tmp/logs/2-*.log | cut -c1-300 ;;
4) waiting "${2:-560}"; gather 60 ;;
esac
