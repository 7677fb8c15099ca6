# small.sh SCRIPT CAPTURE NAME SEED: 2,400 steps at a quarter of the size (images_4) on a CPU, results in NAME.SEED.json
s=$1 c=$2 name=$3 seed=${4:-42}; H=$(dirname $0); o=/tmp/small/$name-$seed; export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
[ "$s" = ns-train ] && run=ns-train || run="python3 $H/$s"
$run sundae-tiny --data $c --output-dir $o --experiment-name x --timestamp run --vis tensorboard --max-num-iterations 2400 --machine.seed $seed $WORDS --viewer.quit-on-train-completion True --pipeline.model.head.mode off --pipeline.model.evaluate-prune False --pipeline.model.densify-grad-thresh 0.0008 --pipeline.model.pruning.keep-ratio 0.25 colmap --colmap-path sparse/0 --downscale-factor 4 --eval-mode interval --eval-interval 8
sundae eval $o/x/sundae-tiny/run -o $name.$seed.json
