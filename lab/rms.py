"""Print the size of the gains' response while nothing is divided, in a training of ns-train's words; ends at STOP (environment)."""
import os, sys, numpy as np
from sundae_ns.training import photo_gains as pg
STOP, EVERY = int(os.environ.get("STOP", 10**9)), int(os.environ.get("EVERY", pg.REFRESHED_EVERY))
pg.REFRESHED_EVERY = EVERY
name = os.environ["NAME"]
def update(self, sums):
    products, squares = sums[:, 0], sums[:, 1]
    seen = np.isfinite(sums).all(axis=(1, 2)) & (products > 0).all(axis=1) & (squares > 0).all(axis=1)
    ratio = np.log(products[seen] / squares[seen]).clip(-np.log(pg.MOST), np.log(pg.MOST))
    weight = np.maximum(1 / (self._counts[seen] + 1), pg.NEWEST_WEIGHT)[:, None]
    self._measured[seen] += weight * (ratio - self._measured[seen]); self._counts[seen] += 1
    rows, known = self._rows, self._counts[self._rows] > 0
    r = (self._measured[rows] - self._smoother(self._measured[rows], known))[known]
    print(f"RMS {name} step {self._state.step} photos {len(rows)} known {known.sum()} counts {self._counts[rows].mean():.1f} rms {np.sqrt(np.square(r).mean()):.4f} exposure {np.sqrt(np.square(r.mean(1)).mean()):.4f} median {np.median(np.abs(r.mean(1))):.4f} med3 {np.median(np.sqrt(np.square(r).mean(1))):.4f} max {np.abs(r.mean(1)).max():.3f}", file=sys.stderr, flush=True)
    if self._state.step >= STOP: os._exit(0)
pg.PhotoGains._update = update
from nerfstudio.scripts.train import entrypoint
entrypoint()
