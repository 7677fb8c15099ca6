#!/usr/bin/env bash
# What waits for a GPU: bash lab/lease.sh PART on the device machine (two H100s), in the repository's root.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4
R=/tmp/repo; B=/tmp/base
both() { for i in 1 2; do echo "== base $i"; PYTHONPATH=$B:/opt/site "$@" base; echo "== new $i"; "$@" new; done; }
train() { python3 $R/benchmarks/bench_training.py /tmp/scenes/"$2" --arms sundae -o "$OUT/train-$3-$2.jsonl" 2>&1 | tail -n 3 | cut -c1-600; }
case $1 in
1) bash .gpu/setup.sh
  python3 lab/console_scripts.py
  mkdir -p /tmp/scenes $R $B /tmp/logs; cp -r .gpu/scenes/* /tmp/scenes/
  git -C . ls-files -z 2>/dev/null | xargs -0 -r cp --parents -t $R 2>/dev/null || cp -r benchmarks tests docs examples web README.md pyproject.toml CONTRIBUTING.md CHANGELOG.md Makefile method_configs sundae_ns mkdocs.yml $R/
  [ -d $R/tests ] || cp -r benchmarks tests docs examples web *.md pyproject.toml Makefile method_configs sundae_ns mkdocs.yml $R/
  tar -xzf .gpu/base.tar.gz -C $B; rm -rf $B/sundae_ns/method_configs; cp -r $B/method_configs $B/sundae_ns/method_configs
  rm -rf $R/sundae_ns; cd /tmp || exit
  nvidia-smi --query-gpu=name --format=csv,noheader; python3 -c "import sundae_ns; print(sundae_ns.__file__)"; PYTHONPATH=$B:/opt/site python3 -c "import sundae_ns; print(sundae_ns.__file__)"
  (export CUDA_VISIBLE_DEVICES=0
   setsid nohup bash -c "python3 $R/benchmarks/suite.py /tmp/scenes -o /tmp/suite --scenes bonsai --arms splatfacto --seeds 42 > /tmp/logs/stock.log 2>&1; echo done >> /tmp/logs/stock.log
     PYTHONPATH=$B:/opt/site python3 -c 'from sundae_ns.cli import main; main()' bench suite /tmp/scenes -o /tmp/old --scenes bonsai --arms sundae --seeds 42 > /tmp/logs/old.log 2>&1; echo done >> /tmp/logs/old.log" > /dev/null 2>&1 &)
  export CUDA_VISIBLE_DEVICES=1
  for i in 1 2; do
    [ $SECONDS -gt 330 ] && break
    (export PYTHONPATH=$B:/opt/site; cd $B/benchmarks && python3 bench_training.py /tmp/scenes/bonsai --arms sundae 2>&1 | tail -n 1 | cut -c1-500 | tee -a "$OUT/base.jsonl")
    train - bonsai new
  done; tail -n 2 /tmp/logs/stock.log ;;
2) cp -r .gpu/scenes/* /tmp/scenes/; cd /tmp || exit
  (export CUDA_VISIBLE_DEVICES=1; train - garden new & train - south_building new & 
   (export PYTHONPATH=$B:/opt/site; cd $B/benchmarks && python3 bench_training.py /tmp/scenes/south_building --arms sundae 2>&1 | tail -n 1 | cut -c1-500 | tee "$OUT/base-south.jsonl") & wait) > /tmp/logs/three.log 2>&1 &
  export CUDA_VISIBLE_DEVICES=0
  until grep -q done /tmp/logs/old.log 2>/dev/null || [ $SECONDS -gt 200 ]; do sleep 1; done
  tail -n 1 /tmp/logs/stock.log /tmp/logs/old.log
  STOCK=$(ls -d /tmp/suite/jobs/*/*/*/run | head -1); OLD=$(ls -d /tmp/old/jobs/*sundae-10*/*/*/run | head -1); echo "$STOCK $OLD"; cat /tmp/suite/done/*.json /tmp/old/done/*.json > "$OUT/suite.jsonl"
  for i in 1 2 3; do
    echo frame new; sundae bench frame --load-config "$OLD" --precisions bf16 --repeats 9 --json 2>&1 | grep ms_frame
    echo frame base; PYTHONPATH=$B:/opt/site sundae bench frame --load-config "$OLD" --precisions bf16 --repeats 9 --json 2>&1 | grep ms_frame
  done
  for i in 1 2; do
    echo graph new; python3 $R/benchmarks/bench_graph.py --points 5000000 --device cuda --distributions field 2>&1 | tail -n 1
    echo graph base; PYTHONPATH=$B:/opt/site python3 $R/benchmarks/bench_graph.py --points 5000000 --device cuda --distributions field 2>&1 | tail -n 1
  done
  python3 $R/benchmarks/bench_formats.py "$STOCK" -o "$OUT/formats.csv" 2>&1 | tail -n 8; python3 $R/benchmarks/bench_formats.py "$OLD" -o "$OUT/formats-sundae.csv" 2>&1 | tail -n 8
  python3 - "$STOCK" <<'P'
import sys, sundae_ns as sn, subprocess
from pathlib import Path
from sundae_ns.scenes.packed import packed_run
Path("/tmp/stock.sundae").write_bytes(packed_run(Path(sys.argv[1]))[1])
sn.save(sn.load(sys.argv[1]), "/tmp/stock.ply"); subprocess.run("xz -T16 -1 -k -f /tmp/stock.ply; ls -l /tmp/stock.ply*; split -b 16000000 -d /tmp/stock.ply.xz /tmp/stock.part.", shell=True)
P
  cp /tmp/stock.part.00 /tmp/stock.part.01 "$OUT"/ 2>/dev/null
  wait; cat /tmp/logs/three.log ;;
3) # tests of the GPU on both, and the rest of the file
  cd $R || exit
  (export CUDA_VISIBLE_DEVICES=1,0; setsid nohup env PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider \
    -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" \
    $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu|mark\.gpu" tests) > /tmp/logs/pytest.log 2>&1 &)
  cp /tmp/old/jobs/*/scene.sundae "$OUT"/bonsai.sundae; cp /tmp/stock.sundae "$OUT"/; for n in 02 03 04 05; do cp /tmp/stock.part.$n "$OUT"/ 2>/dev/null; done; sleep 1; ls -l "$OUT" ;;
4) for n in 06 07 08 09; do cp /tmp/stock.part.$n "$OUT"/ 2>/dev/null; done
  until grep -qE "(passed|failed|error).* in " /tmp/logs/pytest.log || [ $SECONDS -gt "${LIMIT:-420}" ]; do sleep 2; done
  grep -E "^(FAILED|ERROR)" /tmp/logs/pytest.log | cut -c1-200; tail -n 4 /tmp/logs/pytest.log | cut -c1-300; cp /tmp/logs/pytest.log "$OUT" ;;
esac
