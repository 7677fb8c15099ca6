"""What spoils single test views of a full field: python lab/floaters.py RUN OUT"""
import json, sys, torch, dataclasses
from pathlib import Path
import sundae_ns as sn
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.rendering.views import view_of
from sundae_ns.rendering import LocalField
from sundae_ns.rasterization import blending_weights
from sundae_ns.rendering.render import pass_options
from sundae_ns.scenes.opening import open_scene
from torchvision.utils import save_image

run, out = Path(sys.argv[1]), Path(sys.argv[2]); out.mkdir(exist_ok=True, parents=True)
opened = open_scene(run); device = opened.model.device
scene = sn.load(run, device=device)
views = [view_of(c, device) for c in opened.cameras]
data = opened.datamanager
train = [view_of(data.train_dataset.cameras[i:i+1].to(device), device) for i in range(len(data.train_dataset))]
settings = scene.settings(head=False)
field = scene.field
n = field.num_primitives
def quality(mask=None, views=views, truths=opened.truths):
    s = scene if mask is None else dataclasses.replace(scene, field=field.rows(mask))
    im = [sn.render(s, v).rgb for v in views]
    return [float(psnr(a, b)) for a, b in zip(im, truths)], [float(ssim(a, b)) for a, b in zip(im, truths)], im
p, s, im = quality()
show = lambda name, p, s, k=None: print(name.ljust(26), f"{sum(p)/len(p):.3f} {sum(s)/len(s):.4f}", "kept" if k is None else k, ' '.join(f"{x:.1f}" for x in p), flush=True)
show("all", p, s)
order = sorted(range(len(p)), key=lambda i: p[i])
for i in order[:4]: save_image(torch.cat([im[i], opened.truths[i]], 1).permute(2,0,1)[None], out / f"view{i}.jpg")
source = LocalField(field)
W = torch.zeros(len(train), n, device=device)
for j, v in enumerate(train):
    prim = source.primitives(v, settings, features=False, colors=False)
    W[j] = blending_weights(pixels=None, **pass_options(prim, v, settings))
for least in (0.1, 1.0, 5.0):
    seen = (W > least).sum(0)
    print("seen by 0,1,2,3,4+", least, [(seen == k).sum().item() for k in range(4)], (seen >= 4).sum().item())
    for k in (1, 2, 3, 4):
        m = seen >= k
        show(f"w>{least} seen>={k}", *quality(m)[:2], int(m.sum()))
share = W.max(0).values / W.sum(0).clamp_min(1e-6)
for t in (0.99, 0.95, 0.9, 0.8):
    m = share < t; show(f"one view's share < {t}", *quality(m)[:2], int(m.sum()))
centers = torch.stack([torch.linalg.inv(v.viewmat)[:3, 3] for v in train])
d = torch.cdist(field["means"], centers).min(1).values
print("distances to the nearest camera", torch.quantile(d[::7], torch.tensor([.001,.01,.05,.25,.5], device=device)).tolist())
size = field["scales"].exp().amax(1)
for t in (0.02, 0.05, 0.1, 0.15, 0.2, 0.3):
    m = d > t; show(f"nearest camera > {t}", *quality(m)[:2], int(m.sum()))
for t in (0.5, 1.0, 2.0):
    m = size < t * d; show(f"size < {t} distance", *quality(m)[:2], int(m.sum()))
# leave one out: what would the worst view lose without each candidate set
for i in order[:3]:
    prim = source.primitives(views[i], settings, features=False, colors=False)
    w = blending_weights(pixels=None, **pass_options(prim, views[i], settings))
    top = w.argsort(descending=True)[:12]
    z = (views[i].viewmat @ torch.cat([field["means"], torch.ones(n,1,device=device)],1).T)[2]
    print("view", i, "psnr", p[i], [(int(t), f"w {w[t]/w.sum():.3f} z {z[t]:.3f} size {size[t]:.3f} op {field['opacities'][t].sigmoid().item():.2f} trainviews {(W[:,t]>1).sum().item()} share {share[t]:.2f} d {d[t]:.3f}") for t in top])
