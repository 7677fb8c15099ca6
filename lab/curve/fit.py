"""Weights of the trials' end and of log2(count), from fixed shares without a head; the choice by them, one capture left out."""
import json, csv, itertools, sys
import numpy as np
from pathlib import Path
D = Path(__file__).parent / "data"; S = [1.0, .4, .2, .1, .05, .025]
plain = {}
for r in json.load(open(D / "oracle.json")):
    if r["seed"] == 42 and r["share"] and not r["bytes_head"]: plain.setdefault(r["capture"], {})[r["share"]] = (r["psnr"], r["ssim"])
for r in csv.DictReader(open(D.parents[2] / "benchmarks/results/runs.csv")):
    if r["variant"] == "sundae-no-head" and r["seed"] == "42": plain.setdefault(r["scene"], {}).setdefault(float(r["keep_ratio"]), (float(r["psnr"]), float(r["ssim"])))
rec = {json.load(open(f))["scene"]: np.array(json.load(open(f))["measured"]) for f in sorted(D.glob("whole-*-42.json"))}
caps = sorted(rec)
def val(c, s, k, w=-1):
    M = rec[c]; px = M[0, 0, :, 0] / M[0, 0, :, 0].sum(); return float(M[S.index(s), w, :, k] @ px)
for name, k, j in (("psnr", 3, 0), ("ssim", 2, 1)):
    X, y, who = [], [], []
    for c in caps:
        have = [s for s in S if s in plain[c]]
        for a, b in zip(have, have[1:]):
            X.append([val(c, a, k) - val(c, b, k), np.log2(a / b), (val(c, a, k) - val(c, a, k, 0)) - (val(c, b, k) - val(c, b, k, 0))]); y.append(plain[c][a][j] - plain[c][b][j]); who.append(c)
    X, y, who = np.array(X), np.array(y), np.array(who)
    for cols in ([0], [0, 1], [0, 2], [0, 1, 2]):
        err = []
        for c in caps:
            t = who != c; w = np.linalg.lstsq(X[t][:, cols], y[t], rcond=None)[0]; err += list(X[~t][:, cols] @ w - y[~t])
        print(name, cols, np.round(np.linalg.lstsq(X[:, cols], y, rcond=None)[0], 4), "LOO rmse %.4f" % np.sqrt(np.mean(np.square(err))), "std %.4f n %d" % (y.std(), len(y)))
def choice(c, wp, ws, tol=(.1, .003), se=1.0):
    M = rec[c]; px = M[0, 0, :, 0] / M[0, 0, :, 0].sum(); ex = []
    for k, (a, b), t in ((3, wp, tol[0]), (2, ws, tol[1])):
        e = a * M[:, -1, :, k] - b * np.log2(np.array(S))[:, None]
        best = (e @ px).argmax(); d = e[best] - e; m = d @ px; V = len(px); s = np.sqrt(((px**2) * (d - m[:, None])**2).sum(1) * V / (V - 1)); ex.append((m - se * s) / t)
    x = np.maximum(*ex); good = np.flatnonzero(x <= 1)
    if not len(good): return S[int(x.argmin())], x
    g = good[-1]
    if g + 1 == len(S): return S[g], x
    t = (1 - x[g]) / (x[g + 1] - x[g]); return float(np.exp(np.log(S[g]) + t * np.log(S[g + 1] / S[g]))), x
for wp, ws in (((.85, .15), (.7, .003)), ((.75, 0), (.65, 0)), ((.85, .2), (.7, .004)), ((.9, .2), (.75, .005)), ((1, .2), (.8, .005))):
    for se in (0, .5, 1):
        print(wp, ws, "se", se, {c[:6]: "%.3f" % choice(c, wp, ws, se=se)[0] for c in caps})
for c in caps: print(c, {s: "%.2f %.4f" % v for s, v in sorted(plain[c].items())}, np.round(choice(c, (.85, .15), (.7, .003))[1], 1))
