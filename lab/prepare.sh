#!/usr/bin/env bash
# All that a lease needs, once in a session, after `make install`: 15 to 25 minutes, most of them for the cuts.
#   bash lab/prepare.sh
# Then three calls, kind nvidia-h200-x2, and look calls of 110 s in one block; no pause may be longer than 30 s:
#   GPUS=2 SLOTS=4 bash lab/lease.sh setup && bash lab/lease.sh add lab/tests.plan
#       carry .gpu/wheels .gpu/setup.sh .gpu/gsplat-1.4.0-cp312-torch2.11-cu130-sm90.so.xz .gpu/p5
#   bash lab/lease.sh add lab/curves.plan         carry .gpu/p1
#   for p in record expose few_seeds; do bash lab/lease.sh add lab/$p.plan; done        carry .gpu/p2 .gpu/cuts
set -eu
S=../shared/scenes
bash ../shared/gpu/pack.sh fox
bash lab/wheels.sh
rm -rf .gpu/gsplat-1.5.3* .gpu/scenes .gpu/cuts
for p in "p5 fox courtyard" "p1 bonsai dinosaur" "p2 stone_horse garden south_building"; do
  set -- $p; mkdir -p .gpu/$1/scenes; for c in ${@:2}; do cp -r $S/$c .gpu/$1/scenes/; done
done
mkdir -p /tmp/cuts .gpu/cuts
cut_of() { (cd benchmarks && ../.venv/bin/python -W ignore -c 'import sys; from pathlib import Path; from few_views import cut; cut(Path(sys.argv[1]).resolve(), int(sys.argv[2]), Path(sys.argv[3]))' ../$S/$1 $2 /tmp/cuts/$1-$2); }
# The cuts of plans, two at a time: NAME-VIEWS as they stand in commands
for c in $(cat lab/expose.plan lab/few_seeds.plan | grep -oE "/tmp/scenes/[a-z_]+-[0-9]+" | sort -u | sed 's|/tmp/scenes/||'); do echo ${c%-*} ${c##*-}; done |
  xargs -P 2 -L 1 bash -c "$(declare -f cut_of); S=$S; [ -d /tmp/cuts/\$0-\$1 ] || cut_of \$0 \$1"
for c in /tmp/cuts/*-*; do n=$(basename $c); .venv/bin/python lab/uncut.py pack $c $S/${n%-*} .gpu/cuts/$n; done
du -sm .gpu/*
