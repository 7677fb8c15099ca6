"""python lab/run_queue.py LIST PER_GPU [SCRIPT]: run the lines "NAME CAPTURE JSON" of LIST (appended to at any time) as processes
on all GPUs. A line with "warm" waits for that checkpoint; SCRIPT is lab/full.py (lab/train.py for finishes from /tmp/warm)."""
import json, os, pathlib, subprocess, sys, time
import torch
gpus, per = max(torch.cuda.device_count(), 1), int(sys.argv[2])
script = sys.argv[3] if len(sys.argv) > 3 else "lab/full.py"
place = os.environ.get("LAB", "/tmp")
os.makedirs("/tmp/results", exist_ok=True); os.makedirs("/tmp/logs", exist_ok=True)
done, running = set(), []
slot = [0] * gpus
def ready(capture, spec):
    if script.endswith("train.py"): return os.path.exists(f"/tmp/warm/{capture}/done")
    warm = json.loads(spec).get("warm")
    return warm is None or any(pathlib.Path(f"{place}/full/{warm}/sundae/{capture}/nerfstudio_models").glob("*.ckpt"))
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
    if not running and (stop or (os.environ.get("ONCE") and done.issuperset(lines))): break
    for line in lines:
        if line in done or stop: continue
        name, capture, spec = line.split(" ", 2)
        if not ready(capture, spec): continue
        g = min(range(gpus), key=lambda i: slot[i])
        if slot[g] >= per: break
        slot[g] += 1; done.add(line)
        env = dict(os.environ, CUDA_VISIBLE_DEVICES=str(g), OMP_NUM_THREADS="2")
        log = open(f"/tmp/logs/{name}-{capture}.log", "w")
        running.append((subprocess.Popen([sys.executable, script, name, capture, "/tmp/results", spec], stdout=log, stderr=subprocess.STDOUT, env=env, start_new_session=True), g, line))
        time.sleep(1)
    time.sleep(1)
