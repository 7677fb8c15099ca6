#!/usr/bin/env bash
# All that a lease needs, once in a session, after `make install`: two minutes.
#   bash lab/prepare.sh
# Then three calls, kind nvidia-h200-x2, and look calls of 110 s in one block; no pause may be longer than 30 s:
#   GPUS=2 SLOTS=4 bash lab/lease.sh setup && for p in tests first; do bash lab/lease.sh add lab/$p.plan; done
#       carry .gpu/wheels .gpu/setup.sh .gpu/gsplat-1.4.0-cp312-torch2.11-cu130-sm90.so.xz .gpu/p5
#   bash lab/lease.sh look                        carry .gpu/p2
#   for p in mcmc curves; do bash lab/lease.sh add lab/$p.plan; done        carry .gpu/p1
set -eu
S=../shared/scenes
bash ../shared/gpu/pack.sh fox
bash lab/wheels.sh
rm -rf .gpu/gsplat-1.5.3* .gpu/scenes
for p in "p5 fox courtyard" "p1 bonsai dinosaur" "p2 stone_horse garden south_building"; do
  set -- $p; mkdir -p .gpu/$1/scenes; for c in ${@:2}; do cp -r $S/$c .gpu/$1/scenes/; done
done
du -sm .gpu/*
