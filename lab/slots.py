"""Run jobs from /tmp/jobs/NNN-name.sh on GPUs with SLOTS slots each, lowest name first; those whose `# after X` has not
ended wait, those with `# gpu N` take that GPU. 00-alone-* have their GPU to themselves, and GPUs in RESERVED wait for one.
Ends at /tmp/jobs/END once all are done."""
import os, subprocess, time
from pathlib import Path

J, L = Path("/tmp/jobs"), Path("/tmp/logs")
J.mkdir(exist_ok=True), L.mkdir(exist_ok=True)
GPUS = int(os.environ.get("GPUS", 2))
slots = [(g, s) for s in range(int(os.environ.get("SLOTS", 4))) for g in range(GPUS)]
running, done, log, T = {}, set(), open(L / "queue.log", "a", buffering=1), time.time()
waiting = {int(g) for g in os.environ.get("RESERVED", "").split()}
while True:
    for slot in list(running):
        proc, name, began = running[slot]
        if proc.poll() is not None:
            log.write(f"{time.time()-T:.0f} done {name} rc {proc.returncode} {time.time()-began:.0f} s gpu {slot[0]}\n")
            done.add(name)
            del running[slot]
    busy = {n for _, n, _ in running.values()}
    for path in sorted(J.glob("*.sh")):
        if path.name in done or path.name in busy: continue
        text, is_alone = path.read_text().splitlines(), path.name.startswith("00-alone")
        need = [l.split()[2] for l in text if l.startswith("# after ")]
        if any(not any(d.endswith(n + ".sh") for d in done) for n in need): continue
        only = [int(l.split()[2]) for l in text if l.startswith("# gpu ")] or range(GPUS)
        load = {g: sum(1 for s in running if s[0] == g) for g in range(GPUS)}
        closed = {s[0] for s, (_, n, _) in running.items() if n.startswith("00-alone")} | (set() if is_alone else waiting)
        free = [s for s in slots if s not in running and s[0] in only and s[0] not in closed and not (is_alone and load[s[0]])]
        if not free: continue
        slot = min(free, key=lambda s: load[s[0]])
        if is_alone: waiting.discard(slot[0])
        out = open(L / f"{path.stem}.log", "w")
        env = dict(os.environ, CUDA_VISIBLE_DEVICES=str(slot[0]))
        running[slot] = (subprocess.Popen(["bash", str(path)], env=env, stdout=out, stderr=subprocess.STDOUT, cwd="/tmp"), path.name, time.time())
        busy.add(path.name)
        log.write(f"{time.time()-T:.0f} start {path.name} gpu {slot[0]}\n")
    names = {p.name for p in J.glob("*.sh")}
    if (J / "END").exists() and not running and names <= done:
        log.write(f"{time.time()-T:.0f} all done\n")
        break
    time.sleep(0.5)
