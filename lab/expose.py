"""Copy a capture with training images (every 8th stays) of random exposure: expose.py FROM TO 0.15 [FOLDER], images_4 or images."""
import sys, numpy as np
from pathlib import Path
from PIL import Image
src, dst, std, folder = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), (sys.argv[4:] or ['images_4'])[0]
rng=np.random.default_rng(0)
files=sorted((src/folder).iterdir())
(dst/folder).mkdir(parents=True)
for name in ('sparse',): (dst/name).symlink_to(src/name)
if folder != 'images' and (src/'images').exists(): (dst/'images').symlink_to((src/'images').resolve())
for i,f in enumerate(files):
    im=np.asarray(Image.open(f).convert('RGB'),dtype=np.float32)/255
    if i%8:
        g=np.exp(rng.normal(0,std)+rng.normal(0,std/3,3)); im=np.clip(im*g,0,1)
    Image.fromarray((im*255+.5).astype(np.uint8)).save(dst/folder/f.name, **({'quality':97} if f.suffix.lower() in ('.jpg','.jpeg') else {}))
