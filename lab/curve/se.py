import json, numpy as np
from pathlib import Path
D = Path(__file__).parent / "data"
A = {1: (0.8, 1.5), 2: (0.85, 2.0)}
for f in sorted(D.glob("record-*.json")):
    d = json.load(open(f)); S = d["shares"]
    for L in (2,):
        out = []
        P = {}
        for k in (1, 2):
            P[k] = np.array([[A[k][0] * w[L - 1][v][k] + A[k][1] * (w[L - 1][v][k] - w[L // 2 - 1][v][k]) / np.log(2) for v in range(len(d["held"]))] for w in d["measured"]])
        for k in (1, 2):
            b = P[k].mean(1).argmax()
            diff = P[k] - P[k][b]
            print(d["scene"], "psnr" if k == 1 else "ssim", [f"{s:g}: {m:+.3f}±{e:.3f}" if k == 1 else f"{s:g}: {m:+.4f}±{e:.4f}" for s, m, e in zip(S, diff.mean(1), diff.std(1, ddof=1) / np.sqrt(diff.shape[1]))])
