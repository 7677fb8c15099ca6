"""JOD of films of a packed scene, head on and off, beside films of its full field.

    python lab/films.py SMALL.sundae FULL.sundae CAPTURE/sparse/0 OUT.jsonl [PLACES [SCALE]]

`film` is JOD of the whole film, in which flicker counts; `still` is the mean JOD of its frames, each by itself.
"""
import json, sys
from pathlib import Path
import torch
import pycvvdp
import sundae_ns as sn
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from flicker import between, neighbours  # noqa: E402
FRAMES, FPS, BETWEEN = 20, 30, 30  # two thirds of a second, at a speed of one second from a camera to its neighbour
small, full = sn.load(sys.argv[1]), sn.load(sys.argv[2])
cameras, out = sys.argv[3], Path(sys.argv[4])
places, scale = int((sys.argv[5:] + ["3"])[0]), float((sys.argv[6:] + ["1"])[0])
views, others = sn.views_of(cameras, small), sn.views_of(cameras, full)
metric = pycvvdp.cvvdp(display_name="standard_4k", device=torch.device("cpu"), quiet=True)

def moved(views, pair, share):
    """The view a share of the way from one camera to the other."""
    a, b = (torch.linalg.inv(views[i].viewmat.double())[:3] for i in pair)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = between(a, b, share)
    view = views[pair[0]]
    K, w, h = view.K.clone(), round(view.width * scale), round(view.height * scale)
    K[:2] *= scale
    return view._replace(viewmat=torch.linalg.inv(pose).to(view.viewmat), K=K, width=w, height=h)

poses = torch.stack([torch.linalg.inv(v.viewmat.double())[:3] for v in views])
poses[:, :, 1:3] *= -1  # neighbours() compares axes of OpenGL; only their directions matter
for number, pair in enumerate(neighbours(poses, places)):
    films = {"on": [], "off": [], "full": []}
    for k in range(FRAMES):
        view = moved(views, pair, k / BETWEEN)
        films["on"].append(sn.render(small, view).rgb.clamp(0, 1).clone())
        films["off"].append(sn.render(small, view, head=False).rgb.clamp(0, 1).clone())
        films["full"].append(sn.render(full, moved(others, pair, k / BETWEEN)).rgb.clamp(0, 1).clone())
    films = {name: torch.stack(frames) for name, frames in films.items()}
    row = {"small": Path(sys.argv[1]).name, "full": Path(sys.argv[2]).name, "place": number, "pair": pair, "size": list(films["on"].shape[1:3])}
    for name in ("on", "off"):
        row[f"film_{name}"] = float(metric.predict(films[name], films["full"], dim_order="FHWC", frames_per_second=FPS)[0])
        row[f"still_{name}"] = sum(float(metric.predict(a, b, dim_order="HWC")[0]) for a, b in zip(films[name], films["full"])) / FRAMES
        row[f"psnr_{name}"] = float(-10 * (films[name] - films["full"]).square().mean().log10())
    with out.open("a") as file:
        file.write(json.dumps(row) + "\n")
    print(json.dumps(row), flush=True)
