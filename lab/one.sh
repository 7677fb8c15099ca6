# one.sh SCRIPT CAPTURE NAME SEED: train at full size with ns-train, or lab/SCRIPT in its place, evaluate (the environment has the options)
s=$1 c=$2 name=$3 seed=$4; H=$(dirname $0)
d=/tmp/scenes/$c; o=/tmp/runs/$name-$seed
case $c in *) words="colmap --colmap-path sparse/0 --downscale-factor 1 --downscale-rounding-mode round --eval-mode interval --eval-interval 8";; esac
[ "$s" = ns-train ] && run=ns-train || run="python3 $H/$s"; $run sundae --data $d --output-dir $o --experiment-name $c --timestamp run --vis tensorboard --machine.seed $seed --viewer.quit-on-train-completion True --pipeline.model.evaluate-prune False $WORDS $words || exit 1
mkdir -p /tmp/out; sundae eval $o/$c/sundae/run -o /tmp/out/$c.$name.$seed.json && rm -rf $o/$c
