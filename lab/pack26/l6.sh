# Six fine-tunes side by side on one GPU; about 135 s after setup.sh. Prints one JSON line each; lines and files also in $OUT.
# Before:  bash .gpu/setup.sh   and the captures:  mkdir -p /tmp/scenes; cp -r .gpu/scenes/bonsai .gpu/scenes2/fox /tmp/scenes/
here=$PWD/.gpu/p26; runs=$PWD/.gpu/runs; out=/tmp/p26; mkdir -p $out $OUT; cd $here/packrepo
python3 -m pip install -q --no-build-isolation --no-index --no-deps --target /opt/p26site $here/packrepo 2>&1 | grep -v WARNING
export PYTHONPATH=/opt/p26site:/opt/site PYTHONSAFEPATH=1 P26_SENS=$here P26_LIMIT=${LIMIT:-80} OMP_NUM_THREADS=2
one() { tag=$1 name=$2 steps=$3 rate=$4; shift 4
  timeout 145 python3 benchmarks/bench_pack.py --run "$runs/$name" --views 999 --repeats 3 --finetune "$steps" --rate "$rate" --set "$@" --keep "$out/$tag.sundae" > "$out/$tag.json" 2> "$out/$tag.log" || tail -3 "$out/$tag.log"
  grep -h "NOT RECORDED" $out/$tag.json | cut -c1-300; grep '^{' $out/$tag.json | sed "s/^{/{\"tag\": \"$tag\", /" | tee -a $OUT/p26.jsonl | cut -c1-900; cp $out/$tag.sundae $out/$tag.log $OUT/ 2>/dev/null; }
one a1500 bonsai 1500 0.025 &
one b4000 bonsai 4000 0.025 &
(export P26_LR=2; one c4000lr2 bonsai 4000 0.025) &
one d4000coarse bonsai 4000 0.025 feature_step=0.25 head_step=0.18 scale_step=0.12 rotation_step=0.021 harmonics_step=0.07 &
(export P26_RISE=1; one e4000rise bonsai 4000 0.05) &
one f3000fox fox 3000 0.02 &
wait
