"""ns-train with a colour correction of each photo in training, by few numbers with a prior, and none at test time."""
import os, sys, torch
from sundae_ns.model import SundaeModel
MODE=os.environ.get("PP","none"); W=float(os.environ.get("PPW","0.1"))
before=SundaeModel.get_loss_dict
def loss(self, outputs, batch, *a, **k):
    if MODE=="none" or not self.training: return before(self, outputs, batch, *a, **k)
    if not hasattr(self,"_pp"):
        n=max(self.num_train_data,1)+8
        self.__dict__["_pp"]=torch.zeros(n,3,requires_grad=True)
        self.__dict__["_opt"]=torch.optim.Adam([self._pp],lr=float(os.environ.get("PPLR","0.003")),betas=(0.9,0.99))
        self.__dict__["_seen"]=torch.zeros(n,1)
    self._opt.step(); self._opt.zero_grad()
    i=int(batch["image_idx"]); self._seen[i]=1
    p=self._pp
    mean=(p*self._seen).sum(0)/self._seen.sum()   # the field keeps the mean
    q=p-mean
    e=q[i,:1]; wb=torch.stack([q[i,1]-q[i,2]/2,-q[i,1]/2-q[i,2]/2+q[i,2]*0,q[i,2]-q[i,1]/2])
    if MODE=="exposure": wb=wb*0
    gain=torch.exp(e+wb)
    o=dict(outputs.items()) if hasattr(outputs,"items") else dict(outputs)
    for name in ("rgb","base_rgb"):
        if name in o: o[name]=o[name]*gain
    found=before(self,o,batch,*a,**k)
    found["light"]=W*(q*q*self._seen).sum()/self._seen.sum()
    return found
SundaeModel.get_loss_dict=loss
from nerfstudio.scripts.train import entrypoint
sys.argv[0]="ns-train"
entrypoint()
