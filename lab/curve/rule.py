import json, numpy as np, itertools
from pathlib import Path
D = Path(__file__).parent / "data"
S = np.array([1, .4, .2, .1, .05, .025])
real = {}
for r in json.load(open(D / "oracle.json")):
    if r["seed"] == 42 and r["share"]: real.setdefault(r["capture"], {})[r["share"]] = (r["psnr"], r["ssim"], bool(r["bytes_head"]))
def choice(d, w, tol, k_se, drop=()):
    M = np.array(d["measured"])  # T W V 3
    keep = [i for i in range(M.shape[2]) if i not in drop]; M = M[:, :, keep]
    ex, loss = [], []
    for i, (a, b) in zip((1, 2), w):
        e = a * M[:, -1, :, i] + b * (M[:, -1, :, i] - M[:, 0, :, i]) / np.log(2)
        best = e.mean(1).argmax(); dif = e[best] - e
        m, s = dif.mean(1), dif.std(1, ddof=1) / np.sqrt(dif.shape[1])
        loss.append((m, s)); ex.append((m - k_se * s) / tol[i - 1])
    ex = np.maximum(*ex)
    good = np.flatnonzero(ex <= 1)
    if not len(good): return S[ex.argmin()], loss
    g = good[-1]
    if g + 1 == len(S): return S[g], loss
    t = (1 - ex[g]) / (ex[g + 1] - ex[g]); return float(np.exp(np.log(S[g]) + t * np.log(S[g + 1] / S[g]))), loss
if __name__ == "__main__":
    for w in (((.8, 1.5), (.85, 2.)), ((.8, .1), (.8, .8)), ((.8, .5), (.85, 1.2)), ((.8, .8), (.85, .8)), ((.8, 0.), (.8, 0.))):
        for k in (0, .5, 1):
            print(w, "se", k, {json.load(open(f))["scene"][:6]: "%.3f" % choice(json.load(open(f)), w, (.1, .003), k, (8,) if "south" in f.name else ())[0] for f in sorted(D.glob("whole-*"))})
    for c in sorted(real): print(c, {s: "%.2f %.4f%s" % (v[0], v[1], "h" if v[2] else "") for s, v in real[c].items()})
