set -u
export PYTHONPATH=/opt/site PATH=/opt/site/bin:$PATH OMP_NUM_THREADS=8 NUMBA_NUM_THREADS=8 ROOT=$PWD
R=/tmp/repo; O=/tmp/out
south() { python3 $R/benchmarks/quality.py /tmp/scenes/south_building -o /tmp/full/$1 --arms sundae-no-head --keep-ratios 1 --seeds $1; RUN=$(dirname $(find /tmp/full/$1/jobs -name config.yml | grep no-head | head -1)); python3 $R/lab/floaters.py $RUN $O/floaters-$1; }
case $1 in
1) bash .gpu/setup.sh > /tmp/setup.log 2>&1; tail -n 1 /tmp/setup.log; python3 lab/console_scripts.py
  mkdir -p $R /tmp/logs $O /tmp/scenes; cp -r benchmarks tests lab docs examples web *.md pyproject.toml Makefile mkdocs.yml method_configs $R/; cp -r .gpu/g/* /tmp/scenes/; cd /tmp
  CUDA_VISIBLE_DEVICES=2 setsid nohup python3 $R/benchmarks/bench_training.py /tmp/scenes/garden --arms sundae --profile -o $O/profile.jsonl > /tmp/logs/profile.log 2>&1 & ;;
2) cp -r .gpu/s/* /tmp/scenes/; cd /tmp
  for s in 42 44; do CUDA_VISIBLE_DEVICES=$([ $s = 42 ] && echo 0 || echo 3) setsid nohup bash -c "$(declare -f south); R=$R; O=$O; south $s" > /tmp/logs/south-$s.log 2>&1 & done; sleep 0.5 ;;
3) mkdir -p /tmp/dawn; cp -r .dawn/* /tmp/dawn/; (bash /tmp/dawn/run.sh split48k $O/dawn-split48k.jsonl; bash /tmp/dawn/run.sh demo $O/dawn-demo.jsonl) > /tmp/logs/dawn.log 2>&1
  tail -c 1500 /tmp/logs/dawn.log
  until ! pgrep -f "bench_training|floaters.py|quality.py" > /dev/null || [ $SECONDS -gt $2 ]; do sleep 1; done
  tail -n 60 /tmp/logs/south-42.log; tail -n 5 /tmp/logs/profile.log | cut -c1-3000; tar -czf "$OUT/out.tgz" -C /tmp out logs ;;
esac
