"""python lab/queue.py LIST PER_GPU: run the lines "NAME CAPTURE JSON" of LIST (appended to at any time) as processes on all GPUs."""
import os, subprocess, sys, time, pathlib
import torch
gpus, per = torch.cuda.device_count(), int(sys.argv[2])
os.makedirs("/tmp/results", exist_ok=True); os.makedirs("/tmp/logs", exist_ok=True)
done, running = set(), []
slot = [0] * gpus
while True:
    lines = [l.strip() for l in open(sys.argv[1]) if l.strip() and not l.startswith("#")]
    running2 = []
    for p, g, line in running:
        if p.poll() is None: running2.append((p, g, line))
        else:
            slot[g] -= 1
            print(time.strftime("%X"), "end", p.returncode, line, flush=True)
    running = running2
    stop = os.path.exists("/tmp/stop_queue")
    for line in lines:
        if line in done or stop: continue
        name, capture, spec = line.split(" ", 2)
        if not os.path.exists(f"/tmp/warm/{capture}/done"): continue
        g = min(range(gpus), key=lambda i: slot[i])
        if slot[g] >= per: break
        slot[g] += 1; done.add(line)
        env = dict(os.environ, CUDA_VISIBLE_DEVICES=str(g), OMP_NUM_THREADS="2")
        log = open(f"/tmp/logs/{name}-{capture}.log", "w")
        running.append((subprocess.Popen([sys.executable, "lab/train.py", name, capture, "/tmp/results", spec], stdout=log, stderr=subprocess.STDOUT, env=env, start_new_session=True), g, line))
        time.sleep(1)
    time.sleep(2)
