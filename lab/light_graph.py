"""Gains of photos: running least squares, less their smooth part on a graph of cameras."""
import os, sys, torch, numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from sundae_ns.model import SundaeModel
from sundae_ns.training.step import TrainingStep
E=os.environ.get
ON=E("PP","none")!="none"; A=float(E("PPA","0.3")); S=float(E("PPS","1")); START=int(E("PPSTART","0")); WB=float(E("PPWB","1")); K=int(E("PPK","6")); LAM=float(E("PPLAM","1")); EVERY=int(E("PPEVERY","50"))
class L:
    on=False; cam=None
    @classmethod
    def setup(c,n,dev):
        c.Q=np.zeros((n,3)); c.N=np.zeros(n); c.P=np.zeros((n,6)); c.sums=torch.zeros(n,7,device=dev); c.table=torch.ones(n,3,device=dev); c.G=torch.ones(3,device=dev); c.i=torch.zeros((),dtype=torch.int64,device=dev); c.on=True; c.count=0; c.known=np.zeros(n,bool)
    @classmethod
    @torch.no_grad()
    def begin(c,i,step,camera):
        if not c.known[i]:
            m=camera.camera_to_worlds.reshape(-1,4)[:3].cpu().numpy(); c.P[i]=np.concatenate([m[:,3],-m[:,2]]); c.known[i]=True
        if c.count%EVERY==0 and c.count: c.refresh()
        c.count+=1
        c.i.fill_(i); c.G.copy_(c.table[i] if step>=START else torch.ones_like(c.G))
    @classmethod
    def refresh(c):
        s=c.sums.cpu().numpy().astype(float); c.sums.zero_()
        k=s[:,6]; hit=k>0
        g=np.log(np.clip((s[hit,:3]+1e-6)/(s[hit,3:6]+1e-6),0.25,4))
        g=WB*g+(1-WB)*g.mean(1,keepdims=True)
        a=np.maximum(1/(c.N[hit]+1),A)[:,None]
        c.Q[hit]+=a*(g+np.log(c.table.cpu().numpy()[hit])-c.Q[hit]); c.N[hit]+=1
        seen=c.N>0; n=seen.sum()
        if n<=K: return
        q=c.Q[seen]
        if LAM>0:
            P=c.P[seen].copy(); P-=P.mean(0); P[:,:3]/=np.sqrt((P[:,:3]**2).sum(1).mean()); P[:,3:]/=np.sqrt((P[:,3:]**2).sum(1).mean())+1e-9
            _,near=cKDTree(P).query(P,K+1)
            rows=np.repeat(np.arange(n),K); W=coo_matrix((np.ones(n*K),(rows,near[:,1:].ravel())),(n,n)).tocsr(); W=W.maximum(W.T)
            D=np.asarray(W.sum(1)).ravel(); lap=diags(D)-W
            low=splu((diags(np.ones(n))+LAM*lap).tocsc()).solve(q)
        else: low=q.mean(0)
        t=np.ones_like(c.Q); t[seen]=np.exp(S*(q-low))
        c.table.copy_(torch.from_numpy(t))
        c.last=(np.std(q,0),np.std(np.log(t[seen]),0))
bt=TrainingStep.terms
def terms(self,images,target,mask,count=None):
    if not (ON and L.on and torch.is_grad_enabled()): return bt(self,images,target,mask,count)
    o=dict(images.items()) if hasattr(images,"items") else dict(images)
    with torch.no_grad():
        r=o["rgb"].detach()*L.G; w=((target<0.98)&(target>0.01)).all(-1,keepdim=True).float()
        if mask is not None: w=w*mask
        m=w.sum().clamp(min=1)
        row=torch.cat([(w*r*target).sum((0,1))/m,(w*r*r).sum((0,1))/m,torch.ones_like(m)[None]])
        L.sums.index_add_(0,L.i[None],row[None])
    for name in ("rgb","base_rgb"): o[name]=o[name]*L.G
    return bt(self,o,target,mask,count)
TrainingStep.terms=terms
bl=SundaeModel.get_loss_dict
def loss(self,outputs,batch,*a,**k):
    if ON and self.training:
        if not L.on: L.setup(self.num_train_data+8,self.device)
        L.begin(int(batch["image_idx"]),self.step,L.cam)
    return bl(self,outputs,batch,*a,**k)
SundaeModel.get_loss_dict=loss
bo=SundaeModel.get_outputs
def outs(self,camera):
    if self.training: L.cam=camera
    return bo(self,camera)
SundaeModel.get_outputs=outs
bs=SundaeModel.step_inputs
def inputs(self,camera,batch):
    if ON:
        if not L.on: L.setup(self.num_train_data+8,self.device)
        L.begin(int(batch["image_idx"]),self.step,camera)
    return bs(self,camera,batch)
SundaeModel.step_inputs=inputs
from nerfstudio.scripts.train import entrypoint
if __name__=="__main__":
    sys.argv[0]="ns-train"
    entrypoint()
    if ON: print("std of all, of used:",*L.last)
