"""Run jobs from /tmp/jobs/NNN-name.sh on GPUs with 4 slots each, lowest name first; those whose `# after X` has not ended wait. Ends at /tmp/jobs/END once all are done."""
import os, subprocess, time
from pathlib import Path
J = Path("/tmp/jobs"); J.mkdir(exist_ok=True); Path("/tmp/logs").mkdir(exist_ok=True); slots = [(g, s) for s in range(int(os.environ.get("SLOTS", 4))) for g in range(int(os.environ.get("GPUS", 2)))]
running, done, log = {}, set(), open("/tmp/logs/queue.log", "a", buffering=1)
T = time.time()
while True:
    for slot in list(running):
        proc, name, began = running[slot]
        if proc.poll() is not None:
            log.write(f"{time.time()-T:.0f} done {name} rc {proc.returncode} {time.time()-began:.0f} s gpu {slot[0]}\n"); done.add(name); del running[slot]
    taken = any(n.startswith('00-alone') for _, n, _ in running.values()) or not done and not running
    busy = {n for _, n, _ in running.values()}
    for path in sorted(J.glob("*.sh")):
        if path.name in done or path.name in busy: continue
        text = path.read_text(); need = [l.split()[2] for l in text.splitlines() if l.startswith("# after ")]
        if any(not any(d.endswith(n + ".sh") for d in done) for n in need): continue
        only = [int(l.split()[2]) for l in text.splitlines() if l.startswith("# gpu ")]
        free = [s for s in slots if s not in running and (s[0] in only if only else not (taken and s[0] == 3))]
        if not free: continue
        load = {g: sum(1 for s in running if s[0] == g) for g in range(int(os.environ.get("GPUS", 2)))}
        slot = min(free, key=lambda s: load[s[0]])
        env = dict(os.environ, CUDA_VISIBLE_DEVICES=str(slot[0]))
        out = open(f"/tmp/logs/{path.stem}.log", "w")
        running[slot] = (subprocess.Popen(["bash", str(path)], env=env, stdout=out, stderr=subprocess.STDOUT, cwd="/tmp"), path.name, time.time())
        busy.add(path.name); log.write(f"{time.time()-T:.0f} start {path.name} gpu {slot[0]}\n")
    names = {p.name for p in J.glob("*.sh")}
    if (J / "END").exists() and not running and names <= done:
        log.write(f"{time.time()-T:.0f} all done\n"); break
    time.sleep(0.5)
