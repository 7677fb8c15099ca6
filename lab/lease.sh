#!/usr/bin/env bash
# A lease of a GPU machine that starts bare: lease.sh setup | add PLAN | look | wait SECONDS. Each call carries .gpu/pN as well.
#   setup  carry .gpu/wheels .gpu/setup.sh .gpu/gsplat-1.4.0-*.so.xz (made by ../shared/gpu/pack.sh and lab/wheels.sh)
#   add    puts the captures of .gpu/p*/scenes in place and queues PLAN: lines "NAME | GPU or - | COMMAND", lowest name first
#   wait   waits for the queue, or so many seconds, and packs /tmp/out and the logs into $OUT
# GPUS and SLOTS (jobs a GPU) are of the first call. Two jobs on one GPU take as long as one after another, so SLOTS=1 also
# gives times; more only hide the start of a job. The machine is given back 30 s after a call: keep one in flight.
set -u
H=$PWD R=/tmp/repo J=/tmp/jobs
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=4 NUMBA_NUM_THREADS=4 PYTHONUNBUFFERED=1 PYTHONWARNINGS=ignore
export SLOTS=${SLOTS:-1} GPUS=${GPUS:-2} RESERVED= R
for c in .gpu/p*/scenes/*; do [ -d $c ] && mkdir -p /tmp/scenes && cp -r $c /tmp/scenes/; done
case $1 in
  setup)
    bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
    # Processes of one GPU run side by side by MPS, if the machine has it; else they take turns.
    export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mps; mkdir -p /tmp/mps
    P='import torch; [print(float(torch.ones(9, device=f"cuda:{i}").sum())) for i in range(torch.cuda.device_count())]'
    nvidia-cuda-mps-control -d && timeout 60 python3 -c "$P" && echo with MPS || { echo without MPS; tail /tmp/mps/*.log; echo quit | timeout 5 nvidia-cuda-mps-control; unset CUDA_MPS_PIPE_DIRECTORY CUDA_MPS_LOG_DIRECTORY; }
    mkdir -p $R $J /tmp/logs /tmp/out; cp -r benchmarks lab tests docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/
    cp lab/slots.py /tmp/; (cd benchmarks; python3 -c 'import harness.job, sundae_ns.method_configs') || exit 3
    touch /tmp/logs/queue.log
    cd /tmp; setsid nohup python3 slots.py > logs/q.out 2>&1 & ;;
  add)
    [ -f /tmp/logs/queue.log ] || { echo "no setup on this machine: give it back"; exit 3; }
    while IFS='|' read -r name gpu command; do
      name=$(echo $name) gpu=$(echo $gpu)
      [ -z "$name" ] || [ "${name:0:1}" = "#" ] && continue
      { [ "$gpu" = - ] || echo "# gpu $gpu"; echo "cd /tmp; $command"; } > $J/$name.new && mv $J/$name.new $J/$name.sh
    done < $H/$2
    ls $J | wc -l ;;
  look)
    tail -n 12 /tmp/logs/queue.log; tar -czf $OUT/out.tgz --exclude="*.ckpt" --exclude="*.tmp" --exclude="events.*" --exclude="*.sundae" --exclude="*.jpg" -C /tmp out logs ;;
  wait)
    touch $J/END; SECONDS=0
    until grep -q "all done" /tmp/logs/queue.log || [ $SECONDS -gt $2 ]; do sleep 1; done
    tar -czf $OUT/out.tgz --exclude='*.ckpt' --exclude='events.*' --exclude='*.sundae' --exclude='*.jpg' -C /tmp out logs; awk '/done/' /tmp/logs/queue.log | tail -n 40; grep -l Traceback /tmp/logs/*.log ;;
esac
