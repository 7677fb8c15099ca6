#!/usr/bin/env bash
# The mutants of each room in a process of its own, on the CPU of a GPU machine: mutants.sh, from the repository's root.
rm -rf /tmp/mut; cp -r . /tmp/mut; cd /tmp/mut
for room in ${@:-pruning schedules surgery packing}; do
  CUDA_VISIBLE_DEVICES= PYTHONPATH=/tmp/mut:/opt/site PYTHONSAFEPATH=1 setsid nohup python3 benchmarks/mutants.py --rooms $room --sample 50 > /tmp/out/mutants-$room.json 2> /tmp/logs/mutants-$room.log &
done
