#!/usr/bin/env bash
# What waits for a GPU: bash lab/lease.sh PART, in the repository's root on the device machine, in this order. Two GPUs
# (nvidia-h200-x2; H100s come too) take less wall time for the same device time. First carry .gpu/wheels, .gpu/setup.sh, the
# .so.xz of gsplat 1.4.0 and .gpu/scenes/{bonsai,stone_horse}, then .gpu/scenes/{garden,fox}: all at once is more than 64 MiB.
set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=3
alone() { export PYTHONPATH=/opt/site:/tmp/benchmarks; cd /tmp || exit; T="python3 /tmp/benchmarks/bench_training.py"; }
case $1 in
1) # set up (40 s), and start the queue of lab/queue.txt, four at a time on each GPU
  bash .gpu/setup.sh
  # nerfstudio's commands: the project's installation has replaced the folder that held them
  python3 - <<'P'
import configparser, glob, os
found = configparser.ConfigParser(); found.optionxform = str
found.read(glob.glob("/opt/site/nerfstudio-*.dist-info/entry_points.txt"))
for name, place in found["console_scripts"].items():
    module, function = place.split(":")
    path = f"/opt/site/bin/{name}"
    if not os.path.exists(path):
        open(path, "w").write(f"#!/usr/bin/env python3\nfrom {module} import {function}\n{function}()\n"); os.chmod(path, 0o755)
P
  mkdir -p /tmp/scenes /tmp/results /tmp/logs
  cp -r .gpu/scenes/* /tmp/scenes/; cp -r lab benchmarks tests pyproject.toml /tmp/
  for c in bonsai garden stone_horse; do ln -sfn $c /tmp/scenes/${c}16; done  # 16 views
  nvidia-smi --query-gpu=name --format=csv,noheader
  export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps
  mkdir -p /tmp/mps && nvidia-cuda-mps-control -d
  cp lab/queue.txt /tmp/queue.txt; cd /tmp || exit
  setsid nohup python3 /tmp/lab/run_queue.py /tmp/queue.txt "${PER:-4}" /tmp/lab/full.py > /tmp/queue.log 2>&1 & sleep 1 ;;
2) # the other captures; wait for the queue (14 finishes with a head and 4 warm-ups: 400 s on two H100s)
  cp -r .gpu/scenes/* /tmp/scenes/
  until [ $SECONDS -gt "${LIMIT:-500}" ]; do sleep 2
    [ "$(grep -c ' end ' /tmp/queue.log)" -ge "$(grep -vc '^#' /tmp/queue.txt)" ] && break; done
  tail -n 15 /tmp/pytest.log | cut -c1-300; cp /tmp/pytest.log "$OUT" 2>/dev/null
  cat /tmp/results/*.jsonl > "$OUT/results.jsonl"; grep -l Traceback /tmp/logs/* | xargs -r tail -n 5
  python3 lab/table.py "$OUT/results.jsonl" ;;
3) # times alone: stock beside ours on GPU 0 (6 min on an H100), sundae-fast and the tests of the GPU on GPU 1
  echo quit | CUDA_MPS_PIPE_DIRECTORY=/tmp/mps nvidia-cuda-mps-control; sleep 2; alone
  (CUDA_VISIBLE_DEVICES=0 $T /tmp/scenes/bonsai --arms sundae splatfacto -o "$OUT/t0.jsonl") > "$OUT/g0.log" 2>&1 &
  (export CUDA_VISIBLE_DEVICES=1; $T /tmp/scenes/bonsai --arms sundae-fast -o "$OUT/t1.jsonl"; $T /tmp/scenes/garden --arms sundae-fast -o "$OUT/t1.jsonl"
   PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" \
     --ignore tests/evaluation/test_video.py --ignore tests/integration/test_report.py tests) > "$OUT/g1.log" 2>&1 &
  until [ $SECONDS -gt "${LIMIT:-540}" ]; do sleep 2; jobs -r | grep -q . || break; done
  grep -h Continuing -A2 "$OUT"/g?.log; tail -n 12 "$OUT"/g?.log | cut -c1-400; cat "$OUT"/t?.jsonl ;;
5) # start the tests of the GPU, beside the queue
  cp -r docs README.md method_configs web /tmp/; cd /tmp || exit
  (unset CUDA_MPS_PIPE_DIRECTORY; export CUDA_VISIBLE_DEVICES=1,0; setsid nohup env PYTHONSAFEPATH=1 python3 -m pytest -q -m gpu -p no:cacheprovider \
    -o "addopts=--strict-markers --import-mode=importlib --disable-plugin-autoload" \
    $(grep -rlE --include="*.py" "mark.gpu|pytestmark.*gpu" tests) > /tmp/pytest.log 2>&1 &) ;;
4) # whole runs for runs.csv: the lines SCENE ARM SEED of lab/whole-$2.txt, PER at a time, in the background
  export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps PYTHONPATH=/opt/site; cp -rn .gpu/scenes/* /tmp/scenes/; cd /tmp || exit
  nl -v 0 -b a "/tmp/lab/whole-$2.txt" | setsid nohup xargs -P "${PER:-4}" -L 1 bash -c 'export CUDA_VISIBLE_DEVICES=$(($0 % 2)); sundae bench suite \
    /tmp/scenes -o /tmp/suite --scenes "$1" --arms "$2" --seeds "$3" > /tmp/logs/suite-$1-$2-$3.log 2>&1; echo "$1 $2 $3 $? $SECONDS" >> /tmp/suite.done' > /dev/null 2>&1 & sleep 1 ;;
6) # their results, once they have ended; then benchmarks/tables.py --suite RESULTS.jsonl
  until [ $SECONDS -gt "${LIMIT:-500}" ]; do sleep 2; [ "$(cat /tmp/suite.done 2>/dev/null | wc -l)" -ge "$(cat /tmp/lab/whole-*.txt | wc -l)" ] && break; done
  cat /tmp/suite/done/*.json > "$OUT/results.jsonl"; cat /tmp/results/*.jsonl > "$OUT/queue.jsonl"
  python3 - <<'E'
import glob, json, os
with open(os.environ["OUT"] + "/trials.jsonl", "w") as out:
    for path in sorted(glob.glob("/tmp/suite/jobs/*/*/*/run/trials.json") + glob.glob("/tmp/full/*/sundae/*/trials.json")):
        out.write(json.dumps({"path": path, "trials": json.load(open(path))}) + "\n")
E
  cat /tmp/suite.done; ls /tmp/suite/done /tmp/results; cat /tmp/queue.log; grep -l Traceback /tmp/logs/* | xargs -r tail -n 5
  tail -n 12 /tmp/pytest.log | cut -c1-300; cp /tmp/pytest.log "$OUT" ;;
7) # frames and flicker of the new runs, then times alone: each GPU by itself
  echo quit | CUDA_MPS_PIPE_DIRECTORY=/tmp/mps nvidia-cuda-mps-control; sleep 2; alone; J=/tmp/suite/jobs
  run() { echo "$J/$1-$2-10pct-s42/$2/sundae/run"; }
  frame() { sundae bench frame --load-config "$(run "$1" "$2")" --precisions bf16 --json; }
  flick() { sundae bench flicker --load-config "$(run "$1" "$2")" --json; }
  full() { sundae bench frame --load-config "$J/$1-sundae-warm-up-s42/sundae-warm-up/sundae/run" --precisions fp32 --json; }
  (export CUDA_VISIBLE_DEVICES=0; frame bonsai sundae; full bonsai; flick bonsai sundae; flick garden sundae
   $T /tmp/scenes/bonsai --arms sundae -o "$OUT/t0.jsonl") > "$OUT/g0.log" 2>&1 &
  (export CUDA_VISIBLE_DEVICES=1; frame fox sundae-with-head; full fox; flick fox sundae-with-head; flick stone_horse sundae-with-head
   $T /tmp/scenes/bonsai --arms sundae-fast -o "$OUT/t1.jsonl"; $T /tmp/scenes/garden --arms sundae-fast -o "$OUT/t1.jsonl") > "$OUT/g1.log" 2>&1 &
  until [ $SECONDS -gt "${LIMIT:-540}" ]; do sleep 2; jobs -r | grep -q . || break; done
  tail -n 20 "$OUT"/g?.log | cut -c1-700; cat "$OUT"/t?.jsonl ;;
8) # frames again, each GPU by itself, three times
  echo quit | CUDA_MPS_PIPE_DIRECTORY=/tmp/mps nvidia-cuda-mps-control; sleep 5; alone; J=/tmp/suite/jobs
  for i in 1 2 3; do for r in fox-sundae-with-head-10pct-s42/sundae-with-head fox-sundae-warm-up-s42/sundae-warm-up; do
    [ "${r%up}" = "$r" ] && p=bf16 || p=fp32
    sundae bench frame --load-config "$J/$r/sundae/run" --precisions $p --repeats 9 --json 2>&1 | grep ms_frame; done; done ;;
esac
