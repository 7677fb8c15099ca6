#!/usr/bin/env bash
# The experiments of one lease: bash lab/lease1.sh 1 sets up and starts the queue, bash lab/lease1.sh 2 LIST waits for LIST.
set -u
case $1 in
1) bash .gpu/setup.sh; export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH
   nvidia-smi --query-gpu=name --format=csv,noheader
   mkdir -p /tmp/scenes /tmp/results; cp -r .gpu/scenes/* /tmp/scenes/; cp -r lab benchmarks /tmp/
   export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps
   mkdir -p /tmp/mps && nvidia-cuda-mps-control -d
   cp lab/queue.txt /tmp/queue.txt; cd /tmp; setsid nohup python3 /tmp/lab/run_queue.py /tmp/queue.txt "${PER:-3}" /tmp/lab/full.py > /tmp/queue.log 2>&1 & sleep 1 ;;
2) cp -rn .gpu/scenes/* /tmp/scenes/ 2>/dev/null; [ -n "${MORE:-}" ] && cat "$MORE" >> /tmp/queue.txt
   until [ $SECONDS -gt "${LIMIT:-500}" ]; do sleep 2
     [ "$(grep -c ' end ' /tmp/queue.log)" -ge "$(grep -vc '^#' /tmp/queue.txt)" ] && break; done
   cat /tmp/queue.log; cat /tmp/results/*.jsonl > "$OUT/results.jsonl"; grep -l Traceback /tmp/logs/* | xargs -r tail -n 5
   python3 lab/table.py "$OUT/results.jsonl" ;;
esac
