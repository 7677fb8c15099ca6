import json, glob, itertools, sys
import numpy as np
from pathlib import Path
D = Path(__file__).parent / "data"
rows = [r for r in json.load(open(D / "oracle.json")) if r["seed"] == 42 and r["share"]]
real = {}
for r in rows: real.setdefault(r["capture"], {})[r["share"]] = r
rec = {json.load(open(f))["scene"]: dict(json.load(open(f)), shares=[1.0, .4, .2, .1, .05, .025]) for f in D.glob("whole-*-42.json")}
mean = lambda w, k: sum(v[k] for v in w) / len(w)
caps = sorted(real)
S = [1.0, .4, .2, .1, .05, .025]
def feats(c, s, k, L):   # value at window L, log slope
    t = rec[c]["measured"][rec[c]["shares"].index(s)]
    q = [mean(w, k) for w in t]
    hi, lo = L, max(L // 2, 1)
    return q[hi - 1], (q[hi - 1] - q[lo - 1]) / np.log(hi / lo)
def truth(c, s, key):
    r = real[c].get(s)
    return None if r is None else r[key]
for L in (2,):
    for key, k in (("psnr", 3), ("ssim", 2)):
        X, y, who = [], [], []
        for c in caps:
            have = [s for s in S if truth(c, s, key) is not None]
            for a, b in zip(have, have[1:]):
                # skip pairs in which the head differs
                if bool(real[c][a]["bytes_head"]) != bool(real[c][b]["bytes_head"]): continue
                fa, fb = feats(c, a, k, L), feats(c, b, k, L)
                o = np.log2(a / b)
                X.append([fa[0] - fb[0], fa[1] - fb[1], o]); y.append(truth(c, a, key) - truth(c, b, key)); who.append((c, a, b))
        X, y = np.array(X), np.array(y)
        for cols in ([0], [0, 1], [0, 1, 2], [0, 2]):
            err = []
            for c in caps:
                tr = np.array([w[0] != c for w in who]); te = ~tr
                if te.sum() == 0: continue
                w = np.linalg.lstsq(X[tr][:, cols], y[tr], rcond=None)[0]
                err += list(X[te][:, cols] @ w - y[te])
            w = np.linalg.lstsq(X[:, cols], y, rcond=None)[0]
            print(L, key, cols, "w", np.round(w, 3), "LOO rmse %.4f" % np.sqrt(np.mean(np.square(err))), "std y %.4f" % y.std(), len(y))
print("affine-fitted PSNR as the predictor of PSNR")
for L in (2,):
    for k in (3,):
        X, y, who = [], [], []
        for c in caps:
            have = [s for s in S if truth(c, s, "psnr") is not None]
            for a, b in zip(have, have[1:]):
                if bool(real[c][a]["bytes_head"]) != bool(real[c][b]["bytes_head"]): continue
                fa, fb = feats(c, a, k, L), feats(c, b, k, L)
                X.append([fa[0] - fb[0], fa[1] - fb[1]]); y.append(truth(c, a, "psnr") - truth(c, b, "psnr")); who.append((c, a, b))
        X, y = np.array(X), np.array(y)
        err = []
        for c in caps:
            tr = np.array([w[0] != c for w in who])
            if (~tr).sum(): err += list(X[~tr] @ np.linalg.lstsq(X[tr], y[tr], rcond=None)[0] - y[~tr])
        print(L, k, "LOO rmse %.3f" % np.sqrt(np.mean(np.square(err))))
w = {"psnr": (0.8, 1.5), "ssim": (0.85, 2.0)}
for L in (2,):
  for c in caps:
    P = {s: [w[key][0] * feats(c, s, k, L)[0] + w[key][1] * feats(c, s, k, L)[1] for key, k in (("psnr", 3), ("ssim", 2))] for s in S}
    bp, bs = max(v[0] for v in P.values()), max(v[1] for v in P.values())
    ok = [s for s in S if P[s][0] >= bp - .1 and P[s][1] >= bs - .003]
    print(L, c, "chosen", ok, {s: "%.2f %.4f" % (v[0] - bp, v[1] - bs) for s, v in P.items()})
    if L == 2:
        T = {s: (real[c][s]["psnr"], real[c][s]["ssim"]) for s in S if s in real[c]}; bp, bs = max(v[0] for v in T.values()), max(v[1] for v in T.values())
        print("      truth", {s: "%.2f %.4f%s" % (v[0] - bp, v[1] - bs, "h" if real[c][s]["bytes_head"] else "") for s, v in T.items()})
